"""Functions of many items, computed for those items alone that count.

How many count differs from call to call, which neither compiled code nor a CUDA graph nor an exported program can
follow: these have one shape. Within compiled code on a CPU the items are therefore picked by an operator of its own,
which computes them in chunks of one size by a function that is compiled apart. A GPU and an exported program compute
all items, and so does compiled code where all of them are no more than a chunk.
"""

from collections.abc import Callable
from functools import cached_property
from weakref import WeakValueDictionary

import torch
from torch import Tensor

from negopipe.tensors.compiled import compiled

CHUNK = 1024
"""Items per call of compiled code: many enough to outweigh the cost of a call, few enough to stay in the cache."""


class SparseFunction:
    """Function `fn` of items that each belong to one of N owners.

    fn: [A, ..., M], of the items' owners, and [B, ..., M], of the items -> [n_results, ..., M]; item by item
    otherwise: [n_results] float32, the results of an item that does not count
    """

    def __init__(self, fn: Callable[[Tensor, Tensor], Tensor], otherwise: Tensor) -> None:
        self.fn, self.otherwise = fn, otherwise
        self._key = next(key for key in range(len(_FUNCTIONS) + 1) if key not in _FUNCTIONS)
        _FUNCTIONS[self._key] = self

    def __call__(self, counts: Tensor, of_owners: Tensor, of_items: Tensor) -> Tensor:
        """Results [n_results, ..., N].

        counts: [..., N] bool; of_owners: [A, N]; of_items: [B, ..., N]
        """
        is_small = torch.compiler.is_compiling() and counts.numel() <= CHUNK
        if counts.is_cuda or torch.compiler.is_exporting() or is_small:
            results = self.fn(of_owners.reshape(len(of_owners), *[1] * (counts.dim() - 1), -1), of_items)
            return torch.where(counts, results, self.otherwise.reshape(-1, *[1] * counts.dim()))
        if torch.compiler.is_compiling():
            return torch.ops.negopipe.counting(self._key, len(self.otherwise), counts, of_owners, of_items)
        return self.counting(counts, of_owners, of_items, self.fn, None)

    def counting(
        self, counts: Tensor, of_owners: Tensor, of_items: Tensor, fn: Callable[..., Tensor], chunk: int | None
    ) -> Tensor:
        """As a call, with `fn` for the items that count, in chunks of a size or all at once."""
        results = self.otherwise[:, None].repeat(1, counts.numel())
        at = counts.flatten().nonzero()[:, 0]
        if chunk and len(at):
            at = torch.cat([at, at[-1:].expand(-len(at) % chunk)])  # the last item again and again, with one result
        for part in at.split(chunk or len(at)) if len(at) else ():
            owner = part % counts.shape[-1]
            own, its = of_owners.index_select(1, owner), of_items.flatten(1).index_select(1, part)
            results.index_copy_(1, part, fn(own, its))
        return results.unflatten(1, counts.shape)

    @cached_property
    def compiled(self) -> Callable[[Tensor, Tensor], Tensor]:
        """`fn` for a chunk of items."""
        return compiled(lambda own, its: self.fn(own, its))


_FUNCTIONS: "WeakValueDictionary[int, SparseFunction]" = WeakValueDictionary()


@torch.library.custom_op("negopipe::counting", mutates_args=())
def _counting(key: int, n_results: int, counts: Tensor, of_owners: Tensor, of_items: Tensor) -> Tensor:
    function = _FUNCTIONS[key]
    return function.counting(counts, of_owners, of_items, function.compiled, CHUNK)


@_counting.register_fake
def _(key: int, n_results: int, counts: Tensor, of_owners: Tensor, of_items: Tensor) -> Tensor:
    return of_items.new_empty(n_results, *counts.shape)
