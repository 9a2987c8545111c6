"""Compilation of functions that are called in chunks of one shape."""

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

import torch


def compiled(fn: Callable) -> Callable:
    """`fn` compiled without guards and for one thread; a compiler for `tensors.chunked.ChunkedFunction`.

    Guards cost as much as a tenth of the work. They are not needed: `ChunkedFunction` keeps shapes and dtypes, and what
    `fn` is made of must never change. Compiled code belongs to a code object, and without guards a function could be
    given the code of another one, so every function gets a code object of its own. A chunk is too small for more
    threads. All of a call is C++ ("cpp_wrapper"), which leaves Python's lock to other threads with chunks of their own.
    Operators written in Python are the exception (`tensors.sparse`), and Ctrl-C waits until they are done.
    """
    fn.__code__ = fn.__code__.replace()
    no_guards = torch.compiler.skip_all_guards_unsafe
    options: dict[str, Any] = {"guard_filter_fn": no_guards, "cpp.threads": 1, "cpp_wrapper": True}
    in_cpp = torch.compile(fn, dynamic=False, options=options)

    def call(*args: Any) -> Any:
        if threading.current_thread() is not threading.main_thread():  # Python handles signals nowhere else
            return in_cpp(*args)
        with OutsideOperators():
            return in_cpp(*args)

    return call


class OutsideOperators:
    """Context in which no signal handler runs within a Python operator that compiled code calls.

    An exception of the handler, such as KeyboardInterrupt, would pass through C++, which makes it a RuntimeError that
    does not name it. The handler runs at the end of the context instead.
    """

    def __enter__(self) -> None:
        self._waiting: list[int] = []
        self._handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._handle)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        for number in self._waiting:
            self._handlers[number](number, sys._getframe())

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if _is_in_operator(frame):
            self._waiting.append(number)
        else:
            self._handlers[number](number, frame)


def _is_in_operator(frame: FrameType | None) -> bool:
    """Whether torch calls a Python operator in this frame or in a caller's."""
    while frame is not None and "torch/_library/" not in frame.f_code.co_filename:
        frame = frame.f_back
    return frame is not None
