"""A workload in a process of its own, with the Python of its environment and one thread."""

import json
import os
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from negopipe.errors import UserError

HERE = Path(__file__).parent
LIBRARIES = ("OMP", "MKL", "OPENBLAS", "NUMBA")
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in LIBRARIES} | {"TORCHINDUCTOR_COMPILE_THREADS": "1"}
OFFSCREEN = {"SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "Agg"}
LONGEST_S = 1800.0
"""Longest wait for an answer, s."""


@dataclass(frozen=True)
class Start:
    """What the start of a workload took: wall time, and CPU time of all threads (s).

    import_s, import_cpu_s: importing its libraries
    first_s, first_cpu_s: building what is measured and its first call, compilation included
    facts: what the workload tells of itself
    versions: by distribution
    """

    import_s: float
    import_cpu_s: float
    first_s: float
    first_cpu_s: float
    facts: dict[str, Any]
    versions: dict[str, str]


@dataclass(frozen=True)
class Round:
    """What was done in one round: `n_units` of work in `n_calls`, wall and CPU time (s), percentiles of a call (ms)."""

    n_units: int
    n_calls: int
    wall_s: float
    cpu_s: float
    wall_p50_ms: float
    wall_p99_ms: float
    cpu_p50_ms: float
    cpu_p99_ms: float

    @property
    def per_cpu_s(self) -> float:
        """Units per second of CPU time."""
        return self.n_units / self.cpu_s


class Worker:
    """A started workload; between rounds it waits and uses no CPU time. Its working folder is a temporary one.

    python: interpreter of its environment
    file: of the workload; see `serve`
    start: what its start took

    UserError with the last line of its errors where it ends without an answer, or gives none in `LONGEST_S`.
    """

    def __init__(self, python: str, file: Path, options: dict[str, Any]) -> None:
        self._name = file.stem
        self._folder = tempfile.TemporaryDirectory(prefix="negopipe-", ignore_cleanup_errors=True)
        self._errors = Path(self._folder.name) / "errors.txt"
        command = [python, str(HERE / "serve.py"), str(file), json.dumps(options)]
        with self._errors.open("w", encoding="utf-8") as errors:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                cwd=self._folder.name,
                env=_environment(python, self._folder.name),
            )
        self.start = Start(**self._answer())

    def measure(self, seconds: float) -> Round:
        """One round of at least `seconds` of CPU time."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended, and its answer will say so
            self._process.stdin.write(f"{seconds}\n")
            self._process.stdin.flush()
        return Round(**self._answer())

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()
        self._folder.cleanup()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        alarm = threading.Timer(LONGEST_S, self._process.kill)
        alarm.start()
        line = self._process.stdout.readline()
        alarm.cancel()
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        self._process.wait()
        said = self._errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        self.close()
        raise UserError(f"{self._name}: {said[-1] if said else 'ended without a word'}")


def _environment(python: str, cache: str) -> dict[str, str]:
    """Environment variables: one thread, an empty cache of compiled code; nothing of negopipe for a peer's Python."""
    given = {**os.environ, **ONE_THREAD, **OFFSCREEN, "TORCHINDUCTOR_CACHE_DIR": f"{cache}/compiled"}
    if python != sys.executable:
        given.pop("PYTHONPATH", None)
    return given
