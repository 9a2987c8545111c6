"""Learning curves of a sweep, from run folders that were made up."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from swept import make_run

from negopipe.sweeping.learning_curves import learning_curves, main, read_curves


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


def test_the_command_writes_table_and_figure(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder), "--by", "algorithm.rate"]) == 0
    target = folder.parent / "sweeps" / "yield"
    assert {path.name for path in target.iterdir()} == {f"learning_curves.{kind}" for kind in ("csv", "png", "svg")}
    assert main([str(folder), "--by", "algorithm.nothing"]) == 1
    assert "got algorithm.nothing" in capsys.readouterr().err
    for history in folder.glob("*/history.csv"):
        history.unlink()
    assert main([str(folder), "--by", "algorithm.rate"]) == 1
    assert "no run in it has a history.csv" in capsys.readouterr().err


def test_the_figure_can_be_drawn_again_from_its_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder), "--by", "algorithm.rate", "--every", "10"]) == 0
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
    assert main([str(folder)]) == 1
    assert "--by must be keys of the config" in capsys.readouterr().err
