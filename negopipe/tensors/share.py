"""Share of a rank in a batch: the rows that it holds, and what all ranks compute together from theirs.

A batch of N rows has the order that it would have in one process. Random numbers are drawn for all N rows on every
rank, and each keeps those of its own rows. So the draws do not depend on the number of ranks, and a mean over the rows
is a sum of parts that differs from that of one process by rounding alone.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from negopipe.tensors.ranks import ALONE, Ranks


class Share:
    """The whole batch, in a run of one process."""

    ranks = ALONE

    def n_all(self, n_own: int) -> int:
        """N, where this rank holds `n_own` rows."""
        return n_own

    def n_first(self, n: int) -> int:
        """Upper bound on the rows of this rank among the first `n` of the batch, to cut its own rows at."""
        return n

    def first(self, n: int) -> "Share":
        """Share in the first `n` rows, or in all where there are fewer."""
        return self

    def slice_of(self, n: int) -> "Share":
        """Share in a batch of `n` rows that every rank knows and that is cut into equal pieces."""
        return self

    def take(self, index: Tensor) -> tuple[Tensor, "Share"]:
        """Share in the batch of the rows `index` [M] int64 of this one, and this rank's rows of it among its own."""
        return index, self

    def chosen(self, mask: Tensor) -> "Share":
        """Share in the batch of the cells that `mask` [T, N] chooses, ordered by T and then by the rows of this one."""
        return self

    def repeated(self, n: int) -> "Share":
        """Share in a batch of `n` blocks, each with the rows of this one."""
        return self

    def followed_by(self, more: "Share") -> "Share":
        """Share in a batch of the rows of this one and then those of `more`."""
        return self

    def own(self, rows: Tensor, dim: int = 0) -> Tensor:
        """This rank's rows, from those of the whole batch along the axis `dim`."""
        return rows

    def spread(self, rows: Tensor) -> Tensor:
        """This rank's rows at their places in the batch [N, ...], and 0 at those of the others."""
        return rows

    def mean(self, values: Tensor) -> Tensor:
        """This rank's part in the mean over the batch of values [own]; `add_up` makes the mean of the parts."""
        return values.mean()

    def part(self, mean: Tensor) -> Tensor:
        """This rank's part in a mean over the batch, from the mean over its own rows; zeros where it has none."""
        return mean

    def add_up(self, parts: Sequence[Tensor]) -> None:
        """Put the sums over the ranks in the place of tensors of one dtype; collective."""

    def gather(self, named: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Tensors of the whole batch [N, ...] from this rank's rows [own, ...] of each; collective."""
        return dict(named)


WHOLE = Share()
"""The share of a run of one process."""


class PartialShare(Share):
    """Some of the rows.

    n: N
    place: [own] int64, ascending: places of this rank's rows in the batch
    """

    def __init__(self, ranks: Ranks, n: int, place: Tensor) -> None:
        self.ranks, self.n, self.place = ranks, n, place

    def n_all(self, n_own: int) -> int:
        return self.n

    def n_first(self, n: int) -> int:
        return int((self.place < n).sum())

    def first(self, n: int) -> "PartialShare":
        return PartialShare(self.ranks, min(n, self.n), self.place[: self.n_first(n)])

    def slice_of(self, n: int) -> "PartialShare":
        return PartialShare(self.ranks, n, torch.arange(*self.ranks.slice_of(n), device=self.place.device))

    def take(self, index: Tensor) -> tuple[Tensor, "PartialShare"]:
        row = torch.full((self.n,), -1, device=index.device)
        row[self.place] = torch.arange(len(self.place), device=index.device)
        row = row[index]
        place = (row >= 0).nonzero()[:, 0]
        return row[place], PartialShare(self.ranks, len(index), place)

    def chosen(self, mask: Tensor) -> "PartialShare":
        place = (mask.flatten().cumsum(0) - 1).view(mask.shape)
        return PartialShare(self.ranks, int(mask.sum()), self.own(place, 1)[self.own(mask, 1)])

    def repeated(self, n: int) -> "PartialShare":
        first = self.n * torch.arange(n, device=self.place.device)
        return PartialShare(self.ranks, n * self.n, (first[:, None] + self.place).flatten())

    def followed_by(self, more: Share) -> "PartialShare":
        assert isinstance(more, PartialShare)
        return PartialShare(self.ranks, self.n + more.n, torch.cat([self.place, self.n + more.place]))

    def own(self, rows: Tensor, dim: int = 0) -> Tensor:
        return rows.index_select(dim, self.place)

    def spread(self, rows: Tensor) -> Tensor:
        return rows.new_zeros(self.n, *rows.shape[1:]).index_copy(0, self.place, rows)

    def mean(self, values: Tensor) -> Tensor:
        return values.sum() / self.n

    def part(self, mean: Tensor) -> Tensor:
        n_own = len(self.place)
        return mean * (n_own / self.n) if n_own else torch.zeros_like(mean)

    def add_up(self, parts: Sequence[Tensor]) -> None:
        self.ranks.add_up(parts)

    def gather(self, named: Mapping[str, Tensor]) -> dict[str, Tensor]:
        # one message: the bytes of a row of every tensor side by side, after its place
        columns = [_as_bytes(each) for each in (self.place, *named.values())]
        rows = torch.cat(self.ranks.gather(torch.cat(columns, dim=1)))
        place, *parts = rows.split([each.shape[1] for each in columns], dim=1)
        order = _from_bytes(place, self.place)
        return {
            name: own.new_empty(self.n, *own.shape[1:]).index_copy_(0, order, _from_bytes(part, own))
            for (name, own), part in zip(named.items(), parts, strict=True)
        }


def share_of(ranks: Ranks, n: int, device: torch.device) -> Share:
    """Share of this rank in `n` worlds."""
    return WHOLE if ranks.number == 1 else PartialShare(ranks, n, torch.arange(*ranks.slice_of(n), device=device))


def _as_bytes(rows: Tensor) -> Tensor:
    """[n, K] uint8: bytes of the rows [n, ...]."""
    n_bytes = math.prod(rows.shape[1:]) * rows.element_size()
    return rows.contiguous().flatten().view(torch.uint8).view(len(rows), n_bytes)


def _from_bytes(content: Tensor, like: Tensor) -> Tensor:
    """Rows of the dtype and the shape of `like` [.., ...], from their bytes [n, K]."""
    return content.clone().flatten().view(like.dtype).view(len(content), *like.shape[1:])
