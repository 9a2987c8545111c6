"""Interruption of long work between two steps, where nothing is lost."""

import signal
import threading
from types import FrameType, TracebackType

PATIENCE_S = 5
"""Longest wait for the end of a step, s. A longer step is broken off, and the work since the last snapshot is lost."""


class DeferredInterrupt:
    """Context manager that defers Ctrl-C and SIGTERM to the end of the running step, by `PATIENCE_S` at most.

    A call of the object returns whether a signal has come. `raise_if_requested` then raises the signal's exception. A
    second signal acts at once.
    """

    def __init__(self) -> None:
        self._asked: int | None = None
        self._handlers: dict[int, signal.Handlers] = {}

    def __call__(self) -> bool:
        return self._asked is not None

    def raise_if_requested(self) -> None:
        """Raise KeyboardInterrupt or SystemExit(128 + signal) if a signal has come."""
        if self._asked == signal.SIGINT:
            raise KeyboardInterrupt
        if self._asked is not None:
            raise SystemExit(128 + self._asked)

    def __enter__(self) -> "DeferredInterrupt":
        if threading.current_thread() is threading.main_thread():  # Python handles signals nowhere else
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._note)  # type: ignore[assignment]
            self._handlers[signal.SIGALRM] = signal.signal(signal.SIGALRM, lambda *_: self.raise_if_requested())  # type: ignore[assignment]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handlers:
            signal.alarm(0)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._asked is not None:
            self.raise_if_requested()
        self._asked = number
        signal.alarm(PATIENCE_S)
