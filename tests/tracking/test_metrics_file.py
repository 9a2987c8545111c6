"""metrics.json: sections merge, values are plain, a failed write leaves the old file."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from negopipe.tracking.metrics_file import merge_into


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "metrics.json"


def test_sections_merge_at_every_depth(path: Path) -> None:
    merge_into(path, {"train": {"return": 1.0, "loss": {"value": 2.0}}, "n": [1, 2]})
    merge_into(path, {"train": {"loss": {"policy": 3.0}}, "evaluate": {"push": 4.0}, "n": [3]})
    assert json.loads(path.read_text()) == {
        "train": {"return": 1.0, "loss": {"value": 2.0, "policy": 3.0}},
        "evaluate": {"push": 4.0},
        "n": [3],
    }


def test_what_is_not_a_number_is_null_and_numbers_are_plain(path: Path) -> None:
    nan = float("nan")
    merge_into(path, {"a": nan, "b": [np.float32(0.5), np.inf], "c": torch.tensor([1.0, nan]), "d": np.int64(3)})
    assert json.loads(path.read_text()) == {"a": None, "b": [0.5, None], "c": [1.0, None], "d": 3}


def test_equal_results_are_equal_files(tmp_path: Path) -> None:
    merge_into(tmp_path / "one.json", {"b": 1, "a": {"d": 2, "c": 3}})
    merge_into(tmp_path / "two.json", {"a": {"c": 3}})
    merge_into(tmp_path / "two.json", {"a": {"d": 2}, "b": 1})
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_a_write_that_fails_leaves_the_old_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    merge_into(path, {"a": 1})

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", die)  # everything before it has happened, the draft is written
    with pytest.raises(KeyboardInterrupt):
        merge_into(path, {"a": 2})
    assert json.loads(path.read_text()) == {"a": 1}
