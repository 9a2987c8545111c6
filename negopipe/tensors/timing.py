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


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
