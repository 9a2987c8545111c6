"""Calling a batched function on chunks of worlds of one size.

A compiled function is compiled for one shape; in chunks it serves any number of worlds with one compilation, its
intermediate tensors stay in the cache, memory does not grow with the number of worlds, and what a world does cannot
depend on how many others are computed beside it.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from negopipe.simulation.state import first_tensor, map_tensors


class InChunks:
    """`fn`, called on `size` worlds at a time.

    fn: maps tensors, tensor dataclasses or tuples of them to such; axis 0 of every tensor is the worlds
    is_filled: the last chunk is filled up with copies of its last world, so that all have one shape
    """

    def __init__(self, fn: Callable[..., Any], size: int, is_filled: bool) -> None:
        self.fn, self.size, self.is_filled = fn, size, is_filled

    def __call__(self, *args: Any) -> Any:
        n_worlds = len(first_tensor(args))
        pieces = [self.fn(*self._rows(args, start, n_worlds)) for start in range(0, n_worlds, self.size)]
        return map_tensors(lambda *parts: _joined(parts, n_worlds), *pieces)

    def _rows(self, args: tuple, start: int, n_worlds: int) -> tuple:
        """Contiguous chunks, so that every call looks the same to a compiled function."""
        stop = start + self.size
        if stop <= n_worlds or not self.is_filled:
            return map_tensors(lambda field: field[start:stop].contiguous(), args)
        rows = torch.arange(start, stop).clamp(max=n_worlds - 1)
        return map_tensors(lambda field: field[rows.to(field.device)], args)


def _joined(parts: tuple[Tensor, ...], n_worlds: int) -> Tensor:
    whole = parts[0] if len(parts) == 1 else torch.cat(parts)
    return whole if len(whole) == n_worlds else whole[:n_worlds].clone()
