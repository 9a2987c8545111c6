"""export.json: what it refuses."""

import json
from pathlib import Path

import pytest

from negopipe.deployment.manifest import FORMAT, MANIFEST_NAME, manifest_text, read_manifest
from negopipe.errors import UserError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "policy.onnx").write_bytes(b"weights")
    (tmp_path / MANIFEST_NAME).write_text(manifest_text({"dt_s": 0.2}, tmp_path, ["policy.onnx"]))
    return tmp_path


def test_it_is_read_as_it_was_written(folder: Path) -> None:
    assert read_manifest(folder)["dt_s"] == 0.2


def test_another_format_is_refused(folder: Path) -> None:
    content = json.loads((folder / MANIFEST_NAME).read_text()) | {"format": FORMAT + 1}
    (folder / MANIFEST_NAME).write_text(json.dumps(content))
    with pytest.raises(UserError, match=rf"format must be {FORMAT}, got {FORMAT + 1}"):
        read_manifest(folder)


def test_a_changed_file_is_refused(folder: Path) -> None:
    (folder / "policy.onnx").write_bytes(b"Weights")
    with pytest.raises(UserError, match=r"policy\.onnx: must be the file that was exported, got other bytes"):
        read_manifest(folder)


def test_a_missing_file_is_named(folder: Path) -> None:
    (folder / "policy.onnx").unlink()
    with pytest.raises(UserError, match=r"must hold policy\.onnx"):
        read_manifest(folder)


@pytest.mark.parametrize("text", ["{", "[]", "3"])
def test_what_no_export_wrote_is_refused(folder: Path, text: str) -> None:
    (folder / MANIFEST_NAME).write_text(text)
    with pytest.raises(UserError, match=r"must be"):
        read_manifest(folder)


def test_a_folder_without_one_is_no_export(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"folder must be an export with export\.json"):
        read_manifest(tmp_path)
