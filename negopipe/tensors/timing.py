"""Timing of calls."""

import time
from collections.abc import Callable
from typing import Any

import torch


def block_seconds(call: Callable[[], Any], n_calls: int, device: torch.device) -> float:
    """Duration of `n_calls` calls, until the device has finished them, s."""
    _finish(device)
    start_s = time.perf_counter()
    for _ in range(n_calls):
        call()
    _finish(device)
    return time.perf_counter() - start_s


class Stopwatch:
    """Stopwatch of a method of an object: all calls from now on, until the device has finished them.

    seconds: in all, s
    """

    def __init__(self, owner: object, method: str, device: torch.device) -> None:
        self.seconds = 0.0
        call = getattr(owner, method)

        def timed(*arguments: Any) -> Any:
            _finish(device)
            start_s = time.perf_counter()
            result = call(*arguments)
            _finish(device)
            self.seconds += time.perf_counter() - start_s
            return result

        setattr(owner, method, timed)


def _finish(device: torch.device) -> None:
    """Wait until the device has done what was asked of it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
