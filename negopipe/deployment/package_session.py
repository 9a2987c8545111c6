"""decision.pt2 opened by torch, on one thread."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from negopipe.errors import UserError


class Package:
    """A decision.pt2 as a function from arrays to arrays, by name, as `onnx_session.Graph` is one.

    inputs, outputs: names in the order of the file's arguments and results
    UserError where torch is missing, or where it cannot run the file, such as on another processor.
    """

    def __init__(self, path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        try:
            import torch
            from torch._inductor import aoti_load_package
        except ImportError as error:
            raise UserError("decision.pt2 needs torch (pip install torch), got no such package") from error
        self._torch, self._inputs, self._outputs = torch, inputs, outputs
        # it warns where the package is made for older processors, which is what it is made for
        logging.getLogger("torch.export.pt2_archive").setLevel(logging.ERROR)
        try:
            self._run = aoti_load_package(str(path), run_single_threaded=True)
        except Exception as error:  # its errors have no class in common
            reason = " ".join(str(error).split())
            raise UserError(f"{path} must be a package that torch {torch.__version__} opens, got {reason}") from error

    def __call__(self, arguments: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arguments that the package does not read are left out."""
        found = self._run(*(self._torch.from_numpy(arguments[name]) for name in self._inputs))
        return {name: each.numpy() for name, each in zip(self._outputs, found, strict=True)}
