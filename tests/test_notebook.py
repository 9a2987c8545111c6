"""The notebook of examples/ is small and well formed, and its cells run from the first to the last."""

import ast
import json
import sys
from io import BytesIO
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from PIL import Image

NOTEBOOK = Path(__file__).parents[1] / "examples" / "first_film.ipynb"
MOST_CELLS = 8
MOST_BYTES = 200_000
INSTALL = "%pip install"


def read() -> dict[str, Any]:
    """The notebook as the file has it."""
    found: dict[str, Any] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return found


def programs() -> list[str]:
    """Code of the cells, without the one that installs."""
    sources = ["".join(cell["source"]) for cell in read()["cells"] if cell["cell_type"] == "code"]
    return [source for source in sources if not source.startswith(INSTALL)]


def notebook_display(shown: list[Any]) -> ModuleType:
    """A stand-in for IPython.display, which keeps what is displayed in `shown`."""
    module: Any = ModuleType("IPython.display")
    module.display = shown.append
    module.Image = lambda data, format: SimpleNamespace(data=data, format=format)
    return module  # type: ignore[no-any-return]


def test_the_notebook_has_few_cells_and_no_outputs() -> None:
    notebook, cells = read(), read()["cells"]
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert NOTEBOOK.stat().st_size <= MOST_BYTES
    assert len(cells) <= MOST_CELLS
    assert len({cell["id"] for cell in cells}) == len(cells)
    assert {cell["cell_type"] for cell in cells} == {"markdown", "code"}
    kept = [(cell["outputs"], cell["execution_count"]) for cell in cells if cell["cell_type"] == "code"]
    assert kept == [([], None)] * len(kept)


def test_the_notebook_installs_first_and_is_plain_python() -> None:
    (first, *_) = [cell for cell in read()["cells"] if cell["cell_type"] == "code"]
    assert first["source"] == [f"{INSTALL} --quiet --editable .."]
    for source in programs():
        ast.parse(source)


@pytest.mark.slow
def test_the_notebook_ends_in_two_films(monkeypatch: pytest.MonkeyPatch) -> None:
    """The policy goes first where the other gives way, and lets one pass that pushes, as the text has it."""
    shown: list[Any] = []
    monkeypatch.setitem(sys.modules, "IPython.display", notebook_display(shown))
    names: dict[str, Any] = {}
    for source in programs():
        exec(compile(source, "a cell", "exec"), names)
    _, horizons, first, table, second = shown
    assert isinstance(table, pd.DataFrame)
    assert list(table.loc["passes_first"]) == ["ego", "social"]
    assert list(table.loc["outcome"]) == ["success", "success"]
    assert horizons["decisions"].sum() == table.loc["n_decisions"].iloc[0]
    for film, n_decisions in zip((first, second), table.loc["n_decisions"], strict=True):
        with Image.open(BytesIO(film.data)) as gif:
            assert gif.format == "GIF"
            assert gif.n_frames == n_decisions + 1  # type: ignore[attr-defined]
