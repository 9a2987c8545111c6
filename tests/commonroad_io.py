"""commonroad-io in an environment of its own, for tests."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

COMMONROAD_PYTHON = "COMMONROAD_PYTHON"
"""Environment variable: the Python of an environment with commonroad-io and lxml."""


def read_by_commonroad_io(path: Path) -> dict[str, Any]:
    """A scenario as commonroad-io reads it (`maps/commonroad_io_reads.py`); the test is skipped without it."""
    python = os.environ.get(COMMONROAD_PYTHON)
    if not python:
        pytest.skip(f"{COMMONROAD_PYTHON} names no Python with commonroad-io and lxml")
    environment = {**os.environ, "PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION": "python", "PYTHONPATH": ""}
    script = Path(__file__).with_name("maps") / "commonroad_io_reads.py"
    run = subprocess.run([python, script, path], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    seen: dict[str, Any] = json.loads(run.stdout)
    return seen
