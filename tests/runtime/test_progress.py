"""The time left in a log file."""

import time

import pytest

from negopipe.runtime.progress import LINE_INTERVAL_S, ProgressLine


def test_the_time_left_is_that_at_the_latest_pace_after_the_first_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first step takes 600 s, every other one 30 s."""
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    with ProgressLine("train", n_total=12, n_done=2) as progress:
        for seconds in (600.0, 30.0, 30.0):
            now_s += seconds
            progress.advance("")
    left = [line.rsplit("left ", 1)[1] for line in capsys.readouterr().out.splitlines()]
    assert left == ["?", "240 s", "210 s"]


def test_lines_come_at_intervals_and_at_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    with ProgressLine("train", n_total=5) as progress:
        for _ in range(5):
            now_s += LINE_INTERVAL_S / 2
            progress.advance("")
    shares = [line.split()[1] for line in capsys.readouterr().out.splitlines()]
    assert shares == ["40%", "80%", "100%"]
