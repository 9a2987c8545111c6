"""A channel with latency: messages arrive later than they were sent, and may overtake each other."""

import heapq
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")

ROUNDING_S = 1e-9
"""Difference of two times that are the same, s."""


class Channel(Generic[T]):
    """Messages on their way."""

    def __init__(self) -> None:
        self._waiting: list[tuple[float, int, T]] = []
        self._number = count()

    def send(self, message: T, arrives_s: float) -> None:
        """Put a message on its way; arrives_s: time of its arrival."""
        heapq.heappush(self._waiting, (arrives_s, next(self._number), message))

    def receive(self, now_s: float) -> list[T]:
        """The messages that have arrived since the last call, by arrival."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s + ROUNDING_S:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived
