"""Tables: a row per planner, units, intervals, and the best number of a column."""

from measured import FIXED_S, measures, versus

from negopipe.report.tables import Cell, n_episodes, tables

MEASURES = {"adaptive": measures(0.9, 0.1, 14.0), "fixed_0": measures(0.0, 1.0, None)}

REGRET = (("adaptive", 0.5), ("fixed_0", 5.75))


def test_rates_have_intervals_and_the_best_is_marked() -> None:
    ended, *_ = tables(MEASURES, {"fixed_0": versus(-0.9)}, {}, FIXED_S)
    assert ended.columns[0] == "success [%]"
    adaptive, fixed = ended.rows
    assert adaptive.label == "adaptive"
    assert adaptive.cells[0] == Cell("90.0", "80.0 to 100.0", True)
    assert fixed.cells[0] == Cell("0.0", "0.0 to 10.0", False)
    timeout = adaptive.cells[2]
    assert (timeout.interval, timeout.is_best) == ("", False)


def test_a_missing_measure_is_printed_as_none() -> None:
    _, drove, *_ = tables(MEASURES, {"fixed_0": versus(-0.9)}, {}, FIXED_S)
    column = drove.columns.index("driving time [s]")
    assert [row.cells[column].text for row in drove.rows] == ["14.00", "none"]
    assert not any(cell.is_best for row in drove.rows for cell in row.cells)


def test_differences_carry_their_sign_and_interval() -> None:
    *_, compared = tables(MEASURES, {"fixed_0": versus(-0.9)}, {}, FIXED_S)
    success, time, _ = compared.rows[0].cells
    minus = "\N{MINUS SIGN}"
    assert success == Cell(f"{minus}90.0", f"{minus}95.0 to {minus}85.0")
    assert (time.text, time.interval) == ("none", "")
    assert len(tables({"adaptive": MEASURES["adaptive"]}, {}, {}, FIXED_S)) == 3


def test_the_regret_is_shown_where_the_oracle_drove() -> None:
    regrets = {name: {"value": value, "low": value - 0.1, "high": value + 0.1, "n_tasks": 64} for name, value in REGRET}
    *_, regret = tables(MEASURES, {}, regrets, FIXED_S)
    adaptive, fixed = regret.rows
    assert adaptive.cells == [Cell("0.50", "0.40 to 0.60", True), Cell("64")]
    assert fixed.cells[0] == Cell("5.75", "5.65 to 5.85", False)


def test_equal_numbers_are_not_marked() -> None:
    ended, *_ = tables(
        {"adaptive": measures(1.0, 0.0, 8.0), "fixed_0": measures(1.0, 0.0, 9.0)}, {"fixed_0": versus(0)}, {}, FIXED_S
    )
    assert not any(row.cells[0].is_best for row in ended.rows)


def test_planners_with_fewer_episodes_are_named() -> None:
    assert n_episodes(MEASURES, FIXED_S) == "100 episodes each"
    few = MEASURES | {"level_k": measures(1.0, 0.0, 9.0, n=8)}
    assert n_episodes(few, FIXED_S) == "100 episodes each (level k 8, the first ones)"
