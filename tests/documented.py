"""What README.md, CONTRIBUTING.md and docs/ say: their commands, links, headings and tables of results."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]

FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```", flags=re.M | re.S)
LINK = re.compile(r"(?<!`)\[[^\]]*\]\(([^)\s]+)\)")
TABLE = re.compile(r"<!-- from ([^>]*?)(?: where (\w+)=([\w.]+))? -->\n+((?:\|[^\n]*\n)+)")
NUMBER = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?![\w.]*\w)")


def blocks(text: str, language: str = "") -> list[str]:
    """Fenced blocks of a language; those without one hold commands."""
    return [block for name, block in FENCE.findall(text) if name == language]


def commands(path: Path) -> list[str]:
    """Commands of a page, without comments."""
    lines = (line for block in blocks(path.read_text(encoding="utf-8")) for line in block.splitlines())
    return [command for line in lines if (command := re.sub(r"(^|\s+)#.*", "", line).strip())]


def all_commands() -> list[str]:
    """Commands of all pages, each once, in their order."""
    return list(dict.fromkeys(command for page in PAGES for command in commands(page)))


def overrides(command: str) -> list[str] | None:
    """Overrides of a `python -m negopipe` that a single run can be composed with; None for other commands.

    `torchrun` stands for python. Of a sweep's values the first counts. Hydra's own keys, ranges of a search and what
    stands for a checkpoint are left to the test that runs the command.
    """
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S*", word)]
    if words[:2] == ["torchrun", "--nproc-per-node"]:
        words = ["python", *words[3:]]
    if words[:3] != ["python", "-m", "negopipe"]:
        return None
    options = {"--cfg", "job", "--help", "-m"}
    kept = [
        word for word in words[3:] if word not in options and not re.search(r"hydra[/.]|interval\(|choice\(|<", word)
    ]
    return [re.sub(r"=([^,\[{]*),.*", r"=\1", word) if "-m" in words[3:] else word for word in kept]


def links(path: Path) -> list[str]:
    """Targets of the links and pictures of a page that are not elsewhere on the web."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    return [target for target in LINK.findall(text) if not re.match(r"\w+:", target)]


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", path.read_text(encoding="utf-8")), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@dataclass(frozen=True)
class Results:
    """A table of a page that is made of raw tables.

    sources: the raw files
    header, rows: cells as texts; the first of a row names the planner
    where: column and value of the raw rows that count; None = all
    """

    sources: list[Path]
    header: list[str]
    rows: list[list[str]]
    where: tuple[str, str] | None

    def raw(self) -> list[pd.DataFrame]:
        tables = [pd.read_csv(source, dtype={"planner": str, "setting": str}) for source in self.sources]
        if self.where is None:
            return tables
        column, value = self.where
        return [table[table[column].astype(str) == value] for table in tables]


def results(path: Path) -> Iterator[Results]:
    """Tables of a page below `<!-- from jobs/results/<file>.csv[, ...] [where <column>=<value>] -->`."""
    for sources, column, value, table in TABLE.findall(path.read_text(encoding="utf-8")):
        header, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
        files = [ROOT / name for name in re.split(r",\s*", sources)]
        yield Results(files, header, rows, (column, value) if column else None)


def unsupported(table: Results) -> list[str]:
    """Cells whose numbers the raw tables do not bear out, as row: cell.

    They do if all numbers of the cell stand in one raw row, or if the cell is `a to b` and these are the smallest and
    the largest value of a raw column. A number stands for a value, or for a hundred times a value, that rounds to it.
    Raw rows are those of the planner, algorithm or case that the row names (`fixed 2 s` is `fixed_2`, `policy` is
    `adaptive`) and of the setting that the column's head begins with, where the raw table has such rows.
    """
    return [
        f"{row[0]}: {head} {cell}"
        for row in table.rows
        for head, cell in zip(table.header[1:], row[1:], strict=True)
        if not any(_bears_out(_rows_of(raw, row[0], head).select_dtypes("number"), cell) for raw in table.raw())
    ]


def _bears_out(raw: pd.DataFrame, cell: str) -> bool:
    written = NUMBER.findall(cell)
    rows = raw.to_numpy().tolist()
    if re.fullmatch(rf"{NUMBER.pattern} to {NUMBER.pattern}", cell):
        rows += [[raw[column].min(), raw[column].max()] for column in raw]
    return not written or any(all(_stands_in(number, values) for number in written) for values in rows)


def _stands_in(number: str, values: list[float]) -> bool:
    plain = number.replace(",", "")
    slack = 0.5 * 10 ** -len(plain.partition(".")[2]) + 1e-9
    return any(abs(factor * value - float(plain)) <= slack for value in values for factor in (1, 100))


def _rows_of(raw: pd.DataFrame, label: str, head: str) -> pd.DataFrame:
    slug = re.sub(r"\W+", "_", re.sub(r"(?<=\d) s\b", "", label.lower())).replace("policy", "adaptive")
    for column in {"planner", "algorithm"} & set(raw.columns):
        known = raw[column].unique()
        raw = _those(raw, column, [slug] if slug in known else [name for name in known if slug.startswith(name)])
    if "case" in raw:
        raw = _those(raw, "case", [label.strip("`")])
    if "setting" in raw:
        raw = _those(raw, "setting", re.findall(r"^\w+(?=:)", head))
    return _those(raw, "seed", [int(seed) for seed in re.findall(r"seed (\d+)", label)]) if "seed" in raw else raw


def _those(raw: pd.DataFrame, column: str, names: list) -> pd.DataFrame:
    chosen = raw[raw[column].isin(names)]
    return chosen if len(chosen) else raw
