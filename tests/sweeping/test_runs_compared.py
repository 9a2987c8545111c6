"""Runs compared: who belongs together, what they are called, and what is said of them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from swept import make_run

from negopipe.errors import UserError
from negopipe.sweeping.comparison import (
    compare,
    curriculum_claim,
    find_runs,
    group,
    read_groups,
    short_names,
)

N = 50


def evaluated(outputs: Path, seed: int, rate: float, success: float, distance_m: float = 12.0) -> Path:
    """A run whose policy succeeds in that share of the tasks."""
    folder = make_run(outputs, seed, rate, -8.0)
    is_success = np.arange(N) < success * N
    table = pd.DataFrame({"planner": "adaptive", "setting": "push", "episode": range(N), "style_horizon_s": 6.0})
    table = table.assign(social_start_distance_m=distance_m, outcome=np.where(is_success, "success", "deadlock"))
    table.assign(driving_time_s=8.0, reward=np.where(is_success, 2.0, -32.0)).to_csv(folder / "episodes.csv")
    history = pd.DataFrame({"decisions": [1000, 2000], "wall_s": [1.0, 2.0], "success_rate": 0.5, "return_mean": -9.0})
    history.to_csv(folder / "history.csv", index=False)
    return folder


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    for seed in (1, 2, 3):
        evaluated(tmp_path, seed, 0.1, 0.5 + 0.1 * seed)
        evaluated(tmp_path, seed, 0.2, 0.9)
    return tmp_path


def test_seeds_of_a_config_are_one_group_named_by_its_overrides(outputs: Path) -> None:
    groups = group(find_runs(outputs, "yie*"))
    assert {name: len(folders) for name, folders in groups.items()} == {
        "algorithm.rate=0.1": 3,
        "algorithm.rate=0.2": 3,
    }
    assert group(find_runs(outputs, "rates")) == groups  # by the tag of the sweep


def test_the_better_config_is_named_with_how_likely_it_is_better(outputs: Path) -> None:
    verdicts, (chapter,) = compare(read_groups(group(find_runs(outputs, "yield"))))
    assert verdicts[0][0] == "Push: algorithm.rate=0.2 has the highest reward of 2 configs."
    across, each = chapter.tables
    assert [row.cells[0].text for row in across.rows] == ["70.0", "90.0"]  # of 60, 70, 80 and three times 90 %
    assert [row.cells[3].text for row in across.rows] == ["50", "100"]
    assert [row.label for row in each.rows][:2] == ["algorithm.rate=0.1, seed 1", "algorithm.rate=0.1, seed 2"]
    assert each.rows[0].cells[0].interval


def test_a_config_may_have_driven_settings_of_its_own(outputs: Path) -> None:
    episodes = read_groups(group(find_runs(outputs, "yield")))
    is_first = episodes["group"] == "algorithm.rate=0.1"
    apart = episodes.assign(setting=np.where(is_first, "push", "mixture"))
    verdicts, chapters = compare(apart)
    assert [verdict for verdict, _ in verdicts] == [
        "Push: algorithm.rate=0.1, 3 seeds.",
        "Mixture: algorithm.rate=0.2, 3 seeds.",
    ]
    assert [len(chapter.tables[0].rows) for chapter in chapters] == [1, 1]


def stages(*n_iterations: int) -> dict:
    return {"stages": [{"name": f"stage {i}", "n_iterations": n} for i, n in enumerate(n_iterations)]}


def trained(outputs: Path, seed: int, success: float, curriculum: dict) -> None:
    folder = evaluated(outputs, seed, 0.1, success)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(config | {"curriculum": curriculum}))


@pytest.mark.parametrize(
    ("with_it", "without", "verdict"),
    [
        ([0.9, 0.8, 0.9], [0.1, 0.2, 0.3], "holds"),
        ([0.1, 0.2], [0.9, 0.8], "does not hold"),
        ([0.1], [0.9], "undecided"),
        ([0.1, 0.9], [0.2, 0.8], "undecided"),
    ],
)
def test_the_claim_on_the_curriculum_is_judged_where_the_runs_tell(
    tmp_path: Path, with_it: list[float], without: list[float], verdict: str
) -> None:
    for seed, success in enumerate(with_it):
        trained(tmp_path, seed, success, stages(10, 30))
    assert curriculum_claim(find_runs(tmp_path, "yield")) is None
    for seed, success in enumerate(without):
        trained(tmp_path, seed, success, stages(40))
    claim = curriculum_claim(find_runs(tmp_path, "yield"))
    assert claim is not None
    assert (claim.number, claim.verdict) == (10, verdict)
    more = 34 * (np.mean(with_it) - np.mean(without))
    assert claim.findings[1].value == pytest.approx(more)
    trained(tmp_path, 9, 0.5, stages(50))
    assert curriculum_claim(find_runs(tmp_path, "yield")) is None  # another number of decisions
    evaluated(tmp_path, 9, 0.2, 0.5)
    assert curriculum_claim(find_runs(tmp_path, "yield")) is None


def test_a_lead_that_chance_may_explain_is_said_to_be_none(tmp_path: Path) -> None:
    for rate, successes in {0.1: (0.5, 0.7), 0.2: (0.6, 0.7)}.items():
        for seed, success in enumerate(successes):
            evaluated(tmp_path, seed, rate, success)
    (head, detail), *_ = compare(read_groups(group(find_runs(tmp_path, "yield"))))[0]
    assert head.endswith(
        "rate=0.2 has the highest reward of 2 configs, but not clearly higher than algorithm.rate=0.1."
    )
    assert "one of algorithm.rate=0.1 in 62 % [0, 100] of the pairs" in detail


def test_long_names_become_letters() -> None:
    assert short_names(["a=1", "a=2"]) == {"a=1": "a=1", "a=2": "a=2"}
    assert list(short_names(["a=1", "b" * 40]).values()) == ["A", "B"]


def test_what_cannot_be_compared_is_said(outputs: Path) -> None:
    with pytest.raises(UserError, match=r"runs must match .* among yield, got nothing"):
        find_runs(outputs, "nothing")
    evaluated(outputs, 4, 0.2, 0.9, distance_m=13.0)
    with pytest.raises(UserError, match="drove other tasks"):
        read_groups(group(find_runs(outputs, "yield")))
