"""Compilation of functions that are called in chunks of one shape."""

from collections.abc import Callable
from typing import Any

import torch


def compiled(fn: Callable) -> Callable:
    """`fn` compiled without guards and for one thread; a compiler for `tensors.chunked.ChunkedFunction`.

    Guards cost as much as a tenth of the work. They are not needed: `ChunkedFunction` keeps shapes and dtypes, and what
    `fn` is made of must never change. Compiled code belongs to a code object, and without guards a function could be
    given the code of another one, so every function gets a code object of its own. A chunk is too small for more
    threads. All of a call is C++ ("cpp_wrapper"), which leaves Python's lock to other threads with chunks of their own.
    """
    fn.__code__ = fn.__code__.replace()
    no_guards = torch.compiler.skip_all_guards_unsafe
    options: dict[str, Any] = {"guard_filter_fn": no_guards, "cpp.threads": 1, "cpp_wrapper": True}
    return torch.compile(fn, dynamic=False, options=options)
