"""The registry of measures: one entry feeds metrics.json, the report, the terminal, the charts and the differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from test_metrics import make_trace

from negopipe.evaluation import comparison, episodes_file, measures
from negopipe.evaluation.episodes_file import COLUMNS, EPISODES, Drives, EpisodeColumn, episodes
from negopipe.evaluation.measure import Measure, itself, mean, share, share_with_interval
from negopipe.report.tables import tables
from negopipe.stages.evaluate import charts, terminal_table

FIXED_S = {"fixed_2": 2.0}
SPEED = Measure(
    name="largest_speed_mps",
    label="largest speed",
    unit="m/s",
    meaning="mean largest speed of the ego",
    column="largest_speed_mps",
    decimals=2,
    better="higher",
    table="driving",
    is_charted=True,
    compared=itself,
)
SPEED_COLUMN = EpisodeColumn(
    "largest_speed_mps", float, lambda drives: drives.trace.speed_mps[:, :, 0].max(0), "largest speed of the ego"
)


def drives_of(planner: str, speed_mps: float) -> Drives:
    trace = replace(make_trace([speed_mps] * 4, 3, (2, 3), "success"), planner=planner)
    return Drives(trace, braking_mps2=8.0, plan_s=6.0)


def evaluated() -> tuple[pd.DataFrame, dict[str, Any]]:
    """Episodes and metrics of two planners in one task."""
    table = pd.concat([episodes(drives_of("adaptive", 5.0)), episodes(drives_of("fixed_2", 4.0))], ignore_index=True)
    return table, measures.summary(table) | comparison.versus_adaptive(table)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """A measure of a new column, added by its two entries."""
    monkeypatch.setattr(episodes_file, "COLUMNS", (*COLUMNS, SPEED_COLUMN))
    monkeypatch.setattr(measures, "MEASURES", (*measures.MEASURES, SPEED))


def test_an_added_measure_is_in_the_summary_and_the_differences(registered: None) -> None:
    table, metrics = evaluated()
    assert list(table.columns) == [*EPISODES.columns, "largest_speed_mps"]
    assert metrics["evaluation"]["push"]["adaptive"]["largest_speed_mps"] == 5.0
    assert metrics["versus_adaptive"]["push"]["fixed_2"]["largest_speed_mps"]["value"] == -1.0


def test_an_added_measure_is_in_the_tables_of_the_report(registered: None) -> None:
    _, metrics = evaluated()
    _, driving, _, differences = tables(metrics["evaluation"]["push"], metrics["versus_adaptive"]["push"], {}, FIXED_S)
    assert driving.columns[-1] == differences.columns[-1] == "largest speed [m/s]"
    assert [(row.cells[-1].text, row.cells[-1].is_best) for row in driving.rows] == [("5.00", True), ("4.00", False)]
    assert differences.rows[0].cells[-1].text == "\N{MINUS SIGN}1.00"


def test_an_added_measure_is_charted_and_on_the_terminal(registered: None) -> None:
    _, metrics = evaluated()
    assert charts(metrics)["evaluation/push/fixed_2/largest_speed_mps"] == 4.0
    heading, adaptive, fixed = terminal_table(metrics)
    assert heading.endswith("largest speed")
    assert adaptive.endswith("5.00 m/s")
    assert fixed.endswith("4.00 m/s")


def test_measures_are_of_columns_of_the_file_and_have_names_of_their_own() -> None:
    assert {measure.column for measure in measures.MEASURES} <= {column.name for column in COLUMNS}
    _, metrics = evaluated()
    keys = [key for m in measures.MEASURES for key in (m.name, *m.bounds)]
    assert len(set(keys)) == len({m.name for m in measures.MEASURES}) + 2 * len({m.stem for m in measures.MEASURES})
    assert set(metrics["evaluation"]["push"]["adaptive"]) <= {"n_episodes", *keys}


def test_the_table_has_the_named_columns_in_the_order_of_the_file() -> None:
    assert list(episodes(drives_of("adaptive", 5.0), ["reward", "outcome"])) == ["outcome", "reward"]
    assert list(episodes(drives_of("adaptive", 5.0))) == list(EPISODES.columns)


def test_aggregates_by_hand() -> None:
    outcome = pd.Series(["success", "deadlock", "timeout", "success"])
    assert share("deadlock", "timeout")(outcome) == 0.5
    estimate = share_with_interval("success")(outcome)
    assert not isinstance(estimate, float | None)
    assert estimate.low < estimate.value == 0.5 < estimate.high
    assert mean(pd.Series([1.0, np.nan, 3.0])) == 2.0
    assert mean(pd.Series([np.nan])) is None


def test_values_are_shown_with_their_unit() -> None:
    by_name = {measure.name: measure for measure in measures.MEASURES}
    assert by_name["success_rate"].text(0.934) == "93.4 %"
    assert by_name["driving_time_s"].text(None) == "-"
    assert by_name["reward"].text(-12.0) == "-12.00"
    assert by_name["reward"].heading == "reward"
