"""Layout of a flat row of numbers that describes one agent and two sets of elements around it."""

from typing import NamedTuple

from torch import Tensor


class Elements(NamedTuple):
    """A set of `n` elements of `width` numbers each."""

    n: int
    width: int

    @property
    def n_numbers(self) -> int:
        """Numbers of all elements."""
        return self.n * self.width


class RowBlocks(NamedTuple):
    """Blocks of a row, in their order.

    own: numbers of the agent itself
    others: the other road users; the first number of an element is its mask, 1 for one that is known. All numbers of an
        element that is not known are 0
    street: points of the street, all of them known
    """

    own: int
    others: Elements
    street: Elements

    @property
    def n_numbers(self) -> int:
        """Numbers of a row."""
        return self.own + self.others.n_numbers + self.street.n_numbers

    def split(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows [..., n_numbers] -> the agent [..., own], others [..., n, width], street [..., n, width]; views."""
        own, others, street = rows.split([self.own, self.others.n_numbers, self.street.n_numbers], dim=-1)
        return own, others.unflatten(-1, tuple(self.others)), street.unflatten(-1, tuple(self.street))
