"""A sweep's table, figure and best config, from run folders that were made up."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from swept import KEYS, make_run

from negopipe.sweeping.compare import main
from negopipe.sweeping.parallel_coordinates import parallel_coordinates
from negopipe.sweeping.run_table import tabulate
from negopipe.sweeping.swept_runs import differing_keys, flat, read_runs
from negopipe.tracking.record import RunRecord, write_record


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    """Three rates with two seeds each, one of them without an objective."""
    for rate, rewards in {0.1: (-6.0, -8.0), 0.2: (-3.0, None), 0.4: (-9.0, -9.0)}.items():
        for seed, reward in enumerate(rewards, start=1):
            make_run(tmp_path, seed, rate, reward, finished=["train"] if reward is None else ["train", "evaluate"])
    return tmp_path


def test_seeds_of_a_config_are_one_row_the_best_first(outputs: Path) -> None:
    runs = read_runs([outputs / "yield"])
    assert differing_keys(runs) == ["algorithm.rate"]
    table = tabulate(runs, KEYS)
    assert table["algorithm.rate"].tolist() == [0.2, 0.1, 0.4]
    assert table["objective"].tolist() == [-3.0, -7.0, -9.0]
    assert table["objective_std"].tolist()[1:] == [pytest.approx(2**0.5), 0.0]
    assert np.isnan(table["objective_std"][0])
    assert table["seeds"].tolist() == [1, 2, 2]
    assert table["status"].tolist() == ["1 of 2 finished", "finished", "finished"]
    assert table["runs"][1].split()[0].startswith("seed1-0.1")
    assert tabulate(runs, KEYS, minimize=True)["algorithm.rate"].tolist() == [0.4, 0.1, 0.2]


def test_a_run_without_an_objective_comes_last(outputs: Path) -> None:
    make_run(outputs, 1, 0.9, None, finished=[])
    table = tabulate(read_runs([outputs / "yield"]), KEYS)
    assert table["algorithm.rate"].tolist()[-1] == 0.9
    assert table["status"].tolist()[-1] == "unfinished"
    assert table["seeds"].tolist()[-1] == 0


def test_what_changes_no_result_makes_no_column(outputs: Path) -> None:
    make_run(outputs, 3, 0.1, -1.0, n_threads=7, outputs="elsewhere", tracking={"uri": "x"}, stages=["train"])
    assert differing_keys(read_runs([outputs / "yield"])) == ["algorithm.rate"]


def test_a_key_that_a_run_lacks_differs(outputs: Path) -> None:
    make_run(outputs, 1, 0.1, -1.0, dynamics={"lag_s": 0.1})
    table = tabulate(read_runs([outputs / "yield"]), KEYS)
    assert table["dynamics.lag_s"].tolist() == [0.1, None, None, None]


def test_what_follows_from_the_kind_of_algorithm_is_not_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    acktr = {"kind": "acktr", "clip": 0.1, "advantage": {"kind": "k_step", "k": 5}}
    ppo = {"kind": "ppo", "epochs": 4, "advantage": {"kind": "gae"}}
    for seed, algorithm in enumerate((acktr, ppo, ppo | {"rate": 0.5}), start=1):
        make_run(tmp_path, seed, 0.0, -1.0, algorithm={"rate": 0.1} | algorithm)
    assert main([str(tmp_path / "yield"), "--only", "table"]) == 0
    header = capsys.readouterr().out.partition("└")[0]
    assert "kind" in header
    assert "rate" in header
    assert not any(word in header for word in ("clip", "epochs", "advantage"))


def test_lists_of_mappings_are_flat_and_others_whole() -> None:
    tree = {"stages": [{"n": 1}, {"n": 2}], "horizons": [1, 2], "none": [], "a": {}}
    assert flat(tree) == {"stages.0.n": 1, "stages.1.n": 2, "horizons": [1, 2], "none": [], "a": {}}


def test_a_command_writes_table_and_figure_and_prints_what_to_paste(
    outputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(outputs / "yield"), "--only", "table"]) == 0
    shown = capsys.readouterr().out
    assert "  python -m negopipe +experiment=yield algorithm.rate=0.2\n" in shown
    target = outputs / "sweeps" / "yield"
    assert pd.read_csv(target / "summary.csv")["objective"].tolist() == [-3.0, -7.0, -9.0]
    assert (target / "parallel_coordinates.png").read_bytes().startswith(b"\x89PNG")
    assert "objective" in (target / "parallel_coordinates.svg").read_text(encoding="utf-8")
    assert main([str(outputs / "yield"), "--minimize", "--only", "table"]) == 0
    assert "algorithm.rate=0.4\n" in capsys.readouterr().out


def test_another_objective_and_one_sweep_only(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(outputs, 1, 0.7, -1.0, tags={"sweep": "other", "overrides": "'name=a b' algorithm.rate=0.7"})
    assert main([str(outputs / "yield"), "--sweep", "other", "--objective", KEYS[0], "--only", "table"]) == 0
    assert "  python -m negopipe 'name=a b' algorithm.rate=0.7\n" in capsys.readouterr().out
    assert (outputs / "sweeps" / "other" / "summary.csv").exists()
    assert not (outputs / "sweeps" / "other" / "parallel_coordinates.png").exists(), "nothing differs in one run"
    assert main([str(outputs / "yield"), "--objective", "evaluation.nothing", "--only", "table"]) == 0
    assert "best       none: no run has all of evaluation.nothing" in capsys.readouterr().out


def test_overrides_that_are_not_recorded_are_made_of_what_differs(
    outputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(outputs, 1, 0.7, -1.0, tags={}, reward={"kind": "strict", "list": [1, 2]})
    assert main([str(outputs / "yield"), "--only", "table"]) == 0
    expected = "  python -m negopipe algorithm.rate=0.7 reward.kind=strict 'reward.list=[1, 2]'\n"
    assert expected in capsys.readouterr().out


def test_what_was_run_later_in_the_best_runs_folder_is_not_its_command(
    outputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_run(outputs, 1, 0.7, -1.0, finished=[])
    made = {
        "train": "stages=[train] seed=1",
        "evaluate": "stages=[evaluate] seed=1",
        "replay": "stages=[replay] seed=1",
    }
    finished = {stage: {"config": "c", "source": "s", "overrides": text} for stage, text in made.items()}
    write_record(folder, RunRecord("key", "s", {"overrides": made["replay"]}, finished))
    assert main([str(outputs / "yield"), "--only", "table"]) == 0
    expected = "\n\n  python -m negopipe 'stages=[train]'\n  python -m negopipe 'stages=[evaluate]'\n\n"
    assert capsys.readouterr().out.endswith(expected)


def test_a_command_without_overrides_is_recorded(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(outputs, 1, 0.7, -1.0, tags={"overrides": ""})
    assert main([str(outputs / "yield"), "--only", "table"]) == 0
    shown = capsys.readouterr().out
    assert shown.endswith("\n\n  python -m negopipe\n\n")
    assert "not recorded" not in shown


def test_the_figure_has_an_axis_per_key_and_one_for_the_objective() -> None:
    table = pd.DataFrame(
        {
            "algorithm.kl_clip": [1e-4, 1e-2, 1e-3, 1e-3],
            "policy.horizons_s": [[2.0], [2.0], [0.0, 2.0, 4.0, 6.0], None],
            "objective": [1.0, 3.0, 2.0, np.nan],
        }
    )
    figure = parallel_coordinates(table, ["algorithm.kl_clip", "policy.horizons_s"], "objective")
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_xticklabels()] == [
        "kl_clip\n(algorithm)",
        "horizons_s\n(policy)",
        "objective",
    ]
    texts = {text.get_text() for text in axis.texts}
    assert texts >= {"0.0001", "0.001", "0.01", "[2.0]", "[0.0, 2.0, 4.…", "1", "2", "3"}
    lines = [line for line in axis.lines if len(np.asarray(line.get_xdata())) == 3]
    assert len(lines) == 3, "what has no objective has no line"
    best = max(lines, key=lambda line: line.get_linewidth())
    assert np.asarray(best.get_ydata())[[0, 2]].tolist() == [1.0, 1.0]
    middle = [line for line in lines if np.isclose(np.asarray(line.get_ydata())[2], 0.5)]
    assert np.isclose(np.asarray(middle[0].get_ydata())[0], 0.5), "the axis is logarithmic"
