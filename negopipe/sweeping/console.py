"""Tables on the terminal."""

from rich.console import Console
from rich.table import Table

WIDTH = 160
"""Characters of a line where the output is no terminal."""


def show(table: Table) -> None:
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)
