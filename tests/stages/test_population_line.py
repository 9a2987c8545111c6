"""The whole line with several drivers on the other side, the trained policy among them."""

import json
from pathlib import Path

import pandas as pd
import pytest
from test_pipeline import negopipe, only_run

pytestmark = pytest.mark.slow  # every part of the line has tests of its own

DRIVERS = {"planner", "cautious", "self"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outputs = tmp_path_factory.mktemp("outputs")
    done = negopipe(
        "+experiment=smoke",
        f"outputs={outputs}",
        f"population/driver=[{','.join(sorted(DRIVERS))}]",
        "evaluation.n_episodes=12",
        "evaluation/baseline=[fixed_2,fixed_6,idm]",
        "n_threads=2",
    )
    assert done.returncode == 0, done.stderr
    return only_run(outputs)


def test_every_planner_met_the_same_drivers(folder: Path) -> None:
    table = pd.read_csv(folder / "episodes.csv")
    assert set(table["social_driver"]) == DRIVERS
    assert (table.groupby(["setting", "episode"])["social_driver"].nunique() == 1).all()
    has_style = table["style_horizon_s"].notna()
    assert (has_style == (table["social_driver"] == "planner")).all()


def test_results_are_split_by_driver(folder: Path) -> None:
    metrics = json.loads((folder / "metrics.json").read_text())["evaluation"]
    for planners in metrics.values():
        for values in planners.values():
            by_driver = values["by_driver"]
            assert set(by_driver) <= DRIVERS
            assert sum(each["n_episodes"] for each in by_driver.values()) == values["n_episodes"] == 12
            mean = sum(each["n_episodes"] * each["success_rate"] for each in by_driver.values()) / 12
            assert mean == pytest.approx(values["success_rate"])


def test_the_report_names_the_drivers(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert "style nan" not in page
    assert (folder / "figures").is_dir()
