"""Progress of long work: a live bar on a terminal, a line at intervals elsewhere."""

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

LINE_INTERVAL_S = 20.0
"""Time between two lines in a log file, s."""


class ProgressLine:
    """Context manager that shows the progress of `n_total` steps, of which `n_done` were done before.

    On a terminal it is a bar with the latest text and the time left, in a log file a line of these every 20 s. The time
    left is that at the pace since the line before. The first step compiles, so its pace says nothing.
    """

    def __init__(self, title: str, n_total: int, n_done: int = 0) -> None:
        self.title, self.n_total, self.n_done, self._n_first = title, n_total, n_done, n_done + 1
        console = Console()
        self._is_live = console.is_terminal
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=6),
            TaskProgressColumn(),
            TextColumn("{task.fields[text]}"),
            TextColumn("left"),
            TimeRemainingColumn(compact=True),
            console=console,
            disable=not self._is_live,
        )
        self._task = self._bar.add_task(title, total=n_total, completed=n_done, text="")
        self._said_s, self._n_said = time.monotonic(), n_done

    def advance(self, text: str, n: int = 1) -> None:
        """Count `n` more steps and show `text` beside the bar."""
        self.n_done += n
        self._bar.update(self._task, advance=n, text=text)
        now_s = time.monotonic()
        is_due = now_s - self._said_s >= LINE_INTERVAL_S or self.n_done >= self.n_total
        if not self._is_live and is_due:
            left_s = (now_s - self._said_s) / (self.n_done - self._n_said) * (self.n_total - self.n_done)
            left = f"{left_s:.0f} s" if self.n_done > self._n_first or left_s == 0 else "?"
            print(f"{self.title} {self.n_done / self.n_total:4.0%}  {text}  left {left}", flush=True)
            self._said_s, self._n_said = now_s, self.n_done

    def __enter__(self) -> "ProgressLine":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
