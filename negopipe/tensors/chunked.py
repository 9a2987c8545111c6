"""Calls of a batched function on chunks of worlds of one size.

A compiled function is compiled for one shape. In chunks it serves any number of worlds with one compilation, its
intermediate tensors stay in the cache, memory does not grow with the number of worlds, and the result of a world does
not depend on the number of worlds beside it.

A world has dozens of tensors, and passing each of them costs as much as computing with them. So they are passed as
columns of one table per dtype. A chunk is a range of rows.

Compiled chunks on a CPU are computed in as many threads as torch uses. Each takes the next chunk once it is done with
one, so that a thread whose core is busy elsewhere holds up nobody but at the end.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from negopipe.tensors.tree import map_tensors, tensors

Tables = tuple[Tensor, ...]
"""Tensors [E, columns], one per dtype."""


class _Columns(NamedTuple):
    """Place of a tensor: index of its table, first column and one past the last column; shape without E."""

    table: int
    first: int
    last: int
    shape: tuple[int, ...]


class Layout:
    """Layout in tables of the tensors of `example`, all [E, ...]: a tensor, tensor dataclass or tuple of such."""

    def __init__(self, example: Any) -> None:
        leaves = tensors(example)
        self._empty = map_tensors(lambda leaf: leaf[:0], example)
        self._dtypes = list(dict.fromkeys(leaf.dtype for leaf in leaves))
        n_columns = [0] * len(self._dtypes)
        self._columns: list[_Columns] = []
        for leaf in leaves:
            table, shape = self._dtypes.index(leaf.dtype), tuple(leaf.shape[1:])
            first = n_columns[table]
            n_columns[table] += math.prod(shape)
            self._columns.append(_Columns(table, first, n_columns[table], shape))
        self._n_columns = n_columns

    def empty(self, n: int, device: torch.device) -> Tables:
        """Tables of `n` rows, to be filled."""
        columns = zip(self._n_columns, self._dtypes, strict=True)
        return tuple(torch.empty(n, n_columns, dtype=dtype, device=device) for n_columns, dtype in columns)

    def pack(self, tree: Any) -> Tables:
        """Tables of the tensors of `tree`, which has the structure of the example and any E."""
        parts: list[list[Tensor]] = [[] for _ in self._dtypes]
        for leaf, at in zip(tensors(tree), self._columns, strict=True):
            parts[at.table].append(leaf.reshape(len(leaf), at.last - at.first))
        return tuple(columns[0] if len(columns) == 1 else torch.cat(columns, dim=1) for columns in parts)

    def unpack(self, tables: Tables) -> Any:
        """The tree of some tables; its tensors are views."""
        n = len(tables[0])
        leaves = iter([tables[at.table][:, at.first : at.last].reshape(n, *at.shape) for at in self._columns])
        return map_tensors(lambda _: next(leaves), self._empty)


class ChunkedFunction:
    """Function `fn`, called on one of some numbers of worlds at a time.

    fn: maps tensors, tensor dataclasses or tuples of them to such; axis 0 of every tensor is the worlds
    sizes: numbers of worlds per call; a compiler compiles `fn` for each that is needed
    compiler: compiles a function of tables; the last chunk is then padded with copies of its last world, so that all
        chunks have one shape. None = `fn` is not compiled
    """

    def __init__(
        self, fn: Callable[..., Any], sizes: Sequence[int], compiler: Callable[[Callable], Callable] | None
    ) -> None:
        self.fn, self.sizes, self.compiler = fn, sorted(sizes), compiler
        self._on_tables: dict[tuple, tuple[Layout, Layout, Callable[..., Tables]]] = {}

    def __call__(self, *args: Any) -> Any:
        leaves = tensors(args)
        signature = tuple((leaf.dtype, leaf.shape[1:]) for leaf in leaves)
        is_new = signature not in self._on_tables
        if is_new:
            self._on_tables[signature] = self._prepare(args)
        arguments, result, fn = self._on_tables[signature]
        tables, n_worlds = arguments.pack(args), len(leaves[0])
        chunks = list(self._chunks(n_worlds))
        if chunks == [(0, n_worlds)]:
            return result.unpack(fn(*tables))
        whole = result.empty(n_worlds, tables[0].device)

        def compute(chunk: tuple[int, int]) -> None:
            start, size = chunk
            for table, part in zip(whole, fn(*self._rows(tables, start, size)), strict=True):
                table[start : start + size] = part[: n_worlds - start]

        is_parallel = self.compiler is not None and not is_new and not tables[0].is_cuda  # the first call compiles
        n_threads = torch.get_num_threads() if is_parallel else 1
        list((_threads(n_threads, os.getpid()).map if n_threads > 1 else map)(compute, chunks))
        return result.unpack(whole)

    def _prepare(self, args: Any) -> tuple[Layout, Layout, Callable[..., Tables]]:
        """Layouts of the arguments and of the result, found by a call for one world, and `fn` from tables to tables."""
        arguments = Layout(args)
        result = Layout(self.fn(*map_tensors(lambda leaf: leaf[:1], args)))

        def on_tables(*tables: Tensor) -> Tables:
            return result.pack(self.fn(*arguments.unpack(tables)))

        return arguments, result, self.compiler(on_tables) if self.compiler else on_tables

    def _chunks(self, n_worlds: int) -> Iterator[tuple[int, int]]:
        """First world and size of every chunk: the largest size, and for the rest the smallest that holds it."""
        for start in range(0, n_worlds, self.sizes[-1]):
            yield start, next((size for size in self.sizes if size >= n_worlds - start), self.sizes[-1])

    def _rows(self, tables: Tables, start: int, size: int) -> Tables:
        n_missing = start + size - len(tables[0])
        if n_missing <= 0 or not self.compiler:
            return tuple(table[start : start + size] for table in tables)
        return tuple(torch.cat([table[start:], table[-1:].expand(n_missing, -1)]) for table in tables)


@cache
def _threads(n: int, process: int) -> ThreadPoolExecutor:
    """Threads of a process, each with one thread of torch; a forked process has none of its parent's."""
    return ThreadPoolExecutor(n, "chunks", _begin_thread)


def _begin_thread() -> None:
    torch.set_num_threads(1)  # those of the other threads stay as they are
    torch.set_grad_enabled(False)
