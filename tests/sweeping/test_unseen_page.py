import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from hand_driven import drive

from negopipe.config.root import RunConfig, as_mapping
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.trace import save_traces
from negopipe.sweeping import unseen
from negopipe.tracking.csv_file import write_csv
from negopipe.tracking.record import RunRecord, write_record

OUTCOMES = {
    "adaptive": ["success", "success", "success", "collision"],
    "fixed_6": ["success", "deadlock", "success", "success"],
    "cautious": ["success", "timeout", "collision", "collision"],
}


def episodes(outcomes: dict[str, list[str]]) -> pd.DataFrame:
    numbers = ("reward", "smallest_gap_m", "smallest_ttc_s", "largest_decel_mps2")
    rows = [
        {
            "planner": planner,
            "setting": "mixture",
            "episode": i,
            "outcome": outcome,
            "avoidable_by": "none",
            "passes_first": "ego",
        }
        | {"driving_time_s": 10.0 + i if outcome == "success" else float("nan"), "full_braking_count": 0}
        | dict.fromkeys(numbers, 1.0)
        for planner, own in outcomes.items()
        for i, outcome in enumerate(own)
    ]
    return pd.DataFrame(rows)


def make_run(
    outputs: Path,
    case: str,
    checkpoint: str,
    outcomes: dict[str, list[str]],
    action: str = "sample",
    layer: str = "none",
) -> None:
    folder = outputs / f"unseen-v1.{case}" / f"seed1-{checkpoint}-{action}-{layer}"
    folder.mkdir(parents=True)
    baselines = {"fixed_6": {"kind": "fixed", "horizon_s": 6.0}, "cautious": {"kind": "cautious"}}
    config = {"name": f"unseen-v1.{case}", "seed": 1, "checkpoint": checkpoint, "stages": ["evaluate"]}
    config |= {"evaluation": {"baselines": baselines, "action": action}, "safety": {"kind": layer}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    write_record(folder, RunRecord("key", "s", {}, {"evaluate": {"config": "c", "source": "s"}}))
    (folder / "metrics.json").write_text(json.dumps({}), encoding="utf-8")
    write_csv(folder / EPISODES_NAME, episodes(outcomes), EPISODES)


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    make_run(tmp_path, "bus", "a.safetensors", OUTCOMES)
    make_run(tmp_path, "night", "a.safetensors", {**OUTCOMES, "adaptive": ["success"] * 4})
    return tmp_path


def test_a_row_has_rates_and_differences_on_the_same_tasks(outputs: Path) -> None:
    assert unseen.main([str(outputs)]) == 0
    rows = pd.read_csv(outputs / "unseen.csv").set_index(["case", "planner"])
    bus = rows.loc[("bus", "adaptive")]
    assert bus["n_episodes"] == 4
    assert bus["success_rate"] == 0.75
    assert bus["success_low"] < 0.75 < bus["success_high"]
    assert bus["collision_rate"] == 0.25
    assert bus["solved_by_any"] == 1.0
    assert bus["success_vs_cautious"] == 0.5
    assert bus["collision_vs_cautious"] == -0.25
    assert bus["time_s_vs_cautious"] == 0.0  # where both arrive
    assert rows.loc[("bus", "fixed_6"), "deadlock_rate"] == 0.25
    assert rows.loc[("night", "adaptive"), "success_rate"] == 1.0


def test_the_means_count_every_case_alike(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unseen.main([str(outputs)])
    printed = capsys.readouterr().out
    assert "adaptive                 success  87.50%  collision 12.50%  2 cases" in printed
    page = (outputs / "unseen.html").read_text(encoding="utf-8")
    assert "adaptive: 87.5% success and 12.50% collisions on the mean." in page
    assert "at least 75.0% success and at most 25.0% collisions" in page
    means = pd.read_csv(outputs / "unseen_means.csv").set_index("planner")
    assert means.loc["adaptive", ["n_cases", "success_rate", "collision_rate"]].tolist() == [2, 0.875, 0.125]
    assert page.count("<svg") + page.count("image/svg+xml") == 2


def test_failures_are_counted_by_cause_and_one_of_a_case_is_filmed(outputs: Path, config: RunConfig) -> None:
    (folder,) = (outputs / "unseen-v1.bus").iterdir()
    written = yaml.safe_load((folder / "config.yaml").read_text())
    written |= {name: as_mapping(config)[name] for name in ("scenario", "planner")}
    (folder / "config.yaml").write_text(yaml.safe_dump(written))
    ways, still = (0.0, np.pi), (0.0, 0.0)
    policy = drive("collision", (0.0, 3.9), (2.0, 0.0), ways)
    rule = replace(drive("deadlock", (0.0, 4.5), still, ways), planner="cautious")
    save_traces(folder / "traces.npz", [policy, rule])
    assert unseen.main([str(outputs)]) == 0
    failed = pd.read_csv(outputs / "unseen_failures.csv").set_index("planner")
    assert failed["n_tasks"].to_dict() == {"adaptive": 1, "cautious": 1}
    assert failed["cause"].to_dict() == {
        "adaptive": "the ego drove into an oncoming vehicle at rest",
        "cautious": "nose to nose at rest",
    }
    page = (outputs / "unseen.html").read_text(encoding="utf-8")
    assert page.count("data:image/gif") == 1
    assert "failed in 1 of the 1 tasks whose drives are kept: 1 x the ego drove into an oncoming vehicle" in page


def test_several_checkpoints_are_told_apart_and_baselines_count_once(outputs: Path) -> None:
    make_run(outputs, "bus", "b.safetensors", {**OUTCOMES, "adaptive": ["collision"] * 4, "fixed_6": ["deadlock"] * 4})
    unseen.main([str(outputs)])
    rows = pd.read_csv(outputs / "unseen.csv").set_index(["case", "planner"])["success_rate"]
    assert rows["bus"].to_dict() == {"adaptive_1": 0.75, "fixed_6": 0.75, "cautious": 0.25, "adaptive_2": 0.0}


def test_two_ways_to_act_are_two_policies(outputs: Path) -> None:
    make_run(outputs, "bus", "a.safetensors", {**OUTCOMES, "adaptive": ["collision"] * 4}, action="greedy")
    unseen.main([str(outputs)])
    rows = pd.read_csv(outputs / "unseen.csv").set_index(["case", "planner"])["success_rate"]
    assert {rows["bus", "adaptive_1"], rows["bus", "adaptive_2"]} == {0.0, 0.75}


def test_runs_with_another_safety_layer_need_a_folder_of_their_own(
    outputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(outputs, "bus", "a.safetensors", OUTCOMES, layer="rss")
    assert unseen.main([str(outputs)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("safety.kind must be the same in all runs of a case, got ")
    assert said.endswith("for bus; give each its own outputs\n")


def test_a_folder_without_runs_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert unseen.main([str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("the folder must be <outputs>/<name> with runs in it, got ")
