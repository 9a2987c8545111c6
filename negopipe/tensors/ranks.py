"""Ranks: the processes that train one policy together, each with worlds of its own.

A run of one process is the case of one rank. What needs another rank is a *collective*: every rank calls it at the same
point of its work, and all get the same result, bit by bit.
"""

import pickle
import re
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from negopipe.errors import UserError, abbreviate

T = TypeVar("T")


class LostRankError(UserError):
    """Another rank has ended or is out of reach."""

    def __init__(self, number: int, cause: Exception) -> None:
        reason = re.sub(r"^\[[^]]*\] ", "", " ".join(str(cause).split())).partition(". ")[
            0
        ]  # without the place in gloo
        super().__init__(
            f"one of {number} ranks has ended or is out of reach ({abbreviate(reason)}): "
            "the same command resumes the run from its newest snapshot"
        )


class Ranks:
    """The only rank of a run: every collective gives back what it is given.

    index: of this rank, from 0
    number: of all ranks
    seconds: time within collectives so far, s, which includes the wait for the slowest rank
    """

    index = 0
    number = 1
    seconds = 0.0

    @property
    def is_first(self) -> bool:
        """Whether this is the rank that keeps the run's files and speaks for all."""
        return self.index == 0

    def slice_of(self, n: int) -> tuple[int, int]:
        """First and one past the last of the rows that this rank takes of `n`; ranks take nearly equally many."""
        return n * self.index // self.number, n * (self.index + 1) // self.number

    def add_up(self, tensors: Sequence[Tensor]) -> None:
        """Put the sums over the ranks in the place of tensors of one dtype; collective."""

    def gather(self, rows: Tensor) -> list[Tensor]:
        """Rows [n, K] uint8 of every rank, where n differs between the ranks; collective."""
        return [rows]

    def each(self, number: int) -> list[int]:
        """The whole numbers that the ranks give, by rank; collective."""
        return [number]

    def any(self, *flags: bool) -> tuple[bool, ...]:
        """For each flag, whether it is true on one rank at least; collective."""
        return flags

    def first(self, make: Callable[[], T]) -> T:
        """What `make` gives on the first rank, where alone it is called; collective."""
        return make()

    def call(self, order: Any) -> None:
        """Give the others, which wait in `first`, the order that they work by; None = there is no work for them."""

    def close(self) -> None:
        """Leave the others: no further collective follows."""


class ConnectedRanks(Ranks):
    """One of several ranks, connected in some way that carries tensors.

    A way that carries them implements `_add_up`, `_gather` and `_send`.
    """

    def __init__(self, index: int, number: int) -> None:
        self.index, self.number, self.seconds = index, number, 0.0

    def add_up(self, tensors: Sequence[Tensor]) -> None:
        flat = torch.cat([each.detach().reshape(-1) for each in tensors])
        self._timed(self._add_up, flat)
        with torch.no_grad():
            for each, total in zip(tensors, flat.split([each.numel() for each in tensors]), strict=True):
                each.copy_(total.view(each.shape))

    def gather(self, rows: Tensor) -> list[Tensor]:
        counts = self.each(len(rows))
        if not any(counts):
            return [rows] * self.number
        padded = rows.new_zeros(max(counts), *rows.shape[1:])
        padded[: len(rows)] = rows
        return [part[:n] for part, n in zip(self._timed(self._gather, padded), counts, strict=True)]

    def each(self, number: int) -> list[int]:
        return [int(part) for part in self._timed(self._gather, torch.tensor([number]))]

    def any(self, *flags: bool) -> tuple[bool, ...]:
        counts = torch.tensor(flags, dtype=torch.int64)
        self._timed(self._add_up, counts)
        return tuple(count > 0 for count in counts.tolist())

    def first(self, make: Callable[[], T]) -> T:
        sent = bytearray(pickle.dumps(make())) if self.is_first else bytearray()
        size = self.each(len(sent))[0]
        content = torch.frombuffer(sent, dtype=torch.uint8) if self.is_first else torch.empty(size, dtype=torch.uint8)
        self._timed(self._send, content)
        received: T = pickle.loads(content.numpy().tobytes())  # of a rank of this very run
        return received

    def _timed(self, collective: Callable[[Tensor], Any], tensor: Tensor) -> Any:
        """Call a collective and count its time; UserError where another rank has ended."""
        started_s = time.monotonic()
        try:
            return collective(tensor)
        except RuntimeError as error:
            lost = LostRankError(self.number, error)
            self._tell(lost)
            raise lost from error
        finally:
            self.seconds += time.monotonic() - started_s

    def _tell(self, lost: LostRankError) -> None:
        """Hear that another rank is lost, before the error is raised."""

    def _add_up(self, tensor: Tensor) -> None:
        """Put the sum over the ranks in the place of a contiguous tensor."""
        raise NotImplementedError

    def _gather(self, tensor: Tensor) -> list[Tensor]:
        """The tensors of all ranks, which have one shape."""
        raise NotImplementedError

    def _send(self, tensor: Tensor) -> None:
        """Put the first rank's tensor in the place of the others'."""
        raise NotImplementedError


ALONE = Ranks()
"""The rank of a run of one process."""
