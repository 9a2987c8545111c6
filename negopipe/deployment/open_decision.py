"""The exported decision, opened by onnxruntime or by torch."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from negopipe.deployment.manifest import DECISION_NAME, PACKAGE_NAME
from negopipe.deployment.onnx_session import Graph
from negopipe.errors import UserError

Decide = Callable[[Mapping[str, np.ndarray]], Mapping[str, np.ndarray]]
"""A decision: arguments by name -> results by name."""

Backend = Literal["onnxruntime", "torch"]

FILES = {"onnxruntime": (DECISION_NAME, "decision"), "torch": (PACKAGE_NAME, "package")}
"""By backend: the file that it runs, and its name in `export.files`."""


def open_decision(folder: Path, manifest: Mapping[str, Any], backend: Backend) -> Decide:
    """The decision of an export; manifest: its export.json. UserError where it holds no file for the backend."""
    if backend not in FILES:
        raise UserError(f"backend must be {' or '.join(FILES)}, got {backend}")
    name, option = FILES[backend]
    if name not in manifest["files"]:
        raise UserError(f"{folder} must hold {name} (export.files=[policy,{option}]), got an export without")
    if backend == "onnxruntime":
        return Graph(folder / name)
    from negopipe.deployment.package_session import Package  # imports torch

    return Package(folder / name, manifest["decision"]["inputs"], manifest["decision"]["outputs"])
