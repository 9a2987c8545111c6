"""The journal keeps what it has, whole lines only, whatever happens to the last one."""

import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from negopipe.tracking.sync.journal import Journal


def steps(journal: Journal, n_bytes: int = 0) -> list[int]:
    return [entry["step"] for _, entry in journal.after(n_bytes)]


@pytest.fixture
def small_disk() -> Iterator[int]:
    """No file may grow beyond so many bytes: a write stops there, as it does where the disk is full."""
    before, limit = resource.getrlimit(resource.RLIMIT_FSIZE), 1000
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    yield limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_entries_come_back_in_order_from_any_place(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    assert steps(journal) == []
    for step in range(3):
        journal.append("metrics", step=step)
    ends = [n_bytes for n_bytes, _ in journal.after(0)]
    again = Journal(tmp_path)  # as another process finds it
    assert steps(again) == [0, 1, 2]
    assert steps(again, ends[0]) == [1, 2]
    assert steps(again, ends[2]) == []
    assert again.n_bytes == ends[2] == journal.n_bytes
    assert [entry["kind"] for _, entry in again.after(0)] == ["metrics"] * 3
    times = [entry["time_ms"] for _, entry in again.after(0)]
    assert times == sorted(times)


@pytest.mark.parametrize("torn", [b"{", b'{"kind": "metrics", "step": 7}', b"\x00\x00"])
def test_a_line_without_its_end_never_was(tmp_path: Path, torn: bytes) -> None:
    journal = Journal(tmp_path)
    journal.append("metrics", step=0)
    with journal.path.open("ab") as file:
        file.write(torn)
    again = Journal(tmp_path)
    again.append("metrics", step=1)
    assert steps(again) == [0, 1]


def test_a_full_disk_costs_the_new_entry_only(tmp_path: Path, small_disk: int) -> None:
    journal = Journal(tmp_path)
    journal.append("metrics", step=0)
    with pytest.raises(OSError, match=r"(No space left|File too large)"):
        journal.append("metrics", step=1, text="x" * small_disk)
    journal.append("metrics", step=2)
    assert steps(journal) == steps(Journal(tmp_path)) == [0, 2]
