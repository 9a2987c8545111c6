"""How a page was made: what it says of its command, config and packages."""

import platform
import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from negopipe.errors import UserError
from negopipe.report.page import Provenance

PACKAGES = ("negopipe", "torch", "numpy", "pandas", "matplotlib", "hydra-core", "mlflow")
"""Whose versions the page names."""


def provenance(seed: int, folder: Path) -> Provenance:
    config_path = folder / "config.yaml"
    if not config_path.is_file():
        raise UserError(f"{config_path}: no such file; every run writes it when it starts")
    command = shlex.join(["python", "-m", "negopipe", *sys.argv[1:]])
    versions = {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}
    return Provenance(command, seed, config_path.read_text(encoding="utf-8"), versions)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"
