"""Whatever a key is set to, it ends in a valid run or in one line that says what is wrong: never a traceback or a hang.

Every key of every group's options is overridden: with wrong types, odd texts and values near the default. What is
refused must be refused in one line; what is accepted must build, drive and learn.
"""

import json
import math
import os
import resource
import signal
import tempfile
import traceback
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from composed import applied, composed
from hydra.errors import HydraException
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tracked import RecordedRun
from yaml import YAMLError

from negopipe.config.messages import explain_composition
from negopipe.config.root import RunConfig, load
from negopipe.errors import UserError
from negopipe.runtime.build import save_policy
from negopipe.simulation.state import World
from negopipe.stages import behaviour_map, cross_play, evaluate, oracle, report
from negopipe.tracking.checkpoint import CHECKPOINT_NAME
from negopipe.tracking.run_folder import CONFIG_NAME, METRICS_NAME
from negopipe.training.training import Training

N_FAST, N_SLOW = 1, 5
"""Overrides per key."""

LIMIT_S, LIMIT_BYTES = 120, 6 * 2**30
"""Of one override's run, which takes a tenth of a second with the default values."""

TINY = (
    "+experiment=smoke", "device=cpu", "n_threads=1",
    "policy.head_widths=[8]", "algorithm.n_worlds=3",
    "algorithm.n_steps=4", "algorithm.minibatch_size=6", "algorithm.kfac.inverse_interval=2",
    "scenario.episode_steps=3", "evaluation.n_episodes=2", "behaviour_map.n_episodes=2", "cross_play.n_episodes=2",
    "oracle.n_episodes=2", "oracle.population=2", "oracle.settings=[push]", "behaviour_map.horizons_s=[0.0,2.0]",
    "behaviour_map.styles_s=[2.0]", "evaluation.settings=[yield]", "oracle.rounds=1", "benchmark.backends=[eager]",
    "benchmark.n_worlds=[1,2]", "policy.horizons_s=[0.0,2.0]", "evaluation/baseline=[fixed_0,fixed_2]",
    "report.side_by_side=[fixed_2]", "benchmark.base_n_worlds=1", "benchmark.min_time_s=0.001",
    "benchmark.n_latencies=2",
)  # fmt: skip

GRIDS = (
    "policy.conv=[{channels: 4, kernel: 8, stride: 4}, {channels: 4, kernel: 4, stride: 2}]",
    "policy.encoder_width=16", "policy.precision=float32",
)  # fmt: skip
OBJECTS = ("observation=objects", "policy=objects", "policy.trunk_widths=[16]", "policy.own_widths=[8]")
"""The two kinds of observation with a tiny network each."""

OTHER_OPTIONS = (
    *GRIDS,
    "scenario=bent_street", "perception=noisy", "dynamics=bicycle", "planner/prediction=constant_acceleration",
    "reward=strict", "curriculum=three_stages",
)  # fmt: skip
"""With keys that the defaults do not have, or give another kind of value."""

STAGE_OF = {
    "evaluation": "evaluate",
    **{name: name for name in ("behaviour_map", "cross_play", "oracle", "report", "benchmark")},
}
"""Group -> the stage that is about it."""

DRIVEN = {
    "evaluate": evaluate,
    "behaviour_map": behaviour_map,
    "cross_play": cross_play,
    "oracle": oracle,
    "report": report,
}
"""The stages that are run; a benchmark takes as long as it is told to."""

Options = tuple[str, ...]


def nodes(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All keys below, mappings and lists as a whole as well; of a list of numbers its first item."""
    if key:
        yield key, value
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    is_alike = isinstance(value, list) and not any(isinstance(item, dict) for item in value)
    for name, item in list(items)[: 1 if is_alike else None]:
        yield from nodes(item, f"{key}.{name}" if key else str(name))


def all_keys() -> dict[str, tuple[Options, Any]]:
    """Key -> the options that it is a key of, and its value there."""
    keys: dict[str, tuple[Options, Any]] = {}
    for options in (OTHER_OPTIONS, OBJECTS, GRIDS):  # a key of several is tested with the defaults
        for key, value in nodes(OmegaConf.to_container(composed((*TINY, *options)), resolve=True)):
            stage = STAGE_OF.get(key.partition(".")[0])
            runs = (*(["population=mixed"] if stage == "cross_play" else []), f"stages=[{stage}]") if stage else ()
            keys[key] = ((*options, *runs), value)
    return keys


KEYS = all_keys()

ODD_TEXTS = (
    "null", "true", "''", "", "[]", "{}", "[null]", "[1,2]", "{a: 1}", "1,2", "choice(1,2)", "???", "[1", "a b",
    "../..",
    "/dev/null/x", "a/b", "~nobody", "ünï", "%s", "-", "${nothing}", "${seed}", "$HOME", "x" * 300, "'#'", "0x10",
    "2021-03-11",
)  # fmt: skip

NUMBERS = ("-1", "0", "-0.0", "1", "0.5", "1.5", "1e-3", "inf", "nan")


def near(value: Any) -> list[str]:
    """Values like `value`, as a user may try them."""
    match value:
        case bool():
            return [str(not value).lower()]
        case int():
            return [str(x) for x in (value // 2, 2 * value, value + 1, value - 1)]
        case float():
            return [str(x) for x in (value / 2, 2 * value, value + 1, -value, 0.99 * value)]
        case list():
            items = [near(item) or [str(item)] for item in value if not isinstance(item, dict | list)]
            lists = [[str(x) for x in value], *[[nearby[i % len(nearby)] for nearby in items] for i in range(4)]]
            lists += [x for n in NUMBERS for x in ([n] * max(1, len(value)), [*map(str, value[1:]), n])]
            lists += [lists[0][::-1], lists[0][:-1], lists[0] * 2, lists[0] * 100]
            return [f"[{','.join(x)}]" for x in lists if "{" not in "".join(x)]
        case dict():
            return ["{}", f"{{{next(iter(value), 'a')}: null}}"]
        case _:
            return ["auto", "off", "'off'", "'on'", "cuda", "push", "left", "literal", "sample", "any_code", "bicycle"]


def overrides(value: Any) -> st.SearchStrategy[str]:
    """What a key whose value is `value` is set to, as the command line has it."""
    anything = st.one_of(st.integers(-20, 40).map(str), st.text(max_size=20))
    if isinstance(value, str | dict) or value is None:
        return st.one_of(st.sampled_from(ODD_TEXTS), st.sampled_from(near(value)), st.sampled_from(NUMBERS), anything)
    likely = st.sampled_from(near(value) + list(NUMBERS))
    return st.one_of(likely, likely, likely, st.sampled_from(ODD_TEXTS), anything)


def each(key: str, n: int, check: Callable[[str], None]) -> None:
    """Call `check` with `n` overrides of `key`, the same ones every time, others for every key."""

    @seed(zlib.crc32(key.encode()))
    @settings(
        max_examples=n, database=None, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
    )
    @given(overrides(KEYS[key][1]))
    def checked(value: str) -> None:
        check(f"{key}={value}")

    checked()


def outcome(options: Options, override: str, compose_with: Callable[[Options, str], DictConfig]) -> RunConfig | str:
    """The config that is valid, or the line that `negopipe.__main__` prints; anything else raises."""
    try:
        return load(compose_with(options, override))
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        return explain_composition(error)
    except ValueError as error:  # of Hydra's own checks
        return f"{error}, got {override}"
    except UserError as error:
        return str(error)


def set_in_a_copy(options: Options, override: str) -> DictConfig:
    return applied((*TINY, *options), [override])


def composed_anew(options: Options, override: str) -> DictConfig:
    """As the command line does it."""
    return composed((*TINY, *options, override))


def assert_tells(line: str, key: str) -> None:
    """One line, not too long for a terminal, that names the key."""
    assert line.isprintable(), line
    assert 0 < len(line) <= 400, line
    assert "Traceback" not in line
    last_name = [part for part in key.split(".") if not part.isdigit()][-1]
    assert last_name in line, f"{key}: {line}"


@pytest.mark.parametrize(
    "override",
    ["seed=3", "seed=-1", "seed=[1", "seed=1,2", "seed=${seed}", "policy.conv.0.channels=2", "policy.conv.x=2",
     "planner={horizon_s: 7.0}", "planner.limits.foo=1", "scenario.families.push.style_switch=null", "name='a\nb'"],
)  # fmt: skip
def test_overrides_are_applied_as_on_the_command_line(override: str) -> None:
    assert outcome((), override, set_in_a_copy) == outcome((), override, composed_anew)


@pytest.mark.parametrize("group", ["scenario", "planner/prediction"])
@pytest.mark.parametrize("option", ["nope", "null", "3", "[1", "''", "../nope", "'a\nb'", "x" * 300])
def test_an_option_that_does_not_exist_is_told_in_one_line(group: str, option: str) -> None:
    result = outcome((), f"{group}={option}", composed_anew)
    assert isinstance(result, str)
    assert_tells(result, group)


@pytest.mark.parametrize("key", KEYS)
def test_an_override_is_accepted_or_refused_in_one_line(key: str) -> None:
    def check(override: str) -> None:
        result = outcome(KEYS[key][0], override, set_in_a_copy)
        if isinstance(result, str):
            assert_tells(result, key)

    each(key, N_FAST, check)


@pytest.mark.slow
@pytest.mark.parametrize("key", [*KEYS])
def test_an_override_ends_in_one_line_or_in_a_valid_run(key: str, tmp_path: Path) -> None:
    def check(override: str) -> None:
        result = outcome(KEYS[key][0], override, set_in_a_copy)
        if isinstance(result, str):
            assert_tells(result, key)
        else:
            problem = apart(lambda: drive(result, key, tmp_path))
            assert not problem, f"{override}: {problem}"

    each(key, N_SLOW, check)


def apart(work: Callable[[], None]) -> str:
    """Do `work` in a process of its own, with little time and memory; returns why it failed, or nothing.

    What only says that it cannot go on, in one line, has not failed.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LIMIT_S)
        limit_memory()
        problem = ""
        try:
            work()
        except UserError as error:
            problem = "" if str(error).isprintable() else repr(error)
        except BaseException:
            problem = traceback.format_exc()
        os.write(writing, problem.encode("utf-8", "replace")[-4000:])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        problem = pipe.read().decode("utf-8", "replace")
    _, status = os.waitpid(child, 0)
    return f"ended by {signal.Signals(os.WTERMSIG(status)).name}" if os.WIFSIGNALED(status) else problem


def limit_memory() -> None:
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + LIMIT_BYTES, now + LIMIT_BYTES))


def drive(config: RunConfig, key: str, folder: Path) -> None:
    """An iteration of training with sound numbers; and the stage that the key is of."""
    training = Training(config)
    row = training.iterate()
    learned = {name: x for name, x in row.items() if name not in ("success_rate", "collision_rate", "return_mean")}
    bad = {name: x for name, x in learned.items() if not isinstance(x, str) and not math.isfinite(x)}
    assert not bad, bad
    assert all(weights.isfinite().all() for weights in training.policy.state_dict().values())
    assert_is_sound(training.env.world)
    stage = DRIVEN.get(STAGE_OF.get(key.partition(".")[0], ""))
    if stage is not None:
        with tempfile.TemporaryDirectory(dir=folder) as name:
            run = RecordedRun(Path(name))
            save_policy(run.folder / CHECKPOINT_NAME, training.policy, config, 1)
            if stage is report:
                provide_for_report(config, training, run)
            stage.run(config, run)  # type: ignore[arg-type]


def provide_for_report(config: RunConfig, training: Training, run: RecordedRun) -> None:
    """What the stages before it and the store leave in the run folder."""
    training.curve.write(run.folder)
    evaluate.run(config, run)  # type: ignore[arg-type]
    (run.folder / METRICS_NAME).write_text(json.dumps(run.sections | {"train": training.curve.summary()}))
    (run.folder / CONFIG_NAME).write_text("seed: 1")


def assert_is_sound(world: World) -> None:
    """No NaN or infinity in what vehicles are and remember."""
    vehicles = world.vehicles
    fields = (vehicles.position, vehicles.yaw, vehicles.speed, vehicles.accel, vehicles.curvature)
    for field in (*fields, world.pose_history, world.speed_history, world.command_queue):
        assert field.isfinite().all()
    assert (vehicles.speed >= 0).all()
