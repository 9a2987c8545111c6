"""Functions on a GPU as CUDA graphs: recorded once, then launched as a whole.

A decision is thousands of small operations. Launching them one by one takes a GPU longer than computing them. A graph
runs the same kernels on the same memory in one launch, so its results are those of the function itself.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from negopipe.tensors.chunked import Tables


class GraphedFunction:
    """Function `fn` of tables, recorded for every number of rows that it meets.

    fn: without transfers to or from the host, which cannot be recorded
    """

    def __init__(self, fn: Callable[..., Tables]) -> None:
        self._fn = fn
        self._recorded: dict[int, _Recorded] = {}

    def __call__(self, *tables: Tensor) -> Tables:
        """The result, in memory of its own."""
        n_rows = len(tables[0])
        if n_rows not in self._recorded:
            self._recorded[n_rows] = _Recorded(self._fn, tables)
        return self._recorded[n_rows](*tables)


class _Recorded:
    """A graph, with the memory that it reads from and writes to."""

    _memory: Any = None
    """Memory of all graphs: they never run at once, and their results are copied before the next one runs."""

    def __init__(self, fn: Callable[..., Tables], example: Tables) -> None:
        self._given = tuple(table.clone() for table in example)
        before = torch.cuda.Stream()
        before.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(before):
            fn(*self._given)  # libraries set themselves up in a first call, which cannot be recorded
        torch.cuda.current_stream().wait_stream(before)
        _Recorded._memory = _Recorded._memory or torch.cuda.MemPool()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=_Recorded._memory.id):
            self._results = fn(*self._given)

    def __call__(self, *tables: Tensor) -> Tables:
        for memory, table in zip(self._given, tables, strict=True):
            memory.copy_(table)
        self._graph.replay()
        return tuple(result.clone() for result in self._results)
