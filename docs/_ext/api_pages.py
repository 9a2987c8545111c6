"""The API reference: a page per part of the map in negopipe's docstring, written before the site is built."""

import re
from pathlib import Path

import negopipe

PACKAGE = Path(negopipe.__file__).parent
FACE = "negopipe"
"""The package itself, whose functions are the public face."""
PART = re.compile(r"^    (\w+) {2,}(\S.*)$", flags=re.MULTILINE)


def parts() -> dict[str, str]:
    """Parts of the package and what they are, lowest first."""
    return dict(PART.findall((negopipe.__doc__ or "").partition("One decision")[0]))


def modules(part: str) -> list[str]:
    """Names of a part's modules, the package itself first."""
    if not (PACKAGE / part).is_dir():
        return [f"negopipe.{part}"]
    paths = (path.relative_to(PACKAGE.parent).with_suffix("") for path in (PACKAGE / part).rglob("*.py"))
    return sorted(".".join(path.parts).removesuffix(".__init__") for path in paths)


def write(folder: Path) -> None:
    """Write `index.rst` and a page per part into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.rst"):
        old.unlink()
    pages = {FACE: "the map and the public face"} | parts()
    rows = [f"   * - :doc:`{_shown(page)} <{page}>`\n     - {text}" for page, text in pages.items()]
    listed = "\n".join(f"   {page}" for page in pages)
    index = [
        _title("API reference", "="),
        "The parts of the package, lowest first: each imports only those above it.",
        ".. list-table::\n   :widths: 20 80\n\n" + "\n".join(rows),
        ".. toctree::\n   :hidden:\n\n" + listed,
    ]
    _write(folder / "index.rst", index)
    _write(folder / f"{FACE}.rst", [_title(FACE, "="), _members(FACE)])
    for part, text in parts().items():
        _write(folder / f"{part}.rst", [_title(_shown(part), "="), f"*{text}*", *map(_module, modules(part))])


def _module(name: str) -> str:
    return f"{_title(_shown(name.removeprefix(f'{FACE}.')), '-')}\n\n{_members(name)}"


def _members(name: str) -> str:
    return f".. automodule:: {name}\n   :members:"


def _title(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}"


def _shown(name: str) -> str:
    return name.replace("_", r"\_")


def _write(path: Path, paragraphs: list[str]) -> None:
    path.write_text("\n\n".join(paragraphs) + "\n", encoding="utf-8")
