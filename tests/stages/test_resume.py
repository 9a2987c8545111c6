"""Training that is stopped goes on as if nothing had happened, whatever state it was in."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
from composed import compose_config
from killed import SMALL, drive, result
from tracked import RecordedRun

from negopipe.runtime.interruption import DeferredInterrupt
from negopipe.stages import train
from negopipe.tracking.snapshots import Snapshots

KFAC = (
    "policy.conv=[{channels: 4, kernel: 8, stride: 4}, {channels: 4, kernel: 4, stride: 2}]",
    *("policy.encoder_width=16", "policy.head_widths=[8]"),
    *("algorithm.kfac.statistics_interval=2", "algorithm.kfac.inverse_interval=3"),
)
"""A small network, whose factors are inverted quickly."""
OTHERS = {"acktr_adam": KFAC, "a2c": (), "ppo": ("algorithm.n_epochs=2",)}
EARLY = ("curriculum.advance={success_rate: 0.0, n_episodes: 3}", "scenario.episode_steps=7")
"""Stages end when three episodes are over."""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, pd.DataFrame]:
    return drive(tmp_path_factory.mktemp("undisturbed"), *KFAC)


@pytest.mark.parametrize("deaths", [(2, 1, 3), (6,)])
def test_it_ends_as_if_it_had_never_been_killed(
    undisturbed: tuple[bytes, pd.DataFrame], tmp_path: Path, deaths: tuple[int, ...]
) -> None:
    checkpoint, history = drive(tmp_path, *KFAC, deaths=deaths)
    assert checkpoint == undisturbed[0]
    pd.testing.assert_frame_equal(history, undisturbed[1], check_exact=True)
    assert not (tmp_path / "snapshots").exists()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", OTHERS)
def test_so_does_every_algorithm(tmp_path: Path, algorithm: str) -> None:
    changed = (f"algorithm={algorithm}", *OTHERS[algorithm])
    whole, (checkpoint, history) = (drive(tmp_path / f"{len(d)}", *changed, deaths=d) for d in ((), (2, 3)))
    assert checkpoint == whole[0]
    pd.testing.assert_frame_equal(history, whole[1], check_exact=True)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["acktr", "ppo"])
def test_so_does_a_network_for_objects(tmp_path: Path, algorithm: str) -> None:
    changed = ("observation=objects", "policy=objects", f"algorithm={algorithm}")
    whole, (checkpoint, history) = (drive(tmp_path / f"{len(d)}", *changed, deaths=d) for d in ((), (2, 3)))
    assert checkpoint == whole[0]
    pd.testing.assert_frame_equal(history, whole[1], check_exact=True)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["acktr", "ppo"])
def test_so_does_self_play(tmp_path: Path, algorithm: str) -> None:
    league = ("draw=hardest", "every_iterations=2", "n_members=2")
    changed = (f"algorithm={algorithm}", "population/driver=[planner,self,league]")
    changed += tuple(f"population.drivers.league.driver.{each}" for each in league)
    whole, (checkpoint, history) = (drive(tmp_path / f"{len(d)}", *changed, deaths=d) for d in ((), (2, 3)))
    assert checkpoint == whole[0]
    pd.testing.assert_frame_equal(history, whole[1], check_exact=True)


@pytest.mark.slow
def test_so_does_a_stage_that_ends_early(tmp_path: Path) -> None:
    whole, (checkpoint, history) = (drive(tmp_path / f"{len(d)}", *KFAC, *EARLY, deaths=d) for d in ((), (2, 3)))
    assert checkpoint == whole[0]
    assert history["stage"].tolist() == whole[1]["stage"].tolist()
    assert history["stage"].value_counts()["full"] > 2


def test_stages_of_one_name_are_two_stages(tmp_path: Path) -> None:
    config = compose_config([*SMALL, "curriculum=smoke"])
    first, second, *_ = config.curriculum.stages
    near = {"yield": replace(first.families["yield"], start_distance_m=(12.0, 12.0))}
    stages = (replace(first, n_iterations=1), replace(second, name=first.name, n_iterations=1, families=near))
    training = train.Training(replace(config, curriculum=replace(config.curriculum, stages=stages)))
    training.iterate()
    assert training.is_at_stage_end
    assert set(training.env.sampler.families) == {"push", "yield"}
    training.iterate()
    assert set(training.env.sampler.families) == {"yield"}


def test_a_signal_waits_for_the_end_of_the_step_and_the_work_is_kept(
    undisturbed: tuple[bytes, pd.DataFrame], tmp_path: Path
) -> None:
    config = compose_config([*SMALL, *KFAC, "tracking.snapshot_period_s=1e6"])

    class StoppedRun(RecordedRun):
        def log_metrics(self, metrics: dict[str, float], step: int) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(SystemExit) as stopped:
        train.run(config, StoppedRun(tmp_path))  # type: ignore[arg-type]
    assert stopped.value.code == 128 + signal.SIGTERM
    assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["000000001.safetensors"]
    train.run(config, RecordedRun(tmp_path))  # type: ignore[arg-type]
    assert result(tmp_path)[0] == undisturbed[0]


def test_who_asks_twice_does_not_wait() -> None:
    before = signal.getsignal(signal.SIGINT)  # ignored where a shell runs the tests in the background
    with DeferredInterrupt() as interrupt:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_the_last_few_are_kept_and_a_damaged_one_is_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    snapshots = Snapshots(tmp_path / "kept", 2)
    assert snapshots.newest() is None
    for step in (1, 2, 10):
        snapshots.save(step, {"x": torch.full((3,), float(step))}, {"step": step})
    assert sorted(path.name for path in snapshots.folder.iterdir()) == [
        "000000002.safetensors",
        "000000010.safetensors",
    ]
    newest = snapshots.folder / "000000010.safetensors"
    newest.write_bytes(newest.read_bytes()[:-4])
    found = snapshots.newest()
    assert found is not None
    assert found[1] == {"step": 2}
    assert found[0]["x"].tolist() == [2.0, 2.0, 2.0]
    assert "000000010" in caplog.text
