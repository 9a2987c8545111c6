"""The page over many runs: verdicts, tables, the claim on the curriculum, from run folders that were made up."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from devtools import BROWSER
from page_in_browser import measure_page
from swept import make_run

from negopipe.evaluation.hypothesis import Claim
from negopipe.sweeping import comparison_page
from negopipe.sweeping.compare import main
from negopipe.sweeping.comparison_page import comparable, compare
from negopipe.sweeping.curriculum_claim import curriculum_claim
from negopipe.sweeping.groups import LONGEST_NAME, LeftOut, group_runs
from negopipe.sweeping.seeds import read_episodes
from negopipe.sweeping.swept_runs import read_runs
from negopipe.tracking.record import RunRecord, write_record

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


def policies(outputs: Path) -> pd.DataFrame:
    return comparable(read_episodes(group_runs(read_runs([outputs / "yield"]))))


def test_the_better_config_is_named_with_how_likely_it_is_better(outputs: Path) -> None:
    verdicts, (chapter,) = compare(policies(outputs))
    assert verdicts[0][0] == "Push: algorithm.rate=0.2 has the highest reward of 2 configs."
    across, each = chapter.tables
    assert [row.cells[0].text for row in across.rows] == ["70.0", "90.0"]  # of 60, 70, 80 and three times 90 %
    assert [row.cells[3].text for row in across.rows] == ["50", "100"]
    assert [row.label for row in each.rows][:2] == ["algorithm.rate=0.1, seed 1", "algorithm.rate=0.1, seed 2"]
    assert each.rows[0].cells[0].interval


def test_a_config_may_have_driven_settings_of_its_own(outputs: Path) -> None:
    episodes = policies(outputs)
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


def claim_of(outputs: Path) -> Claim | None:
    groups = group_runs(read_runs([outputs / "yield"]))
    return curriculum_claim(groups, read_episodes(groups))


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
    assert claim_of(tmp_path) is None
    for seed, success in enumerate(without):
        trained(tmp_path, seed, success, stages(40))
    claim = claim_of(tmp_path)
    assert claim is not None
    assert (claim.number, claim.verdict) == (10, verdict)
    more = 34 * (np.mean(with_it) - np.mean(without))
    assert claim.findings[1].value == pytest.approx(more)
    trained(tmp_path, 9, 0.5, stages(50))
    assert claim_of(tmp_path) is None  # another number of decisions
    evaluated(tmp_path, 9, 0.2, 0.5)
    assert claim_of(tmp_path) is None


def test_a_lead_that_chance_may_explain_is_said_to_be_none(tmp_path: Path) -> None:
    for rate, successes in {0.1: (0.5, 0.7), 0.2: (0.6, 0.7)}.items():
        for seed, success in enumerate(successes):
            evaluated(tmp_path, seed, rate, success)
    (head, detail), *_ = compare(policies(tmp_path))[0]
    assert head.endswith(
        "rate=0.2 has the highest reward of 2 configs, but not clearly higher than algorithm.rate=0.1."
    )
    assert "one of algorithm.rate=0.1 in 62 % [0, 100] of the pairs" in detail


def test_runs_that_cannot_be_compared_are_left_out(outputs: Path) -> None:
    for seed in (1, 2, 3):
        evaluated(outputs, seed, 0.4, 0.9, distance_m=13.0)
    with pytest.raises(LeftOut, match="the runs must have driven the same tasks, got others in push, episode 0"):
        policies(outputs)


def test_one_run_has_no_page(tmp_path: Path) -> None:
    evaluated(tmp_path, 1, 0.1, 0.9)
    with pytest.raises(LeftOut, match="one run only is evaluated"):
        policies(tmp_path)


@pytest.fixture
def page(outputs: Path) -> Path:
    assert main([str(outputs / "yield"), "--only", "page"]) == 0
    return outputs / "sweeps" / "yield" / "report.html"


@pytest.mark.skipif(BROWSER is None, reason="no browser is installed")
def test_a_browser_shows_it_without_scrolling_sideways(long_names: None, page: Path) -> None:
    """Long names of configs stand in two tables beside each other, or below each other where there is no room."""
    widths_px = (360, 1100, 1280)
    for width_px, measured in zip(widths_px, measure_page(page, widths_px), strict=True):
        assert measured["broken"] == measured["overlaps"] == 0
        assert measured["shown"] <= measured["width"] <= width_px
        assert measured["said"] == []


@pytest.fixture
def long_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as they may be without becoming letters."""
    longest = {"algorithm.rate=0.1": "a" * LONGEST_NAME, "algorithm.rate=0.2": "b" * LONGEST_NAME}
    monkeypatch.setattr(comparison_page, "short_names", lambda names: {name: longest[name] for name in names})


def test_the_page_holds_tables_curves_and_how_it_was_made(page: Path) -> None:
    text = page.read_text()
    for part in (
        "Push: algorithm.rate=0.2 has the highest reward",
        "Over seeds",
        "Every seed",
        "algorithm.rate=0.2, seed 3",
        "Learning curves",
        "more reward than the first",
        "python -m negopipe.sweeping.compare",
        "<dt>seed</dt><dd>1, 2, 3</dd>",
        "# seed1-0.1-0; the other runs differ from it in seed, algorithm.rate",
    ):
        assert part in text
    assert "The paper's claims" not in text
    assert not (page.parent / "claims.json").exists()


def test_configs_with_long_overrides_are_explained(tmp_path: Path) -> None:
    for rate in (0.1, 0.2):
        tags = {"overrides": f"algorithm.rate={rate} algorithm.some_very_long_key_of_it=1{rate}"}
        folder = evaluated(tmp_path, 1, rate, 0.9)
        write_record(folder, RunRecord("key", "s", tags, {}))
    assert main([str(tmp_path / "yield"), "--only", "page"]) == 0
    text = (tmp_path / "sweeps" / "yield" / "report.html").read_text()
    assert "</span>B</th><td>algorithm.rate=0.2 algorithm.some_very_long_key_of_it=10.2</td>" in text


def test_the_claim_on_the_curriculum_is_written_where_it_can_be_judged(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        trained(tmp_path, seed, 0.9, stages(10, 30))
        trained(tmp_path, seed, 0.1, stages(40))
    assert main([str(tmp_path / "yield"), "--only", "page"]) == 0
    target = tmp_path / "sweeps" / "yield"
    (claim,) = json.loads((target / "claims.json").read_text())
    assert (claim["number"], claim["verdict"]) == (10, "holds")
    assert "The paper's claims" in (target / "report.html").read_text()
