"""An evaluation in pieces is the evaluation of all tasks, to the last byte where it is compiled."""

from pathlib import Path

import pandas as pd
import pytest
from scripts import load_script
from tracked import RecordedRun

from negopipe.game.game import has_compiler
from negopipe.stages import evaluate
from negopipe.tracking.metrics_file import read

SMALL = (
    "+experiment=smoke",
    "evaluation/baseline=[fixed_0,cautious]",
    "scenario.episode_steps=40",
    "checkpoint=pretrained/yield",
    "policy=cnn",
)
N_EPISODES, N_PIECES = 7, 3


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_pieces_merge_to_the_bytes_of_one_evaluation(tmp_path: Path) -> None:
    job, options = load_script("evaluate_pieces"), [*SMALL, "compile=on"]
    folder, drive = tmp_path / "pieces", ["--episodes", f"{N_EPISODES}", "--of", f"{N_PIECES}", *options]
    for pieces in ("2", "0-1"):  # in any order
        assert job.main(["drive", str(folder), "--piece", pieces, *drive]) == 0
    assert job.main(["merge", str(folder)]) == 0
    config = job.config_of(N_EPISODES, 1, options)
    (tmp_path / "whole").mkdir()
    evaluate.run(config, RecordedRun(tmp_path / "whole"))  # type: ignore[arg-type]
    assert (folder / "episodes.csv").read_bytes() == (tmp_path / "whole" / "episodes.csv").read_bytes()
    assert read(folder / "metrics.json") == read(tmp_path / "whole" / "metrics.json")


def test_pieces_that_do_not_belong_together_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = load_script("evaluate_pieces")

    def refused() -> str:
        assert job.main(["merge", str(tmp_path)]) == 1
        return capsys.readouterr().err

    assert "must hold the pieces that `drive` writes, got none" in refused()
    table = pd.DataFrame(
        {"planner": ["a", "b"], "setting": ["push", "push"], "episode": [0, 0], "ego_time_s": [0.1, 0.2]}
    )
    job.save(job.place_of(tmp_path, 0, 2), table, "one")
    assert "must hold 2 pieces of one evaluation, got 1, without [1]" in refused()
    job.save(job.place_of(tmp_path, 1, 2), table.assign(episode=1), "other")
    assert "got piece_000001_of_2.npz of others" in refused()
    job.save(job.place_of(tmp_path, 1, 2), table.assign(episode=1), "one")
    merged = job.merge(tmp_path)
    assert merged["planner"].tolist() == ["a", "a", "b", "b"]
    assert merged["episode"].tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (("+experiment=smoke",), "checkpoint must be the policy that is evaluated in pieces, got null"),
        (("+experiment=mixture", "checkpoint=pretrained", "evaluation/baseline=[level_k]"), "evaluation.baselines"),
    ],
)
def test_what_belongs_to_whole_evaluations_only_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], overrides: tuple[str, ...], line: str
) -> None:
    assert load_script("evaluate_pieces").main(["drive", str(tmp_path), *overrides]) == 1
    assert line in capsys.readouterr().err
