"""The scripts of jobs/ as modules."""

import importlib.util
from pathlib import Path
from typing import Any

JOBS = Path(__file__).parents[1] / "jobs"


def load_script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, JOBS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
