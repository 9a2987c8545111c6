"""The keys of a YAML file and the comments that explain them.

A key is explained by the comment behind it (deeper comment lines continue it), else by the comment lines right above
it, else by a line `name: text` in the comment of a key that it is part of.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

COMMENT_LINE = re.compile(r"\s*# ?(.*)")


@dataclass(frozen=True)
class Key:
    """A key of a file.

    path: names from the file's top, joined by dots
    value: as the file writes it, in one line
    meaning: the comment; empty if there is none
    is_section: a mapping whose keys follow as keys of their own
    is_of_another_group: the name itself has dots
    """

    path: str
    value: str
    meaning: str
    is_section: bool
    is_of_another_group: bool = False


def header(text: str) -> str:
    """The comment that the file begins with, without Hydra's `@package` line."""
    lines = text.splitlines()[: _header_length(text.splitlines())]
    return " ".join(line.lstrip("# ") for line in lines if not line.startswith("# @package"))


def package(text: str) -> str | None:
    """Where Hydra puts the file's keys, if the file says so."""
    found = re.match(r"# @package (\S+)", text)
    return found[1] if found else None


def keys(path: Path) -> list[Key]:
    """All keys but `defaults`, in the file's order."""
    text = path.read_text(encoding="utf-8")
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    return list(_keys(node, text.splitlines(), "", [])) if isinstance(node, yaml.MappingNode) else []


def _keys(node: yaml.MappingNode, lines: list[str], prefix: str, above: list[str]) -> Iterator[Key]:
    for name, value in node.value:
        if not prefix and name.value == "defaults":
            continue
        comment = _comment(name, value, lines)
        meaning = comment or next((told for text in above if (told := _named(text, name.value))), "")
        is_section = isinstance(value, yaml.MappingNode) and not value.flow_style and bool(value.value)
        path = f"{prefix}{name.value}"
        yield Key(path, "" if is_section else _value(value), meaning, is_section, "." in name.value)
        if is_section:
            yield from _keys(value, lines, f"{path}.", [comment, *above])


def _comment(name: yaml.Node, value: yaml.Node, lines: list[str]) -> str:
    is_block = isinstance(value, yaml.CollectionNode) and not value.flow_style
    end = name.end_mark if is_block else value.end_mark
    line = lines[end.line] if end.line < len(lines) else ""  # a text of several lines may end the file
    behind = re.fullmatch(r":?\s*#\s*(.*)", line[end.column :])
    if behind:
        return " ".join([behind[1], *_deeper(lines, end.line + 1, name.start_mark.column)])
    first = last = name.start_mark.line
    mark = " " * name.start_mark.column + "#"
    while first > _header_length(lines) and lines[first - 1].startswith(mark):
        first -= 1
    return " ".join(line.strip(" #") for line in lines[first:last])


def _deeper(lines: list[str], start: int, column: int) -> Iterator[str]:
    for line in lines[start:]:
        found = COMMENT_LINE.fullmatch(line)
        if not found or line.index("#") <= column:
            return
        yield found[1]


def _header_length(lines: list[str]) -> int:
    return next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))


def _named(comment: str, name: str) -> str:
    found = re.search(rf"(?:^|[.;:] ){re.escape(name)}: (.*?)(?=[.;] [a-z]\w*: |$)", comment)
    return found[1] if found else ""


def _value(node: yaml.Node) -> str:
    plain = yaml.safe_load(yaml.serialize(node, Dumper=yaml.SafeDumper))
    return yaml.safe_dump(plain, default_flow_style=True, width=10**6, allow_unicode=True).removesuffix("...\n").strip()
