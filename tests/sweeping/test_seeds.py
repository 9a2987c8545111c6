"""Training seeds together: rates, regret and intervals, from run folders that were made up."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from swept import make_run

from negopipe.sweeping import seeds
from negopipe.sweeping.compare import main
from negopipe.sweeping.groups import group_runs
from negopipe.sweeping.seeds import across_seeds, by_seed, by_style
from negopipe.sweeping.swept_runs import read_runs

N = 40
STYLES = np.tile([0.0, 6.0], N // 2)


def evaluate(folder: Path, n_failed: int, reward: float, shift_m: float = 0.0) -> None:
    """40 tasks of one setting: the policy fails in the first few, the fixed horizon against every style 0."""
    tables = []
    for planner, is_failed in (("adaptive", np.arange(N) < n_failed), ("fixed_2", STYLES == 0.0)):
        tables.append(
            pd.DataFrame(
                {
                    "planner": planner,
                    "setting": "mixture",
                    "episode": np.arange(N),
                    "social_start_distance_m": np.linspace(12, 18, N) + shift_m,
                    "style_horizon_s": STYLES,
                    "outcome": np.where(is_failed, "collision", "success"),
                    "driving_time_s": np.where(is_failed, np.nan, 10.0),
                    "reward": np.where(is_failed, -10.0, reward),
                }
            )
        )
    pd.concat(tables).to_csv(folder / "episodes.csv", index=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed, (n_failed, reward) in enumerate([(0, -3.0), (2, -4.0), (4, -5.0)], start=1):
        evaluate(make_run(tmp_path, seed, 0.1, reward), n_failed, reward)
    oracle = pd.DataFrame(
        {
            "setting": "mixture",
            "episode": np.arange(10),
            "social_start_distance_m": np.linspace(12, 18, N)[:10],
            "reward": -2.5,
        }
    )
    oracle.to_csv(tmp_path / "oracle.csv", index=False)
    return tmp_path / "yield"


def read_episodes(folder: Path) -> pd.DataFrame:
    return seeds.read_episodes(group_runs(read_runs([folder])))


def test_a_row_per_seed_setting_and_planner(folder: Path) -> None:
    table = by_seed(read_episodes(folder), pd.read_csv(folder.parent / "oracle.csv")).set_index(["planner", "seed"])
    assert len(table) == 6
    third = table.loc[("adaptive", 3)]
    assert third["n_episodes"] == N
    assert third["success_rate"] == 0.9
    assert third["success_rate_low"] == pytest.approx(0.7695, abs=1e-3)  # Wilson, 36 of 40
    assert third["collision_rate"] == 0.1
    assert third["reward"] == pytest.approx((36 * -5 + 4 * -10) / 40)
    assert third["n_regret_tasks"] == 10
    assert third["regret"] == pytest.approx((6 * 2.5 + 4 * 7.5) / 10)
    assert third["regret_low"] < third["regret"] < third["regret_high"]
    first = table.loc[("adaptive", 1)]
    assert (first["regret"], first["regret_low"], first["regret_high"]) == (0.5, 0.5, 0.5)


def test_across_seeds(folder: Path) -> None:
    table = across_seeds(by_seed(read_episodes(folder), None)).set_index("planner")
    assert table.loc["adaptive", "n_seeds"] == 3
    assert table.loc["adaptive", "success_rate"] == pytest.approx(0.95)
    assert table.loc["adaptive", "success_rate_low"] < 0.95 < table.loc["adaptive", "success_rate_high"]
    assert table.loc["fixed_2", ["success_rate_low", "success_rate_high"]].tolist() == [0.5, 0.5]
    assert "regret" not in table


def test_the_regret_of_a_style_is_over_its_tasks(folder: Path) -> None:
    oracle = pd.read_csv(folder.parent / "oracle.csv")
    table = by_style(read_episodes(folder), oracle).set_index(["style_s", "planner"])
    # of tasks 0, 2, .. 8 (style 0) seed 1 pays 0.5 too much; 2 fails in task 0, else 1.5; 3 in tasks 0 and 2, else 2.5
    per_task = [(0.5 + 7.5 + 7.5) / 3, (0.5 + 1.5 + 7.5) / 3, *3 * [(0.5 + 1.5 + 2.5) / 3]]
    assert table.loc[(0.0, "adaptive"), "regret"] == pytest.approx(np.mean(per_task))
    assert table.loc[(0.0, "adaptive"), "n_regret_tasks"] == 5
    assert table.loc[("all", "adaptive"), "n_regret_tasks"] == 10


def test_planners_that_are_not_trained_need_only_one_run(folder: Path) -> None:
    whole = by_style(read_episodes(folder))
    for path in sorted(folder.glob("seed*/episodes.csv"))[1:]:
        table = pd.read_csv(path)
        table[table["planner"] == "adaptive"].to_csv(path, index=False)
    pd.testing.assert_frame_equal(by_style(read_episodes(folder)), whole)


def test_styles_pool_the_seeds_and_compare_on_the_same_tasks(folder: Path) -> None:
    table = by_style(read_episodes(folder)).set_index(["style_s", "planner"])
    assert table.loc[(0.0, "fixed_2"), "success_rate"] == 0
    assert table.loc[(6.0, "fixed_2"), "success_rate"] == 1
    assert table.loc[(0.0, "adaptive"), "success_rate"] == pytest.approx(1 - 3 / 60)
    assert table.loc[(6.0, "fixed_2"), "lead"] == pytest.approx(-3 / 60)
    row = table.loc[("all", "fixed_2")]
    assert row["n_tasks"] == N
    assert row["lead"] == pytest.approx(0.95 - 0.5)
    assert row["lead_low"] < 0.45 < row["lead_high"]


def test_the_command_writes_the_tables_and_shows_that_over_seeds(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(folder), "--oracle", str(folder.parent / "oracle.csv"), "--only", "seeds"]) == 0
    said = capsys.readouterr().out
    target = folder.parent / "sweeps" / "yield"
    assert {path.name for path in target.iterdir()} == {"seeds.csv", "across.csv", "styles.csv"}
    assert "95.00 % [90.00, 100.00]" in said
    assert not [name for name in ("seeds", "across", "styles") if "group" in pd.read_csv(target / f"{name}.csv")]


def test_every_config_has_rows_of_its_own(folder: Path) -> None:
    assert main([str(folder), "--only", "seeds"]) == 0
    target = folder.parent / "sweeps" / "yield"
    alone = {name: pd.read_csv(target / f"{name}.csv") for name in ("seeds", "across", "styles")}
    evaluate(make_run(folder.parent, 1, 0.2, -3.0), 1, -3.0)
    assert main([str(folder), "--only", "seeds"]) == 0
    for name, own in alone.items():
        table = pd.read_csv(target / f"{name}.csv")
        assert table["group"].unique().tolist() == ["algorithm.rate=0.1", "algorithm.rate=0.2"]
        first = table[table["group"] == "algorithm.rate=0.1"].drop(columns="group")
        pd.testing.assert_frame_equal(first, own)


def test_one_seed_per_config_makes_no_table_over_seeds(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in sorted(folder.glob("seed*"))[1:]:
        path.rename(folder.parent / path.name)
    assert main([str(folder), "--only", "seeds"]) == 0
    assert "one per config: no table over seeds" in capsys.readouterr().out


def test_seeds_that_cannot_be_put_together_are_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def left_out() -> str:
        assert main([str(folder), "--only", "seeds"]) == 1
        return capsys.readouterr().out

    evaluate(make_run(folder.parent, 4, 0.1, -3.0), 0, -3.0, shift_m=0.5)
    assert "left out: seed4-0.1-3 drove other tasks than seed1-0.1-0" in left_out()
    evaluate(make_run(folder.parent, 1, 0.1, -3.0), 0, -3.0)
    assert "left out: a group must have one run per seed (--sweep picks some), got seeds 1, 1, 2, 3, 4" in left_out()
    for path in folder.glob("*/episodes.csv"):
        path.unlink()
    assert "left out: no run has been evaluated" in left_out()


@pytest.mark.parametrize("oracle", ["nowhere.csv", "other.csv"])
def test_an_oracle_of_other_tasks_is_refused(folder: Path, capsys: pytest.CaptureFixture[str], oracle: str) -> None:
    table = pd.read_csv(folder.parent / "oracle.csv").assign(social_start_distance_m=1.0)
    table.to_csv(folder.parent / "other.csv", index=False)
    assert main([str(folder), "--oracle", str(folder.parent / oracle)]) == 1
    assert capsys.readouterr().err.startswith("--oracle must be ")
