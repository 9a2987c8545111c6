"""Functions of many items, computed for those items alone that count.

How many count differs from call to call, which neither compiled code nor a CUDA graph nor an exported program can
follow: these have one shape. Within compiled code on a CPU the items are therefore picked by an operator of its own,
which computes them in chunks of one size by a function that is compiled apart. A GPU and an exported program compute
all items.
"""

from collections.abc import Callable
from functools import cached_property
from weakref import WeakValueDictionary

import torch
from torch import Tensor
from torch.nn.functional import pad

from negopipe.tensors.compiled import compiled

CHUNK = 1024
"""Items per call of compiled code: many enough to outweigh the cost of a call, few enough to stay in the cache."""


class SparseFunction:
    """Function `fn` of items that each belong to one of N owners.

    fn: [A, ..., M], of the items' owners, and [B, ..., M], of the items -> [n_results, ..., M]; item by item
    """

    def __init__(self, fn: Callable[[Tensor, Tensor], Tensor], n_results: int) -> None:
        self.fn, self.n_results = fn, n_results
        self._key = next(key for key in range(len(_FUNCTIONS) + 1) if key not in _FUNCTIONS)
        _FUNCTIONS[self._key] = self

    def __call__(self, counts: Tensor, of_owners: Tensor, of_items: Tensor) -> Tensor:
        """Results [n_results, ..., N] of the items that count; the others' numbers mean nothing.

        counts: [..., N] bool; of_owners: [A, N]; of_items: [B, ..., N]
        """
        if counts.is_cuda or torch.compiler.is_exporting():
            return self.fn(of_owners.reshape(len(of_owners), *[1] * (counts.dim() - 1), -1), of_items)
        if torch.compiler.is_compiling():
            return torch.ops.negopipe.counting(self._key, self.n_results, counts, of_owners, of_items)
        return self.counting(counts, of_owners, of_items, lambda owners, items: self.fn(owners, items))

    def counting(self, counts: Tensor, of_owners: Tensor, of_items: Tensor, fn: Callable) -> Tensor:
        """As a call, with `fn` for items that are picked out."""
        at = counts.flatten().nonzero()[:, 0]
        whole = of_items.new_zeros(self.n_results, counts.numel())
        if len(at):
            whole[:, at] = fn(of_owners[:, at % counts.shape[-1]], of_items.flatten(1)[:, at])
        return whole.unflatten(1, counts.shape)

    def in_chunks(self, of_owners: Tensor, of_items: Tensor) -> Tensor:
        """[n_results, M] of items [A, M] and [B, M], by compiled code."""
        n_items = of_owners.shape[1]
        missing = -n_items % CHUNK
        owners, items = (pad(rows, (0, missing), mode="replicate") for rows in (of_owners, of_items))
        pieces = [
            self._compiled(owners[:, i : i + CHUNK].contiguous(), items[:, i : i + CHUNK].contiguous())
            for i in range(0, n_items, CHUNK)
        ]
        return torch.cat(pieces, dim=1)[:, :n_items]

    @cached_property
    def _compiled(self) -> Callable[[Tensor, Tensor], Tensor]:
        return compiled(lambda owners, items: self.fn(owners, items))


_FUNCTIONS: "WeakValueDictionary[int, SparseFunction]" = WeakValueDictionary()


@torch.library.custom_op("negopipe::counting", mutates_args=())
def _counting(key: int, n_results: int, counts: Tensor, of_owners: Tensor, of_items: Tensor) -> Tensor:
    function = _FUNCTIONS[key]
    return function.counting(counts, of_owners, of_items, function.in_chunks)


@_counting.register_fake
def _(key: int, n_results: int, counts: Tensor, of_owners: Tensor, of_items: Tensor) -> Tensor:
    return of_items.new_empty(n_results, *counts.shape)
