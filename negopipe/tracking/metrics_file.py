"""metrics.json: the results of a run as one nested mapping that stages add their sections to."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from negopipe.tracking.whole_file import write_whole


def merge_into(path: Path, section: Mapping[str, Any]) -> None:
    """Merge `section` into the file, mapping by mapping; a reader sees the old file or the new one.

    Keys are sorted, NaN and infinity become null, numbers of numpy and torch become plain numbers.
    """
    merged = json.dumps(_plain(_merge(read(path), section)), sort_keys=True, indent=2, allow_nan=False)
    write_whole(path, (merged + "\n").encode())


def read(path: Path) -> dict[str, Any]:
    """Content of the file; empty where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def _merge(old: Any, new: Any) -> Any:
    if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
        return new
    return {**old, **{key: _merge(old.get(key), value) for key, value in new.items()}}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays, tensors and their scalars
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
