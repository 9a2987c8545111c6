"""The command line over many runs: which runs it takes, which parts it makes, what it says where it cannot."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from swept import make_run

from negopipe.sweeping.compare import COMMAND, PARTS, main

N = 20
WRITTEN = {
    "table": {"summary.csv", "parallel_coordinates.png", "parallel_coordinates.svg"},
    "seeds": {"seeds.csv", "across.csv", "styles.csv"},
    "curves": {"learning_curves.csv", "learning_curves.png", "learning_curves.svg"},
    "page": {"report.html"},
}


def whole_run(outputs: Path, seed: int, rate: float, n_failed: int) -> Path:
    """Trained and evaluated."""
    folder = make_run(outputs, seed, rate, -8.0 - n_failed)
    is_failed = np.arange(N) < n_failed
    episodes = pd.DataFrame({"planner": "adaptive", "setting": "push", "episode": range(N), "style_horizon_s": 6.0})
    episodes = episodes.assign(social_start_distance_m=12.0, outcome=np.where(is_failed, "collision", "success"))
    episodes.assign(driving_time_s=8.0, reward=np.where(is_failed, -32.0, 2.0)).to_csv(folder / "episodes.csv")
    history = pd.DataFrame({"decisions": [1000, 2000], "wall_s": [1.0, 2.0], "success_rate": 0.5, "return_mean": -9.0})
    history.to_csv(folder / "history.csv", index=False)
    return folder


@pytest.fixture
def outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: two rates with two seeds each."""
    for seed in (1, 2):
        for rate in (0.1, 0.2):
            whole_run(tmp_path, seed, rate, seed)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(outputs: Path, name: str = "yield") -> set[str]:
    return {path.name for path in (outputs / "sweeps" / name).iterdir()}


def test_the_plain_call_makes_all_parts(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["yield"]) == 0
    assert written(outputs) == set.union(*WRITTEN.values())
    said = capsys.readouterr().out
    assert "  python -m negopipe +experiment=yield algorithm.rate=0.1\n" in said
    assert "Over seeds" in said
    assert "Push: algorithm.rate=0.1 has the highest reward of 2 configs, but not clearly" in said
    assert "left out" not in said


@pytest.mark.parametrize("part", PARTS)
def test_a_part_can_be_made_alone(outputs: Path, part: str) -> None:
    assert main(["yield", "--only", part]) == 0
    assert written(outputs) == WRITTEN[part]


def test_one_run_makes_the_parts_that_apply(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole_run(tmp_path, 1, 0.1, 0)
    assert main([str(tmp_path / "yield")]) == 0
    assert written(tmp_path) == {"summary.csv"} | WRITTEN["seeds"] | WRITTEN["curves"]
    said = capsys.readouterr().out
    assert "page       left out: one run only is evaluated; its own report.html shows it" in said
    assert "seeds      one per config" in said


def test_runs_that_failed_leave_the_others_compared(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in ("metrics.json", "episodes.csv", "history.csv"):
        (outputs / "yield" / "seed1-0.1-0" / file).unlink()
    make_run(outputs, 1, 0.4, None, finished=[])
    assert main(["yield"]) == 0
    assert written(outputs) == set.union(*WRITTEN.values())
    assert "left out" not in capsys.readouterr().out


def test_runs_of_which_none_was_finished_have_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path, 1, 0.1, None, finished=[])
    assert main([str(tmp_path / "yield")]) == 0
    assert written(tmp_path) == {"summary.csv"}
    said = capsys.readouterr().out
    assert said.count("left out: no run has been evaluated") == 2
    assert "curves     left out: no run has a history.csv" in said


def test_settings_that_differ_are_told_apart(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (1, 2):
        path = outputs / "yield" / f"seed{seed}-0.2-{2 * seed - 1}" / "episodes.csv"
        pd.read_csv(path).assign(setting="mixture").to_csv(path)
    assert main(["yield"]) == 0
    said = capsys.readouterr().out
    assert "Push: algorithm.rate=0.1, 2 seeds." in said
    assert "Mixture: algorithm.rate=0.2, 2 seeds." in said


def test_names_patterns_and_tags_choose_runs(outputs: Path) -> None:
    (outputs / "yield").rename(outputs / "second")
    whole_run(outputs, 3, 0.1, 0)
    assert main(["yield", "second", "--only", "table"]) == 0
    table = pd.read_csv(outputs / "sweeps" / "yield+second" / "summary.csv")
    assert table["runs"].str.split(" ").explode().str.split("/").str[0].value_counts().to_dict() == {
        "second": 4,
        "yield": 1,
    }
    assert main(["[a-z]*", "--sweep", "rates", "--only", "table"]) == 0
    assert pd.read_csv(outputs / "sweeps" / "rates" / "summary.csv")["seeds"].sum() == 5


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["nowhere"], "the folder must be <outputs>/<name> with runs in it, got nowhere; such are "),
        (["no*"], "the folder must be <outputs>/<name> with runs in it, got no*; such are "),
        (["."], "the folder must be <outputs>/<name> with runs in it, got .; such are yield"),
        (["yield", "elsewhere/yield"], "the folders must lie in one outputs folder, got . and elsewhere"),
        (["yield", "--sweep", "x"], "--sweep must be one of rates, got x"),
        (["yield", "--by", "sede"], "--by must be keys of the config such as algorithm.kind, got sede"),
    ],
)
def test_a_wrong_argument_is_one_line(
    outputs: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], line: str
) -> None:
    make_run(outputs / "elsewhere", 1, 0.1, -8.0)
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert said.startswith(line)
    assert said.count("\n") == 1


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


def test_help_has_examples_and_needs_no_torch() -> None:
    code = "import sys, negopipe.sweeping.compare as c\ntry: c.main(['--help'])\n"
    said = python("-c", code + "except SystemExit: print({'torch', 'pandas'} & set(sys.modules))").stdout
    assert said.endswith("set()\n")
    assert f"  {COMMAND} outputs/yield\n" in said


@pytest.mark.parametrize("former", ["summary", "seeds", "learning_curves", "comparison"])
def test_a_former_command_names_the_present_one(former: str) -> None:
    done = python("-m", f"negopipe.sweeping.{former}", "outputs/yield")
    assert done.returncode == 1
    assert done.stderr == f"negopipe.sweeping.{former} is no command any more: {COMMAND} <outputs>/<name>, see --help\n"
