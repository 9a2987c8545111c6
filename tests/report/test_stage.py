"""The stage: the files of a run become a report; what is missing is said in one line."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from devtools import BROWSER
from measured import FIXED_S
from page_in_browser import measure_page
from pydantic import TypeAdapter
from tracked import RecordedRun

from negopipe.errors import UserError
from negopipe.evaluation.behaviour_map import BEHAVIOUR_MAP
from negopipe.evaluation.comparison import regret, versus_adaptive
from negopipe.evaluation.episodes_file import EPISODES
from negopipe.evaluation.measures import summary
from negopipe.evaluation.replay import PolicyTrace
from negopipe.evaluation.trace import Trace, load_traces, save_traces
from negopipe.report import labels
from negopipe.report.page import ReportConfig
from negopipe.report.scene import scene_of
from negopipe.simulation.build_road import build_road
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.stages import report

CONF = Path(__file__).resolve().parents[2] / "conf"


class Evaluation:
    leading_setting, fixed_horizons_s = "push", FIXED_S


class Config:
    """Stands for the root config, as far as the stage reads it."""

    name, seed, runs = "push", 3, None
    curriculum = SimpleNamespace(stages=[SimpleNamespace(families={})])
    planner = SimpleNamespace(horizon_s=6.0)
    scenario: ScenarioConfig
    report: ReportConfig
    evaluation: Any = Evaluation()

    def __init__(self, **changed: Any) -> None:
        scenario = yaml.safe_load((CONF / "scenario" / "narrow_lane.yaml").read_text())
        del scenario["defaults"]
        self.scenario = TypeAdapter(ScenarioConfig).validate_json(json.dumps(scenario), strict=True)
        quick = {"figure_formats": ("svg",), "n_animations": 0, "side_by_side": (), "animation_fps": 2, "n_streets": 2}
        self.report = ReportConfig(**(quick | changed))


PLANNERS = ["adaptive", "fixed_0", "fixed_6"]


@pytest.fixture(scope="module")
def table(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["planner"].isin(PLANNERS)]


@pytest.fixture
def run(
    tmp_path: Path, traces: list[Trace], table: pd.DataFrame, history: pd.DataFrame, driven: pd.DataFrame
) -> RecordedRun:
    run = RecordedRun(tmp_path)
    evaluated(run, table, [trace for trace in traces if trace.planner in PLANNERS])
    history.to_csv(tmp_path / "history.csv", index=False)
    driven.to_csv(tmp_path / "training_episodes.csv", index=False)
    (tmp_path / "config.yaml").write_text("name: push\nseed: 3\n")
    return run


@pytest.fixture
def pushed(run: RecordedRun, traces: list[Trace], table: pd.DataFrame) -> RecordedRun:
    """The run with one setting only, whose report takes half the time."""
    own = [trace for trace in traces if trace.planner in PLANNERS and trace.setting == "push"]
    evaluated(run, table[table["setting"] == "push"], own)
    return run


def evaluated(run: RecordedRun, table: pd.DataFrame, traces: list[Trace]) -> None:
    """What the stage `evaluate` leaves."""
    save_traces(run.folder / "traces.npz", traces)
    table.to_csv(run.folder / "episodes.csv", index=False)
    measured = summary(table) | versus_adaptive(table) | regret(table)
    (run.folder / "metrics.json").write_text(json.dumps(measured, sort_keys=True))


def seen(traces: dict[str, list[Trace]]) -> dict[str, dict[int, PolicyTrace]]:
    """Made-up grids and probabilities for all episodes."""
    found = {}
    for setting, (adaptive, *_) in traces.items():
        grids = np.zeros((adaptive.n_steps.max(), 4, 84, 84), dtype=np.uint8)
        policy_trace = PolicyTrace(grids, np.full((len(grids), 4), 0.25), (0.0, 2.0, 4.0, 6.0), 1.0)
        found[setting] = dict.fromkeys(range(len(adaptive.n_steps)), policy_trace)
    return found


def test_the_report_is_written_and_logged(
    run: RecordedRun, driven: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "record_policies", lambda config, run, traces: seen(traces))
    report.run(Config(n_animations=1, side_by_side=("fixed_0", "fixed_6")), run)
    page = (run.folder / "report.html").read_text()
    for section in ("Results", "Planners compared", "Negotiations", "Animations", "Behaviour", "Training"):
        assert f"<h2>{section}</h2>" in page
    assert "<h2>Provenance</h2>" in page
    assert "name: push" in page
    images = re.findall(r'<img src="(data:image/[a-z+]+);', page)
    assert images.count("data:image/svg+xml") == 9
    # per setting: typical, lowest return and side by side; and the outcomes during training
    assert images.count("data:image/gif") == 7
    opening = page[: page.index('<p class="verdict">')]
    assert re.findall(r"<h3>(.+?)</h3>", opening) == ["Push, episode 2: adaptive, fixed 0\xa0s, fixed 6\xa0s"]
    assert run.artifacts == [
        ("claims.json", ""),
        ("figures", "figures"),
        ("animations", "animations"),
        ("report.html", ""),
    ]
    keys, steps = zip(*run.images, strict=True)
    assert set(keys) == {"training outcomes"}
    assert list(steps) == [round(i * driven["decisions"].max() / 10) for i in range(10)]
    assert len(run.tables["planners"]) == 2 * len(PLANNERS)
    assert set(run.tables["episodes"]["planner"]) == set(PLANNERS)
    claims = json.loads((run.folder / "claims.json").read_text())
    assert [claim["number"] for claim in claims] == list(range(1, 11))
    assert all(claim["words"].replace('"', "&#34;") in page for claim in claims)
    assert {claim["verdict"] for claim in claims[:9]} <= {"holds", "does not hold", "undecided"}
    assert claims[9]["verdict"] == "not tested"
    assert len(list((run.folder / "animations").glob("*.gif"))) == 7


@pytest.mark.slow
def test_a_planner_may_have_driven_the_first_tasks_only(pushed: RecordedRun, table: pd.DataFrame) -> None:
    traces = load_traces(pushed.folder / "traces.npz")
    few = [trace.first(3) if trace.planner == "fixed_6" else trace for trace in traces]
    save_traces(pushed.folder / "traces.npz", few)
    is_driven = (table["planner"] != "fixed_6") | (table["episode"] < 3)
    table[is_driven & (table["setting"] == "push")].to_csv(pushed.folder / "episodes.csv", index=False)
    report.run(Config(side_by_side=("fixed_0", "fixed_6"), animation_fps=1), pushed)
    page = (pushed.folder / "report.html").read_text()
    shown = {int(text) for text in re.findall(r"episode (\d+): adaptive, fixed", page)}
    assert shown
    assert max(shown) < 3


CASES: list[tuple[str, dict[str, tuple[str, float | None]]]] = [
    ("push", {}),
    ("push", {"fixed_6": ("fixed_6", 6.0)}),
    ("None", {"fixed_0": ("fixed_short", 0.0)}),
    ("12", {"fixed_0": ("nan", 0.0), "fixed_6": ("NA", None)}),
    ("push", {"fixed_0": ("12", 0.0), "fixed_6": ("fixed_2", 6.0)}),
]
"""A setting; which planner is there, what it is called, and the horizon that it keeps to, if any."""


@pytest.mark.parametrize(
    ("setting", "planners"),
    [case if case[0] == "12" else pytest.param(*case, marks=pytest.mark.slow) for case in CASES],
)
def test_any_planners_of_any_name_make_a_report(
    run: RecordedRun, traces: list[Trace], table: pd.DataFrame, setting: str, planners: dict
) -> None:
    """In one setting of one episode."""
    (run.folder / "history.csv").unlink()
    called = {"adaptive": "adaptive"} | {planner: name for planner, (name, _) in planners.items()}
    own = table[(table["setting"] == "push") & (table["episode"] == 0) & table["planner"].isin(called)]
    own = own.assign(planner=own["planner"].map(called), setting=setting)
    evaluated(
        run,
        own,
        [
            replace(trace.first(1), planner=called[trace.planner], setting=setting)
            for trace in traces
            if trace.setting == "push" and trace.planner in called
        ],
    )
    config = Config(side_by_side=tuple(name for name, _ in planners.values()), animation_fps=1)
    fixed_s = {name: horizon_s for name, horizon_s in planners.values() if horizon_s is not None}
    config.evaluation = SimpleNamespace(leading_setting=setting, fixed_horizons_s=fixed_s)
    report.run(config, run)
    page = (run.folder / "report.html").read_text()
    names = [labels.planner_label(name, fixed_s) for name, _ in planners.values()]
    assert all(f"{label}</th>" in page for label in names), names
    claims = json.loads((run.folder / "claims.json").read_text())
    if setting != "push" or not fixed_s:
        assert {claim["verdict"] for claim in claims} == {"not tested"}


@pytest.mark.skipif(BROWSER is None, reason="no browser is installed")
def test_a_browser_shows_it_all_without_errors_or_scrolling_sideways(run: RecordedRun) -> None:
    report.run(Config(animation_fps=1, side_by_side=("fixed_0",)), run)
    widths_px = (360, 1280)
    for width_px, measured in zip(widths_px, measure_page(run.folder / "report.html", widths_px), strict=True):
        assert measured["images"] > 8
        assert measured["broken"] == measured["overlaps"] == 0
        assert measured["shown"] <= measured["width"] <= width_px
        assert measured["said"] == []


def test_the_options_of_the_report_have_effects(pushed: RecordedRun) -> None:
    report.run(Config(figure_formats=("png",)), pushed)
    assert {path.suffix for path in (pushed.folder / "figures").glob("*.*")} == {".png"}
    page = (pushed.folder / "report.html").read_text()
    assert page.count("data:image/gif") == 1  # of the training, no episode
    assert "Learning curves" in page
    assert "Success rate by social style" not in page  # each setting has one style
    assert "Behaviour map" not in page


def test_figures_depend_on_the_files_of_the_run(run: RecordedRun, table: pd.DataFrame) -> None:
    varied = table.assign(style_horizon_s=table["episode"].mod(2) * 6.0)
    varied.to_csv(run.folder / "episodes.csv", index=False)
    (run.folder / "history.csv").unlink()
    unseen = dict.fromkeys(BEHAVIOUR_MAP.columns, 0) | {"setting": "push", "n_episodes": 1}
    cells = [
        unseen
        | {"ego_horizon_s": horizon, "success_rate": 1.0, "ego_passes_first_rate": 1.0, "smallest_gap_m": horizon}
        for horizon in (0.0, 6.0)
    ]
    pd.DataFrame(cells).to_csv(run.folder / "behaviour_map.csv", index=False)
    report.run(Config(), run)
    page = (run.folder / "report.html").read_text()
    assert "Success rate by social style" in page
    assert "Behaviour map" in page
    assert "Smaller gap: holds in 1 of 1 (push against 0 s)" in page
    assert "was not trained in this run" in page
    assert "Learning curves" not in page


def test_the_kind_of_the_file_knows_all_that_is_measured(table: pd.DataFrame) -> None:
    assert list(EPISODES.columns) == list(table.columns)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("episodes.csv", "planner,setting\nadaptive,push\n", "must have a column episode as the stage `evaluate`"),
        ("history.csv", "decisions,stage\nmany,full\n", "column decisions, row 1: must hold whole numbers, got many"),
        ("training_episodes.csv", "", "must be a table as the stage `train` writes it, got an empty file"),
        ("behaviour_map.csv", "setting\npush\n", "must have a column ego_horizon_s as the stage `behaviour_map`"),
    ],
)
def test_a_damaged_file_is_named(pushed: RecordedRun, name: str, text: str, line: str) -> None:
    (pushed.folder / name).write_text(text)
    with pytest.raises(UserError, match=re.escape(f"{pushed.folder / name}: {line}")):
        report.run(Config(), pushed)


@pytest.mark.parametrize("name", ["metrics.json", "episodes.csv", "traces.npz"])
def test_a_missing_file_names_the_stage_to_run(run: RecordedRun, name: str) -> None:
    (run.folder / name).unlink()
    with pytest.raises(UserError, match=rf"{name}: .*`evaluate`"):
        report.run(Config(), run)


def test_a_planner_that_was_not_evaluated_is_named(run: RecordedRun) -> None:
    named = r"must name planners of traces\.npz \(adaptive, fixed_0, fixed_6\), got fixed_3"
    with pytest.raises(UserError, match=named):
        report.run(Config(side_by_side=("fixed_3",)), run)


def test_planners_must_have_driven_the_same_tasks(run: RecordedRun) -> None:
    first, second, *others = load_traces(run.folder / "traces.npz")
    moved = replace(second, start_distance_m=second.start_distance_m + 1)
    save_traces(run.folder / "traces.npz", [first, moved, *others])
    with pytest.raises(UserError, match="adaptive and fixed_0 drove different tasks"):
        report.run(Config(), run)


def test_the_scene_is_the_road(run: RecordedRun) -> None:
    config = Config().scenario
    scene = scene_of(build_road(config), 1, 6.0)
    sigma, x, y, heading = scene.line_m.T
    assert (x == sigma).all()
    assert not y.any()
    assert not heading.any()
    lane, half_width = config.road.lane_offset_m, config.road.width_m / 2
    for side, d in zip((-1, 1), scene.route_d_m, strict=True):
        assert d[abs(x) < 6].tolist() == pytest.approx([0.0] * int((abs(x) < 6).sum()))
        is_outside = abs(x) > 6 + config.road.swerve_length_m
        assert d[is_outside].tolist() == pytest.approx([side * lane] * int(is_outside.sum()))
    assert scene.kerbs_m[:, 0].tolist() == [[x[0], -half_width], [x[0], half_width]]
    (corridor,) = scene.corridors_m
    assert corridor[:, [0, -1], 0].tolist() == [[-6.0, 6.0]] * 2
    assert scene.parked_cars.shape == (2 * config.road.n_parked_per_side, 5)
