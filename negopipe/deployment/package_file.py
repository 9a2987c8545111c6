"""decision.pt2: the decision as machine code for torch and C++, by torch.export and AOTInductor.

Its arguments come in the order of `package_inputs`, its results in that of `decision.outputs`.
"""

import platform
import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from negopipe.deployment.decision import STATES, Decision, last_inputs, needs
from negopipe.environment import variable
from negopipe.errors import UserError

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

PROCESSORS: Mapping[str, dict[str, Any]] = {
    "avx2": {"cpp.march": "x86-64-v3", "cpp.simdlen": 256},
    "native": {},
}
"""Options of the compiler by the processors for which code is made."""


def package_inputs(config: "RunConfig") -> tuple[str, ...]:
    """Names of the arguments of decision.pt2, in order; they are those of decision.onnx."""
    return (*STATES, *needs(config), *last_inputs(config))


class Positional(nn.Module):
    """A decision whose arguments come one after the other."""

    def __init__(self, config: "RunConfig", decision: Decision) -> None:
        super().__init__()
        self.decision, self._needed = decision, tuple(needs(config))
        self._names = package_inputs(config)

    def forward(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        named = dict(zip(self._names, arguments, strict=True))
        street = {name: named.pop(name) for name in self._needed}
        return tuple(self.decision(**named, street=street))  # a package knows no named tuple


def in_order(config: "RunConfig", arguments: Mapping[str, np.ndarray]) -> tuple[Tensor, ...]:
    """Arguments of decision.pt2; no two share memory, since torch.export would take them for one."""
    return tuple(torch.from_numpy(np.array(arguments[name])) for name in package_inputs(config))


def check_machine(processor: str) -> None:
    """UserError where this machine cannot make code for a processor."""
    machine = platform.machine()
    if processor == "avx2" and machine not in ("x86_64", "AMD64"):
        raise UserError(f"export.processor must be native on a machine of {machine}, got {processor}")
    if shutil.which(variable("CXX") or "g++") is None:
        raise UserError("export.files must be without package where there is no C++ compiler, got package")


def write_package(path: Path, decision: Decision, arguments: Mapping[str, np.ndarray], config: "RunConfig") -> None:
    """Write decision.pt2; arguments: of some decision. Needs a C++ compiler and minutes."""
    from torch._inductor import aoti_compile_and_package

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(Positional(config, decision).eval(), in_order(config, arguments))
        options = {"cpp.threads": 1, **PROCESSORS[config.export.processor]}
        aoti_compile_and_package(program, package_path=str(path), inductor_configs=options)


@torch.no_grad()
def decision_selftest(
    decision: Decision, driven: Sequence[Mapping[str, np.ndarray]], config: "RunConfig"
) -> list[list[list[Tensor]]]:
    """Arguments and results of decisions in order, [n][2][...], as `torch::jit::pickle_load` of C++ reads them, too."""
    positional, made = Positional(config, decision).eval(), []
    for arguments in driven:
        given = in_order(config, arguments)
        made.append([list(given), list(positional(*given))])
    return made
