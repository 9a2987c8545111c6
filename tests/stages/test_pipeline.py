"""The whole line at tiny size: files, store, repeatability, a stage alone."""

import json
import re
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from tracked import Command, ready_at

import negopipe.__main__ as entry

SMOKE = ("+experiment=smoke", "n_threads=1")
FEW = ("evaluation/baseline=[fixed_0,fixed_6]", "report.side_by_side=[fixed_6]", "scenario.episode_steps=24")
"""Fewer planners, films and steps than the experiment has; `make smoke` runs in test_commands.py."""
SHORT = (*SMOKE, *FEW, "report.n_animations=0", "report.animation_fps=2", "report.figure_formats=[svg]")
PLANNERS = {"adaptive", "fixed_0", "fixed_6"}
MEASURES = {"success_rate", "collision_rate", "timeout_rate", "driving_time_s", "suspend_count", "reward"}


def negopipe(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "negopipe", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def only_run(outputs: Path) -> Path:
    (folder,) = (outputs / "smoke").iterdir()
    return folder


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory, new_database: Path) -> Path:
    folder = tmp_path_factory.mktemp("outputs")
    ready_at(new_database, folder)
    out, handler = StringIO(), signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.setattr(sys, "argv", ["negopipe", *SHORT, f"outputs={folder}"])
        assert entry.main() == 0
    signal.signal(signal.SIGTERM, handler)
    assert "left" in out.getvalue()  # progress
    return folder


def without_durations(metrics: dict[str, Any]) -> dict[str, Any]:
    assert metrics["train"].pop("wall_s") > 0
    assert metrics["train"].pop("decisions_per_s") > 0
    assert 0 < metrics["train"].pop("tracking_share") < 1
    return metrics


def test_run_folder_has_what_programs_read(outputs: Path) -> None:
    folder = only_run(outputs)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["train"]["decisions"] == 6 * 4 * 8
    assert set(metrics["evaluation"]) == {"push", "yield"}
    for planners in metrics["evaluation"].values():
        assert set(planners) == PLANNERS
        assert all(set(measures) >= MEASURES for measures in planners.values())
    table = pd.read_csv(folder / "episodes.csv")
    assert len(table) == 2 * len(PLANNERS) * 4
    history = pd.read_csv(folder / "history.csv")
    assert history["stage"].tolist() == ["apart"] * 2 + ["closer"] * 2 + ["full"] * 2
    assert {"kl", "entropy", "value_loss", "policy_loss"} <= set(history.columns)
    for name in ("report.html", "checkpoint.safetensors", "config.yaml", "traces.npz"):
        assert (folder / name).stat().st_size > 0


def test_every_planner_met_the_same_tasks(outputs: Path) -> None:
    table = pd.read_csv(only_run(outputs) / "episodes.csv")
    for _, rows in table.groupby(["setting", "episode"]):
        assert rows["social_start_distance_m"].nunique() == 1
        assert rows["style_horizon_s"].nunique() == 1


def test_store_has_the_run(outputs: Path) -> None:
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        ((status,),) = connection.execute("SELECT status FROM runs").fetchall()
        keys = {key for (key,) in connection.execute("SELECT key FROM metrics")}
    assert status == "FINISHED"
    assert {"train/kl", "train/policy_loss", "evaluation/push/adaptive/success_rate"} <= keys
    artifacts = {path.name for path in (outputs / "mlflow" / "artifacts").rglob("*")}
    assert {"config.yaml", "checkpoint.safetensors", "report.html", "metrics.json", "episodes.csv"} <= artifacts


def test_same_seed_same_numbers(outputs: Path, tmp_path: Path, command: Command, new_database: Path) -> None:
    ready_at(new_database, tmp_path)
    code, _, err = command(*SHORT, f"outputs={tmp_path}", "stages=[train,evaluate]")
    assert code == 0, err
    first, again = (json.loads((only_run(o) / "metrics.json").read_text()) for o in (outputs, tmp_path))
    assert without_durations(first) == without_durations(again)
    assert only_run(outputs).name == only_run(tmp_path).name
    for name in ("episodes.csv", "checkpoint.safetensors"):
        assert (only_run(outputs) / name).read_bytes() == (only_run(tmp_path) / name).read_bytes()


@pytest.mark.slow
def test_evaluation_alone_from_a_checkpoint(outputs: Path, tmp_path: Path, command: Command) -> None:
    checkpoint = only_run(outputs) / "checkpoint.safetensors"
    done = negopipe(
        *("+experiment=smoke", *SHORT[2:]),
        f"outputs={tmp_path}",
        "n_threads=2",  # two processes
        "stages=[evaluate]",
        f"checkpoint={checkpoint}",
    )
    assert done.returncode == 0, done.stderr
    for name in ("episodes.csv", "traces.npz"):
        assert (only_run(outputs) / name).read_bytes() == (only_run(tmp_path) / name).read_bytes()
    again = (*SHORT, f"outputs={tmp_path}", "stages=[evaluate]", f"checkpoint={checkpoint}")
    code, _, err = command(*again, "policy.encoder_width=64")
    assert code == 1
    assert err.startswith("policy.encoder_width must be 512 as in the checkpoint")
    assert len(err.splitlines()) == 1


def test_the_same_command_repeats_nothing(outputs: Path, command: Command) -> None:
    before = {path: path.stat().st_mtime_ns for path in only_run(outputs).glob("*.csv")}
    code, out, err = command(*SHORT, f"outputs={outputs}")
    assert code == 0, err
    for stage in ("train", "evaluate", "report"):
        assert re.search(rf"^{stage} +finished before", out, flags=re.MULTILINE)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        assert connection.execute("SELECT status FROM runs").fetchall() == [("FINISHED",)]


@pytest.mark.slow
def test_another_experiment_takes_the_training_over(outputs: Path) -> None:
    arguments = (*SHORT, f"outputs={outputs}", "name=other", "stages=[train]")
    done = negopipe(*arguments, "evaluation.leading_setting=push")
    assert done.returncode == 0, done.stderr
    assert "taken over from" in done.stdout
    (other,) = (outputs / "other").iterdir()
    for name in ("checkpoint.safetensors", "history.csv"):
        assert (other / name).read_bytes() == (only_run(outputs) / name).read_bytes()
    trained = [json.loads((folder / "metrics.json").read_text())["train"] for folder in (other, only_run(outputs))]
    assert trained[0] == trained[1]
    anew = negopipe(*arguments, "evaluation.leading_setting=push", "rerun=true")
    assert anew.returncode == 0, anew.stderr
    assert "taken over" not in anew.stdout
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        query = "SELECT count(DISTINCT step) FROM metrics WHERE key = 'train/kl' GROUP BY run_uuid"
        assert connection.execute(query).fetchall() == [(6,)] * 3


@pytest.mark.slow
def test_any_episode_can_be_played_again(outputs: Path) -> None:
    done = negopipe(*SHORT, f"outputs={outputs}", "stages=[replay]", "episode=push/adaptive/2")
    assert done.returncode == 0, done.stderr
    as_before = "as evaluated, to the last bit" if "simulator compiled" in done.stdout else "as evaluated"
    assert f"push/adaptive/2: {as_before}" in done.stdout
    replays = {path.name for path in (only_run(outputs) / "replays").iterdir()}
    assert replays == {f"push_adaptive_2.{kind}" for kind in ("gif", "png", "xml")}


def test_an_episode_that_was_not_evaluated_is_named(outputs: Path, command: Command) -> None:
    code, _, err = command(*SHORT, f"outputs={outputs}", "stages=[replay]", "episode=push/fixed_6/4")
    assert code == 1
    (line,) = err.splitlines()
    assert "a setting of push, yield" in line
    assert "a number below 4, got push/fixed_6/4" in line


@pytest.mark.slow
def test_names_that_look_like_values_stay_names(outputs: Path, tmp_path: Path) -> None:
    short = {"kind": "fixed", "horizon_s": "0.0"}
    done = negopipe(
        *(*SMOKE, f"outputs={tmp_path}", f"checkpoint={only_run(outputs)}/checkpoint.safetensors"),
        *(f"+scenario.families.{name}=${{scenario.families.push}}" for name in ("NA", "12")),
        *("evaluation/baseline=[]", *(f"+evaluation.baselines.nan.{key}={value}" for key, value in short.items())),
        *('evaluation.settings=[NA,"12"]', "evaluation.leading_setting=NA", 'report.side_by_side=["nan"]'),
        *("stages=[evaluate,behaviour_map,report,replay]", "episode=12/nan/1"),
        *("behaviour_map.n_episodes=2", "behaviour_map.horizons_s=[0,6]", "report.animation_fps=2"),
    )
    assert done.returncode == 0, done.stderr
    folder = only_run(tmp_path)
    metrics = json.loads((folder / "metrics.json").read_text())["evaluation"]
    assert set(metrics) == {"NA", "12"}
    assert all(set(planners) == {"adaptive", "nan"} for planners in metrics.values())
    assert (folder / "report.html").is_file()
    assert (folder / "replays" / "12_nan_1.gif").is_file()
