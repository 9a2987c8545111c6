"""Jobs side by side: order, errors, lost processes."""

import os
import signal
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.runtime import backend
from negopipe.runtime.workers import n_processes, side_by_side


def _answer(value: int, wait_s: float = 0.0) -> tuple[int, int, int]:
    time.sleep(wait_s)
    return value, os.getpid(), torch.get_num_threads()


def _fail() -> None:
    raise UserError("evaluation.oracle must be better")


@pytest.mark.parametrize("n", [1, 2])
def test_results_stand_in_the_order_of_the_jobs_and_in_one_thread_each(n: int) -> None:
    told: list[int] = []
    jobs: list[Callable[[], tuple[int, int, int]]] = [lambda: _answer(0, 0.3), lambda: _answer(1), lambda: _answer(2)]
    results = side_by_side(jobs, n, told.append)
    assert [value for value, _, _ in results] == [0, 1, 2]
    assert {threads for _, _, threads in results} == {1}
    assert sorted(told) == [0, 1, 2]
    assert ({pid for _, pid, _ in results} == {os.getpid()}) == (n == 1)


def test_an_error_of_a_job_is_the_error_of_all_and_nobody_is_waited_for() -> None:
    start_s = time.monotonic()
    with pytest.raises(UserError, match=r"evaluation\.oracle must be better"):
        side_by_side([partial(time.sleep, 60), _fail], 2, lambda _: None)
    assert time.monotonic() - start_s < 30


def test_a_process_that_is_killed_is_an_error() -> None:
    with pytest.raises(BrokenProcessPool):
        side_by_side([lambda: os.kill(os.getpid(), signal.SIGKILL), lambda: None], 2, lambda _: None)


@pytest.mark.slow
def test_what_was_not_compiled_before_is_compiled_by_the_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They hung for ever where a compiler's thread of their parent was to do it."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))  # nothing has been compiled on this machine yet
    backend.prepare(compose_config(["device=cpu", "compile='on'", "n_threads=1"]))
    doubled, squared = (torch.compile(fn, dynamic=False) for fn in (lambda x: 2 * x, lambda x: x * x))
    assert doubled(torch.ones(3)).tolist() == [2.0] * 3
    results = side_by_side([lambda: squared(torch.full((3,), 3.0)).tolist()] * 2, 2, lambda _: None)
    assert results == [[9.0] * 3] * 2


def test_processes_end_with_the_one_that_they_work_for() -> None:
    reading, writing = os.pipe()

    def report_and_wait() -> None:
        os.write(writing, b"%d " % os.getpid())
        time.sleep(60)

    parent = os.fork()
    if parent == 0:
        side_by_side([report_and_wait, report_and_wait], 2, lambda _: None)
        os._exit(0)
    text = b""
    while text.count(b" ") < 2:
        text += os.read(reading, 100)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    deadline_s = time.monotonic() + 20
    left = {int(pid) for pid in text.split()}
    while left and time.monotonic() < deadline_s:
        left = {pid for pid in left if _is_there(pid)}
        time.sleep(0.1)
    assert not left


def _is_there(pid: int) -> bool:
    """A zombie is not: it has ended, and only waits for somebody to ask how."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rsplit(") ", 1)[1][0] != "Z"


def test_a_gpu_is_not_shared_by_processes() -> None:
    assert n_processes("cuda", 4) == 1
