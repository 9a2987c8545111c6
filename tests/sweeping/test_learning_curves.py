"""Learning curves of a sweep, from run folders that were made up."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scripts import JOBS
from swept import make_run

from negopipe.sweeping import learning_curves as curves
from negopipe.sweeping.compare import main
from negopipe.sweeping.groups import group_runs
from negopipe.sweeping.learning_curves import COLORS, COLUMNS, CURVES, drawn_groups, learning_curves
from negopipe.sweeping.swept_runs import read_runs
from negopipe.tracking.csv_file import read_csv


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two rates with two seeds each; the larger rate learns twice as fast."""
    decisions = np.arange(1, 31) * 1000
    for rate in (0.1, 0.2):
        for seed in (1, 2):
            success = 1 - np.exp(-decisions * rate / 1000 - 0.1 * seed)
            history = pd.DataFrame({"decisions": decisions, "wall_s": decisions / 500, "success_rate": success})
            history = history.assign(return_mean=-32 + 24 * success, entropy=1.0)
            history.loc[0, ["success_rate", "return_mean"]] = np.nan  # no episode was over yet
            history.to_csv(make_run(tmp_path, seed, rate, -8.0) / "history.csv", index=False)
    return tmp_path / "yield"


def read_curves(folder: Path, by: list[str]) -> pd.DataFrame:
    runs = read_runs([folder])
    return curves.read_curves(runs, group_runs(runs, by))


def test_runs_are_grouped_by_keys_of_their_config(folder: Path) -> None:
    table = read_curves(folder, ["algorithm.rate", "reward.kind"])
    assert set(table["group"]) == {"0.1, paper", "0.2, paper"}
    assert table.groupby(["group", "seed"]).size().tolist() == [30] * 4


def test_lines_are_means_in_the_range_of_the_seeds(folder: Path) -> None:
    figure = learning_curves(read_curves(folder, ["algorithm.rate"]))
    panels = figure.get_axes()
    assert [axis.get_xlabel() for axis in panels] == ["decisions [thousands]", "wall time [min]"] * 2
    slow, fast = panels[0].get_lines()
    assert slow.get_label() == "0.1 (2 seeds)"
    x, y = np.asarray(slow.get_xdata()), np.asarray(slow.get_ydata())
    expected = [1 - np.exp(-x * 0.1 - 0.1 * seed) for seed in (1, 2)]
    np.testing.assert_allclose(y, np.mean(expected, axis=0), atol=0.01)
    assert (np.asarray(fast.get_ydata()) > y).all()


def test_a_sweep_too_short_for_an_episode_has_empty_panels(folder: Path) -> None:
    table = read_curves(folder, ["algorithm.rate"]).assign(success_rate=np.nan, return_mean=np.nan)
    assert not any(axis.get_lines() for axis in learning_curves(table).get_axes())


def test_runs_of_one_seed_are_lines_of_their_own(folder: Path) -> None:
    """Rates and seeds differ within the only group."""
    table = read_curves(folder, ["reward.kind"])
    label = learning_curves(table).get_axes()[0].get_lines()[0].get_label()
    assert label == "paper (4 runs)"


def test_a_run_that_ended_early_does_not_shorten_the_curve(folder: Path) -> None:
    table = read_curves(folder, ["algorithm.rate"])
    is_stopped = (table["group"] == "0.1") & (table["seed"] == 2) & (table["decisions"] > 3000)
    slow, _ = learning_curves(table[~is_stopped]).get_axes()[0].get_lines()
    assert slow.get_label() == "0.1 (1 seed)"
    assert np.max(np.asarray(slow.get_xdata())) == 30.0


def test_of_many_groups_those_with_the_highest_return_are_drawn(folder: Path) -> None:
    one = read_curves(folder, ["reward.kind"]).query("seed == 1").head(30)
    last = np.arange(2 * len(COLORS))[::-1]
    table = pd.concat([one.assign(group=f"g{i}", return_mean=one["return_mean"] + i) for i in last])
    assert drawn_groups(table) == [f"g{i}" for i in last[: len(COLORS)]]
    assert len(learning_curves(table).get_axes()[0].get_lines()) == len(COLORS)


def test_the_command_writes_table_and_figure(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder), "--by", "algorithm.rate", "--only", "curves"]) == 0
    target = folder.parent / "sweeps" / "yield"
    assert {path.name for path in target.iterdir()} == {f"learning_curves.{kind}" for kind in ("csv", "png", "svg")}
    assert pd.read_csv(target / "learning_curves.csv")["group"].unique().tolist() == [0.1, 0.2]
    assert main([str(folder), "--only", "curves"]) == 0
    names = pd.read_csv(target / "learning_curves.csv")["group"].unique().tolist()
    assert names == ["algorithm.rate=0.1", "algorithm.rate=0.2"]
    assert main([str(folder), "--by", "algorithm.nothing"]) == 1
    assert capsys.readouterr().err.endswith("got algorithm.nothing\n")
    for history in folder.glob("*/history.csv"):
        history.unlink()
    assert main([str(folder), "--only", "curves"]) == 1
    assert "left out: no run has a history.csv" in capsys.readouterr().out


def test_the_figure_can_be_drawn_again_from_its_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder), "--by", "algorithm.rate", "--every", "10", "--only", "curves"]) == 0
    target = folder.parent / "sweeps" / "yield"
    table = pd.read_csv(target / "learning_curves.csv")
    assert table.groupby("group")["decisions"].unique().map(list).tolist() == [[10_000, 20_000, 30_000]] * 2
    drawn = (target / "learning_curves.png").read_bytes()
    (target / "learning_curves.png").unlink()
    assert main([str(target / "learning_curves.csv")]) == 0
    assert (target / "learning_curves.png").read_bytes() == drawn
    table.drop(columns="seed").to_csv(target / "other.csv", index=False)
    assert main([str(target / "other.csv")]) == 1
    assert "other.csv: must have a column seed" in capsys.readouterr().err
    assert main([str(target / "none.csv")]) == 1
    assert "none.csv: no such file" in capsys.readouterr().err
    assert main([str(target / "learning_curves.csv"), "--every", "2"]) == 1
    assert "takes no options" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted((JOBS / "results").glob("*_curves.csv")), ids=lambda path: path.stem)
def test_the_curves_of_the_published_results_can_be_drawn_again(path: Path, tmp_path: Path) -> None:
    table = read_csv(path, CURVES, COLUMNS)
    assert (table["group"] != "").all()
    assert len(table.drop_duplicates(["group", "seed", "decisions"])) == len(table)
    copy = tmp_path / path.name
    copy.write_bytes(path.read_bytes())
    assert main([str(copy)]) == 0
    assert copy.with_suffix(".png").is_file()
    assert copy.with_suffix(".svg").is_file()
