"""Ranks as threads of one process, for tests that need no processes."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from torch import Tensor

from negopipe.tensors.ranks import ConnectedRanks, Ranks

T = TypeVar("T")


class RankThread(ConnectedRanks):
    """One of the threads, which exchange tensors through a list with a place for each."""

    def __init__(self, index: int, places: list[Tensor | None], barrier: threading.Barrier) -> None:
        super().__init__(index, len(places))
        self._places, self._barrier = places, barrier

    def _gather(self, tensor: Tensor) -> list[Tensor]:
        self._places[self.index] = tensor.clone()
        self._barrier.wait()  # a broken one raises a RuntimeError, like a lost connection
        gathered = [each.clone() for each in self._places if each is not None]
        self._barrier.wait()
        return gathered

    def _add_up(self, tensor: Tensor) -> None:
        first, *others = self._gather(tensor)
        tensor.copy_(sum(others, first))

    def _send(self, tensor: Tensor) -> None:
        self._places[self.index] = tensor
        self._barrier.wait()
        if not self.is_first and (sent := self._places[0]) is not None:
            tensor.copy_(sent)
        self._barrier.wait()


def in_ranks(number: int, work: Callable[[Ranks], T]) -> list[T]:
    """What `work` returns on each of so many ranks; an error of one breaks off the others."""
    if number == 1:
        return [work(Ranks())]
    barrier = threading.Barrier(number)
    places: list[Tensor | None] = [None] * number

    def run(index: int) -> T:
        try:
            return work(RankThread(index, places, barrier))
        except BaseException:
            barrier.abort()
            raise

    with ThreadPoolExecutor(number) as pool:
        futures = [pool.submit(run, index) for index in range(number)]
    return [future.result() for future in futures]
