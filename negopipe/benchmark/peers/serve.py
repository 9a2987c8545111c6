"""A workload in a Python of its own: started by `worker.Worker`, measured whenever the other side asks for it.

    python serve.py <workload.py> <options as JSON>

It uses the standard library alone, since a peer's environment holds the peer and nothing of negopipe. A workload is a
file with

    LIBRARIES: tuple of modules whose import is timed
    PACKAGES: tuple of distributions whose versions are told
    start(options) -> (work, facts): `work()` does some units of work and returns their number; facts are told

Lines of JSON go out: what the start took, then for every line of seconds that comes in what was done in that time.
"""

import importlib
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TextIO


def main(path: str, options: dict[str, Any]) -> None:
    """Start the workload of a file and measure it until standard input ends."""
    answers = _own_output()
    begin = _clocks()
    workload = _loaded(path)
    for library in workload.LIBRARIES:
        importlib.import_module(library)
    imported = _clocks()
    work, facts = workload.start(options)
    work()
    worked = _clocks()
    versions = {name: version(name) for name in workload.PACKAGES} | {"Python": sys.version.split()[0]}
    start = {"import_s": imported[0] - begin[0], "first_s": worked[0] - imported[0]}
    start |= {"import_cpu_s": imported[1] - begin[1], "first_cpu_s": worked[1] - imported[1]}
    _tell(answers, {**start, "facts": facts, "versions": versions})
    for line in sys.stdin:
        _tell(answers, measured(work, float(line)))


def measured(work: Callable[[], int], seconds: float) -> dict[str, float]:
    """Units of work done until `seconds` of CPU time have passed, the time they took, and percentiles of single calls.

    CPU time is that of all threads of the process.
    """
    n_units, times = 0, []
    begin = last = _clocks()
    while last[1] - begin[1] < seconds:
        n_units += work()
        now = _clocks()
        times.append((now[0] - last[0], now[1] - last[1]))
        last = now
    wall, cpu = (sorted(each) for each in zip(*times, strict=True))
    percentiles = {
        f"{name}_p{share}_ms": 1e3 * values[min(len(values) - 1, len(values) * share // 100)]
        for name, values in (("wall", wall), ("cpu", cpu))
        for share in (50, 99)
    }
    return {"n_units": n_units, "n_calls": len(times), "wall_s": sum(wall), "cpu_s": sum(cpu), **percentiles}


def _clocks() -> tuple[float, float]:
    """Wall and CPU time, s."""
    return time.perf_counter(), time.process_time()


def _own_output() -> TextIO:
    """Standard output for the answers alone; what libraries print goes to standard error."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return answers


def _tell(answers: TextIO, answer: dict[str, Any]) -> None:
    answers.write(json.dumps(answer) + "\n")
    answers.flush()


def _loaded(path: str) -> Any:
    spec = importlib.util.spec_from_file_location("workload", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    folder = str(Path(__file__).resolve().parent)
    sys.path[:] = [place for place in sys.path if place != folder]  # its files are no modules for a peer
    main(sys.argv[1], json.loads(sys.argv[2]))
