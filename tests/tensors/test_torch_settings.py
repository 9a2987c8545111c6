"""An environment and its user's process: neither what one nor what the other sets reaches the other one."""

import json
import multiprocessing
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from multiprocessing.connection import Connection

import gymnasium
import numpy as np
import pytest
import torch

from negopipe.envs.gymnasium import NarrowLaneVectorEnv
from negopipe.envs.registration import ENV_ID

TIMEOUT_S = 60
"""Far longer than it takes; a forked process that waits for its parent's threads waits for ever."""


@contextmanager
def setting(read: Callable, write: Callable, value: object) -> Iterator[None]:
    """A process in which `write(value)` was called; an environment leaves it so."""
    before = read()
    write(value)
    try:
        held = read()
        yield
        assert read() == held
    finally:
        write(before)


@contextmanager
def default_device(name: str) -> Iterator[None]:
    torch.set_default_device(name)
    try:
        yield
        assert torch.get_default_device().type == name
    finally:
        torch.set_default_device(None)


@contextmanager
def random_numbers() -> Iterator[None]:
    """Other ones than before, none of which is drawn."""
    kept = np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    torch.manual_seed(5)
    held = str(np.random.get_state()), torch.get_rng_state()  # noqa: NPY002
    yield
    assert str(np.random.get_state()) == held[0]  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), held[1])
    np.random.set_state(kept[0])  # noqa: NPY002
    torch.set_rng_state(kept[1])


@contextmanager
def errors_for_warnings() -> Iterator[None]:
    with warnings.catch_warnings(), np.errstate(all="raise"):
        warnings.simplefilter("error")
        yield


def products(precision: str) -> AbstractContextManager[None]:
    return setting(torch.get_float32_matmul_precision, torch.set_float32_matmul_precision, precision)


STATES = {
    "float64": lambda: setting(torch.get_default_dtype, torch.set_default_dtype, torch.float64),
    "bfloat16": lambda: setting(torch.get_default_dtype, torch.set_default_dtype, torch.bfloat16),
    "meta": lambda: default_device("meta"),
    "with_meta": lambda: torch.device("meta"),
    "inference": lambda: torch.inference_mode(),
    "no_grad": lambda: torch.no_grad(),
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "medium": lambda: products("medium"),
    "threads": lambda: setting(torch.get_num_threads, torch.set_num_threads, 3),
    "deterministic": lambda: setting(
        torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms, True
    ),
    "random": random_numbers,
    "errors": errors_for_warnings,
}


MAIN_STATES = {"float64", "with_meta", "inference", "autocast", "random", "errors"}
"""One of each kind; the fast tests try these."""


def drive(build: AbstractContextManager, step: AbstractContextManager) -> list[np.ndarray]:
    """What three worlds show and pay in a fixed drive in which episodes end, which draws tasks."""
    actions = np.random.default_rng(2).integers(0, 4, (9, 3))
    with build:
        envs = NarrowLaneVectorEnv(3, ("perception=noisy", "dynamics=bicycle", "scenario.episode_steps=6"))
        shown = [envs.reset(seed=3)[0]]
    with step:
        for action in actions:
            observation, *paid, _ = envs.step(action)
            shown += [observation, *paid]
        shown.append(envs.reset(options={"reset_mask": np.array([True, False, True])})[0])
    return shown


@pytest.fixture(scope="module")
def expected() -> list[np.ndarray]:
    return drive(nullcontext(), nullcontext())


@pytest.mark.parametrize(
    "state", [name if name in MAIN_STATES else pytest.param(name, marks=pytest.mark.slow) for name in STATES]
)
def test_the_state_of_the_process_does_not_matter(state: str, expected: list[np.ndarray]) -> None:
    change = STATES[state]
    for shown in (drive(change(), nullcontext()), drive(nullcontext(), change())):
        assert all(np.array_equal(a, b) for a, b in zip(shown, expected, strict=True))


CHANGES = """
import json, logging, multiprocessing, os, random, signal, sys, warnings
import gymnasium, hydra, matplotlib, numpy as np, pandas, scipy.stats, torch
import charset_normalizer  # like those above, it changes something itself when it is imported
from omegaconf.basecontainer import BaseContainer

def state():
    loggers = [logging.root, *logging.root.manager.loggerDict.values()]
    return {
        "environment": dict(os.environ),
        "torch": [torch.get_num_threads(), torch.get_num_interop_threads(), str(torch.get_default_dtype()),
                  str(torch.get_default_device()), torch.are_deterministic_algorithms_enabled(),
                  torch.is_grad_enabled(), torch.get_float32_matmul_precision(), torch.is_autocast_enabled("cpu"),
                  torch.utils.deterministic.fill_uninitialized_memory, torch.backends.mkldnn.matmul.fp32_precision],
        "random": [str(random.getstate()), str(np.random.get_state()), torch.get_rng_state().tolist()],
        "numpy": [np.geterr(), str(np.get_printoptions())],
        "loggers": {each.name: [each.level, len(each.handlers), each.propagate, each.disabled]
                    for each in loggers if isinstance(each, logging.Logger)
                    if each.level or each.handlers or not each.propagate or each.disabled},
        "signals": {number: str(signal.getsignal(number)) for number in signal.valid_signals()},
        "warnings": list(map(str, warnings.filters)),
        "processes": multiprocessing.get_start_method(allow_none=True),
        "matplotlib": str(dict.items(matplotlib.rcParams)),
        "python": [os.getcwd(), sys.path[:], sys.getrecursionlimit(), str(sys.excepthook), str(sys.stdout)],
        "resolvers": {name: id(resolver) for name, resolver in BaseContainer._resolvers.items()
                      if not name.startswith("negopipe.")},  # names that no other program uses
        "tasks": len(os.listdir("/proc/self/task")) if os.path.isdir("/proc/self/task") else 0,
    }

before = state()
import negopipe
env, envs = negopipe.make_env(), negopipe.make_vec_env(70)
env.reset(seed=1), envs.reset(seed=1)
for _ in range(3):
    env.step(0), envs.step(np.zeros(70, int))
after = state()
print(json.dumps({part: [before[part], after[part]] for part in before if before[part] != after[part]}))
"""


@pytest.mark.slow
def test_nothing_of_the_process_is_changed() -> None:
    result = subprocess.run([sys.executable, "-c", CHANGES], capture_output=True, text=True, check=True, timeout=120)
    changes = json.loads(result.stdout.splitlines()[-1])
    before, after = changes.pop("environment", ({}, {}))
    after.pop("MLFLOW_DISABLE_TELEMETRY", None)  # negopipe.tracking says why
    before.pop("MLFLOW_DISABLE_TELEMETRY", None)
    assert (changes, before) == ({}, after)


def give_up(signum: int, frame: object) -> None:
    raise TimeoutError(f"not done after {TIMEOUT_S} s")


@pytest.fixture
def _threads_have_started() -> Iterator[None]:
    """torch's threads are there, as after the user's own work with a large network. Nothing may take too long."""
    n_threads, handler = torch.get_num_threads(), signal.signal(signal.SIGALRM, give_up)
    torch.set_num_threads(2)
    torch.mm(torch.rand(1500, 1500), torch.rand(1500, 1500))
    torch.zeros(2000, 2000).add_(1)
    signal.alarm(TIMEOUT_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, handler)
    torch.set_num_threads(n_threads)
    for child in multiprocessing.active_children():
        child.kill()


def drive_in_a_fork(connection: Connection, envs: gymnasium.Env) -> None:
    """Go on with what the parent built, then build anew."""
    envs.step(0)
    again = gymnasium.make(ENV_ID)
    again.reset(seed=1)
    connection.send(again.step(1)[0])


@pytest.mark.usefixtures("_threads_have_started")
def test_a_forked_process_drives_although_its_parent_has_threads() -> None:
    fork, env = multiprocessing.get_context("fork"), gymnasium.make(ENV_ID)
    env.reset(seed=1)
    here, there = fork.Pipe()
    fork.Process(target=drive_in_a_fork, args=(there, env), daemon=True).start()
    assert np.array_equal(here.recv(), env.step(1)[0])


@pytest.mark.usefixtures("_threads_have_started")
@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_asynchronous_environments_drive(context: str) -> None:
    envs = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="async", vector_kwargs={"context": context})
    first, _ = envs.reset(seed=1)
    second = envs.step(np.array([1, 2]))[0]
    envs.close()
    one = gymnasium.make(ENV_ID)
    for world, action in enumerate((1, 2)):
        assert np.array_equal(first[world], one.reset(seed=1 + world)[0])
        assert np.array_equal(second[world], one.step(action)[0])


LOADED = """
import gymnasium, torch
import negopipe

class Episodes(torch.utils.data.IterableDataset):
    def __iter__(self):
        yield torch.from_numpy(gymnasium.make("negopipe/NarrowLane-v0").reset(seed=1)[0])

torch.set_num_threads(2)
torch.mm(torch.ones(500, 500), torch.ones(500, 500))
loader = torch.utils.data.DataLoader(Episodes(), batch_size=1, num_workers=1, multiprocessing_context="fork")
print(int(next(iter(loader)).count_nonzero()))
"""


@pytest.mark.slow
def test_workers_of_a_data_loader_drive() -> None:
    """In a process of its own: the loader's handler of SIGCHLD would stay in this one."""
    loaded = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, timeout=120, check=True)
    assert int(loaded.stdout) == np.count_nonzero(gymnasium.make(ENV_ID).reset(seed=1)[0])
