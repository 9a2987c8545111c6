"""ONNX files, written from a torch module."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils._pytree import tree_map

from negopipe.deployment.fast_onnx import faster
from negopipe.tracking.whole_file import write_whole


def write_onnx(
    path: Path,
    module: nn.Module,
    inputs: Mapping[str, Any],
    outputs: Sequence[str],
    opset: int,
    batch: str | None = None,
) -> None:
    """Write a module in eval mode as one ONNX file, weights included.

    inputs: an example of each argument of `forward`, by name; an argument may be a dict of tensors, whose keys are then
        names of inputs
    outputs: names of the tensors that `forward` returns
    batch: name of a dynamic first axis of all inputs; None = all shapes are fixed, and the graph is so large that
        `fast_onnx` simplifies it, in seconds instead of minutes
    """
    leaves: dict[str, torch.Tensor] = {}
    for name, each in inputs.items():
        leaves |= each if isinstance(each, dict) else {name: each}
    dynamic = {name: {0: batch} for name in inputs} if batch else None
    with warnings.catch_warnings(), _quiet("torch.onnx", "torch.export", "onnxscript", "onnx_ir"):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module.eval(),
            kwargs=tree_map(torch.clone, dict(inputs)),  # aliased tensors would become one input
            dynamo=True,
            input_names=list(leaves),
            output_names=list(outputs),
            opset_version=opset,
            dynamic_shapes=dynamic,
            external_data=False,
            optimize=batch is not None,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    if batch is None:
        model = faster(model, {name: each.numpy() for name, each in leaves.items()})
    write_whole(path, model.SerializeToString())


class _quiet:
    """Context in which some loggers only tell of errors: the exporter logs every pass."""

    def __init__(self, *names: str) -> None:
        self._loggers = [logging.getLogger(name) for name in names]

    def __enter__(self) -> None:
        self._levels = [logger.level for logger in self._loggers]
        for logger in self._loggers:
            logger.setLevel(logging.ERROR)

    def __exit__(self, *_: object) -> None:
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)
