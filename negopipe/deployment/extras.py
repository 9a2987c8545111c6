"""Packages that only some commands need: the extras of pyproject.toml."""

import importlib.util

from negopipe.errors import UserError

EXTRAS = {
    "export": ("onnx", "onnxscript", "onnxruntime"),
    "middleware": ("rosbags", "mcap", "cyclonedds"),
}
"""Name of an extra -> its packages."""


def need(extra: str) -> None:
    """UserError where a package of the extra is missing."""
    names = EXTRAS[extra]
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    if missing:
        needs = f"needs {', '.join(names)} (pip install 'negopipe[{extra}]')"
        raise UserError(f"{extra} {needs}, got no {missing[0]}")
