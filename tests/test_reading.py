"""docs/reading.md, our reading of the paper: what the code cites of it is there."""

import re
from functools import cache
from pathlib import Path

from negopipe.evaluation import claims

ROOT = Path(__file__).parents[1]
READING = ROOT / "docs" / "reading.md"
CITATION = re.compile(r'docs/reading\.md, ("[^"]+"(?:(?:, | and |, and )"[^"]+")*)')
CITING = sorted(
    path
    for folder, suffixes in {"negopipe": ("py", "j2"), "conf": ("yaml",), "jobs": ("py", "sh", "md")}.items()
    for suffix in suffixes
    for path in (ROOT / folder).rglob(f"*.{suffix}")
)


@cache
def topics() -> set[str]:
    """Headings, and first cells of table rows."""
    text = READING.read_text(encoding="utf-8")
    return set(re.findall(r"^#+ (.+)$", text, flags=re.M)) | set(re.findall(r"^\| ([^|]+?) \|", text, flags=re.M))


def in_one_line(path: Path) -> str:
    """The text without its line breaks and the signs of comments."""
    return re.sub(r"\s*\n\s*(# )?", " ", path.read_text(encoding="utf-8"))


def cited(path: Path) -> list[str]:
    return [topic for found in CITATION.findall(in_one_line(path)) for topic in re.findall(r'"([^"]+)"', found)]


def test_what_is_cited_is_there() -> None:
    assert not [(path, topic) for path in CITING for topic in cited(path) if topic not in topics()]


def test_every_citation_has_one_form() -> None:
    texts = {path: in_one_line(path) for path in CITING}
    otherwise = [path for path, text in texts.items() if text.count("reading.md") != len(CITATION.findall(text))]
    assert not otherwise, 'cite as: docs/reading.md, "suspend number"'
    assert not [path for path, text in texts.items() if "(Reading:" in text]


def test_the_code_cites_it() -> None:
    assert len({topic for path in CITING for topic in cited(path)}) > 8


def test_the_claims_are_those_that_are_judged() -> None:
    assert {topic for topic in topics() if topic.startswith("claim ")} == {
        f"claim {number}" for number in range(1, len(claims._CLAIMS) + 1)
    }
