"""ONNX files opened by onnxruntime, on one thread of the CPU; no torch."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from negopipe.errors import UserError

if TYPE_CHECKING:
    import onnxruntime


def open_onnx(path: Path) -> "onnxruntime.InferenceSession":
    """A session on one thread of the CPU; UserError where onnxruntime is missing or cannot read the file."""
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError("the runtime needs onnxruntime (pip install onnxruntime), got no such package") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no class in common
        reason = " ".join(str(error).split())
        raise UserError(
            f"{path} must be a file that onnxruntime {onnxruntime.__version__} reads, got {reason}"
        ) from error


class Graph:
    """An ONNX file as a function from arrays to arrays, by name."""

    def __init__(self, path: Path) -> None:
        self._session = open_onnx(path)
        self.inputs = [each.name for each in self._session.get_inputs()]
        self.outputs = [each.name for each in self._session.get_outputs()]

    def __call__(self, arguments: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arguments that the graph does not read are left out."""
        found = self._session.run(self.outputs, {name: arguments[name] for name in self.inputs})
        return dict(zip(self.outputs, found, strict=True))
