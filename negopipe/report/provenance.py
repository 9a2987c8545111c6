"""Provenance of a page, and its claims as a file."""

import json
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from negopipe.errors import UserError
from negopipe.evaluation.hypothesis import Claim
from negopipe.report.page import Provenance
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.tracking.store import TrackedRun

PACKAGES = ("negopipe", "torch", "numpy", "pandas", "matplotlib", "hydra-core", "mlflow")
"""Packages whose versions the page lists."""


def provenance(seed: int, run: "TrackedRun") -> Provenance:
    """Provenance of the run's results and its report. UserError if the run's config is missing."""
    config_path = run.folder / "config.yaml"
    if not config_path.is_file():
        raise UserError(f"{config_path}: no such file; every run writes it when it starts")
    return Provenance("\n".join(run.commands), str(seed), config_path.read_text(encoding="utf-8"), versions())


def versions() -> dict[str, str]:
    """Versions of Python and of `PACKAGES`, by name."""
    return {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


def write_claims(run: "TrackedRun", claims: Sequence[Claim]) -> None:
    """Write claims.json and log it as an artifact."""
    path = run.folder / "claims.json"
    write_whole(path, claims_text(claims).encode())
    run.log_artifact(path)


def claims_text(claims: Sequence[Claim]) -> str:
    """Content of claims.json."""
    return json.dumps([claim.as_dict() for claim in claims], indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"
