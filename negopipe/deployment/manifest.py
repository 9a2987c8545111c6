"""The folder of an export and its export.json, read without torch: versions, hashes, and what the files depend on."""

import hashlib
import json
from pathlib import Path
from typing import Any

from negopipe.errors import UserError

FORMAT = 3
"""Version of the folder's layout; a reader refuses any other."""

MANIFEST_NAME = "export.json"
POLICY_NAME = "policy.onnx"
SELFTEST_NAME = "selftest.npz"
DECISION_NAME = "decision.onnx"
PACKAGE_NAME = "decision.pt2"
PACKAGE_TEST_NAME = "decision_selftest.pt"
STREET_NAME = "street.onnx"


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def manifest_text(content: dict[str, Any], folder: Path, names: list[str]) -> str:
    """Text of export.json.

    content: JSON values
    names: files of the folder whose hashes it records
    """
    hashes = {name: file_hash(folder / name) for name in names}
    return json.dumps({"format": FORMAT, **content, "files": hashes}, indent=2) + "\n"


def read_manifest(folder: Path) -> dict[str, Any]:
    """The export.json of a folder; UserError where it is missing, of another format, or where a file was changed."""
    path = folder / MANIFEST_NAME
    if not path.is_file():
        raise UserError(f"folder must be an export with {MANIFEST_NAME}, got {folder}: no such file")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UserError(f"{path}: must be JSON as an export writes it, got a damaged file ({error})") from error
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise UserError(f"{path}: format must be {FORMAT}, got {json.dumps(found)}: export the checkpoint anew")
    for name, expected in content["files"].items():
        if not (folder / name).is_file():
            raise UserError(f"{path}: the folder must hold {name}, got no such file")
        if file_hash(folder / name) != expected:
            raise UserError(f"{folder / name}: must be the file that was exported, got other bytes: export it anew")
    return content
