"""Checkpoints come back as they were written, and a wrong reference is explained in one line."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from negopipe.errors import UserError
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, find_checkpoint, load_checkpoint, save_checkpoint
from negopipe.tracking.store import StoreConfig, open_run


def test_tensors_and_metadata_come_back_as_they_were(tmp_path: Path) -> None:
    weight = torch.arange(6.0).reshape(2, 3)
    tensors = {
        "transposed": weight.T,
        "shared": weight,
        "generator": torch.Generator().manual_seed(3).get_state(),
        "half": torch.ones(2, dtype=torch.bfloat16, requires_grad=True),
        "counter": torch.tensor(5),
    }
    metadata = {"iteration": 7, "config": {"a": [1.5, None, "x"]}}
    path = tmp_path / "deep" / "checkpoint.safetensors"
    save_checkpoint(path, tensors, metadata)
    loaded, loaded_metadata = load_checkpoint(path)
    assert loaded_metadata == metadata
    assert loaded.keys() == tensors.keys()
    for name, tensor in tensors.items():
        torch.testing.assert_close(loaded[name], tensor.detach(), rtol=0, atol=0)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / CHECKPOINT_NAME
    save_checkpoint(path, {"a": torch.ones(1)}, {"step": 1})

    def die(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", die)
    with pytest.raises(OSError, match="disk full"):
        save_checkpoint(path, {"a": torch.zeros(1)}, {"step": 2})
    assert load_checkpoint(path)[1] == {"step": 1}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["missing", "folder", "text", "cut", "foreign"])
def test_a_file_that_is_no_checkpoint_is_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "it"
    match kind:
        case "folder":
            path.mkdir()
        case "text":
            path.write_text("hello, this is no checkpoint")
        case "cut":
            save_checkpoint(path, {"a": torch.ones(1000)}, {})
            path.write_bytes(path.read_bytes()[:-100])
        case "foreign":
            save_file({"a": torch.ones(1)}, path)
    with pytest.raises(UserError, match=r"^checkpoint must be a .*, got .*it: [^\n]+$"):
        load_checkpoint(path)


def test_a_reference_is_a_path_or_the_newest_checkpoint_of_a_run(config: StoreConfig) -> None:
    with open_run(config, "seed1-a", {}) as run:
        file = run.folder / CHECKPOINT_NAME
        for step in (1, 2):
            save_checkpoint(file, {"a": torch.tensor(step)}, {"step": step})
            run.log_checkpoint(file, step, {})
        save_checkpoint(file, {"a": torch.tensor(3)}, {"step": 3})  # of a later run in the same folder
    assert find_checkpoint(str(file), config) == file
    assert load_checkpoint(find_checkpoint(run.run_id, config))[1] == {"step": 2}
    for unknown in ("nowhere.safetensors", "0" * 32, str(run.folder)):
        with pytest.raises(UserError, match=f"^checkpoint must be an existing file, .*, got {unknown}$"):
            find_checkpoint(unknown, config)


def test_a_moved_outputs_folder_keeps_its_checkpoints_and_takes_new_ones(empty: Any) -> None:
    with open_run(empty, "seed1-b", {}) as early:
        save_checkpoint(early.folder / CHECKPOINT_NAME, {"a": torch.ones(1)}, {"step": 1})
        early.log_checkpoint(early.folder / CHECKPOINT_NAME, 1, {})
    moved = replace(empty, outputs=f"{empty.outputs}-moved")
    Path(empty.outputs).rename(moved.outputs)
    assert find_checkpoint(early.run_id, moved).is_relative_to(moved.outputs)
    with open_run(moved, "seed2-b", {}) as late:
        save_checkpoint(late.folder / CHECKPOINT_NAME, {"a": torch.ones(1)}, {"step": 2})
        late.log_checkpoint(late.folder / CHECKPOINT_NAME, 2, {})
    assert find_checkpoint(late.run_id, moved).is_relative_to(moved.outputs)
    assert not Path(empty.outputs).exists()


def test_looking_for_a_run_makes_no_store(empty: StoreConfig) -> None:
    with pytest.raises(UserError, match=r"^checkpoint must be"):
        find_checkpoint("0" * 32, empty)
    assert not Path(empty.outputs).exists()
