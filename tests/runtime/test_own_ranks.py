"""A long training of a small network starts further processes, which train as those of torchrun do."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.runtime import own_ranks
from negopipe.runtime.own_ranks import joined, number_of
from negopipe.tensors.ranks import ALONE

ALWAYS = "import sys; from negopipe.runtime import own_ranks; own_ranks.LONG = 0; "
"""Of a short training as well."""
TRAIN = (
    *("+experiment=smoke", "stages=[train]", "device=cpu", "compile=off", "policy=objects", "observation=objects"),
    *("algorithm.n_worlds=128", "algorithm.n_steps=2", "scenario.episode_steps=12", "tracking.snapshot_period_s=0.1"),
    "curriculum.stages=[{name: only, n_iterations: 40, families: ${scenario.families}}]",
)


def generalist(*overrides: str) -> RunConfig:
    return compose_config(["+experiment=generalist", "device=cpu", "n_threads=2", *overrides])


@pytest.mark.parametrize(
    ("overrides", "number"),
    [
        ((), 2),
        (("n_threads=1",), 1),
        (("n_threads=4",), 4),
        (("n_threads=4", "algorithm.n_worlds=192"), 3),
        (("algorithm.n_worlds=64",), 1),
        (("curriculum.stages.0.n_iterations=6",), 1),
        (("observation=occupancy_grid", "policy=cnn_inf"), 1),
        (("device=cuda",), 1),
    ],
)
def test_there_is_one_per_core_where_that_helps(overrides: tuple[str, ...], number: int) -> None:
    assert number_of(generalist(*overrides)) == number


def test_torchrun_has_started_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert number_of(generalist()) == 1


def test_a_process_that_ends_at_once_is_said_and_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    environment, n_threads = dict(os.environ), torch.get_num_threads()
    monkeypatch.setattr(own_ranks, "_start", lambda index: subprocess.Popen([sys.executable, "-c", ""]))
    with (
        pytest.raises(UserError, match="n_threads must be 1 where no further process can be started"),
        joined(generalist(), ALONE),
    ):
        pass
    assert (dict(os.environ), torch.get_num_threads()) == (environment, n_threads)


def test_a_short_training_has_the_given_ranks_and_config() -> None:
    config = replace(generalist(), n_threads=1)
    with joined(config, ALONE) as (same, ranks):
        assert same is config
        assert ranks is ALONE


def start(outputs: Path, *launcher: str) -> subprocess.Popen[str]:
    command = [*launcher, *TRAIN, f"outputs={outputs}"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def alone(outputs: Path) -> subprocess.Popen[str]:
    main = ALWAYS + "from negopipe.__main__ import main; sys.exit(main())"
    return start(outputs, sys.executable, "-c", main, "n_threads=2")


def weights(process: subprocess.Popen[str], outputs: Path) -> bytes:
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    (path,) = outputs.glob("smoke/*/checkpoint.safetensors")
    return path.read_bytes()


def others(process: subprocess.Popen[str]) -> Iterator[int]:
    for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        if b"negopipe.stages.train" in Path(f"/proc/{child}/cmdline").read_bytes():
            yield int(child)


@pytest.mark.slow
def test_the_weights_are_those_of_torchrun_also_after_a_lost_process(tmp_path: Path) -> None:
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "-m", "negopipe", "n_threads=1")
    expected = weights(start(tmp_path / "torchrun", *torchrun), tmp_path / "torchrun")
    killed = alone(tmp_path / "own")
    while not [*(tmp_path / "own").glob("smoke/*/snapshots/*")]:
        time.sleep(0.1)
        assert killed.poll() is None
    for pid in others(killed):
        os.kill(pid, signal.SIGKILL)
    _, said = killed.communicate(timeout=60)
    assert killed.returncode == 1
    assert said.startswith("one of 2 ranks has ended or is out of reach")
    assert said.count("\n") == 1
    assert weights(alone(tmp_path / "own"), tmp_path / "own") == expected
