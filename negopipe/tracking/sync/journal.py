"""Journal of a run: its entries for a store, in order, on disk before they are sent."""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

JOURNAL_NAME = "journal.jsonl"
_TAIL = 400
"""Bytes at the end of a journal that are read for its last entry, more than an entry `end` has."""


def has_ended(path: Path) -> bool:
    """Whether the last whole line of a journal is the entry `end`.

    Only the last bytes are read, and nothing is changed, so it is cheap and safe for a run in use.
    """
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
        lines = file.read().split(b"\n")[:-1]  # behind the last line break is nothing or an unfinished line
    return bool(lines) and lines[-1].startswith(b'{"kind": "end"')


class Journal:
    """A file with one JSON mapping per line, to which lines are only appended.

    An entry has a `kind`, its `time_ms` (Unix time) and the content of that kind for `negopipe.tracking.sync.delivery`.
    The operating system has a line when `append` returns, so a process that is killed loses none.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / JOURNAL_NAME
        self.n_bytes = self._drop_torn_line()

    def append(self, kind: str, time_ms: int | None = None, **content: Any) -> int:
        """Append an entry, whole or not at all; returns its time, by default now. OSError where the disk is full."""
        time_ms = time_ms or time.time_ns() // 1_000_000
        entry = {"kind": kind, "time_ms": time_ms, **content}
        line = (json.dumps(entry) + "\n").encode()
        try:
            with self.path.open("ab", buffering=0) as file:
                n_written = file.write(line)
            if n_written < len(line):
                raise OSError(28, os.strerror(28), str(self.path))  # ENOSPC, as the next write would say
        except OSError:
            self._drop_torn_line()
            raise
        self.n_bytes += len(line)
        return time_ms

    def after(self, n_bytes: int) -> Iterator[tuple[int, dict[str, Any]]]:
        """Entries after the first `n_bytes`, each with the number of bytes up to its own end."""
        if n_bytes >= self.n_bytes:
            return
        with self.path.open("rb") as file:
            file.seek(n_bytes)
            for line in file:
                n_bytes += len(line)
                yield n_bytes, json.loads(line)

    def sync(self) -> None:
        """Wait until the journal is on the disk, safe from a loss of power."""
        if self.n_bytes:
            with self.path.open("rb+") as file:
                os.fsync(file.fileno())

    def _drop_torn_line(self) -> int:
        """Cut off a last line that a full disk or a power failure left unfinished; returns what remains, bytes."""
        if not self.path.exists():
            return 0
        with self.path.open("rb+") as file:
            n_bytes = file.read().rfind(b"\n") + 1
            if n_bytes < self.path.stat().st_size:
                file.truncate(n_bytes)
        return n_bytes
