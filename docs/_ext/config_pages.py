"""The reference of the configuration: every key of conf/ with its value and the comment beside it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

from docstrings import escaped
from yaml_comments import Key, header, keys, package

from negopipe import CONF

FREE = ("experiment", "unseen")
"""The groups whose options only set keys of other groups."""
NOT_OURS = "hydra"
"""Section of the root whose keys are Hydra's own."""
KIND = "the implementation that the option's other keys configure"
"""Meaning of `kind` in every group."""
NAMED_ELSEWHERE = "a key of the group that its name begins with"
LONGEST_VALUE = 100


known_keys = cache(keys)
"""Keys of a file of conf/, which is parsed once: every other option of its group asks for them."""


def options() -> dict[str, list[Path]]:
    """Option files by group, the root first (group "")."""
    groups: dict[str, list[Path]] = {"": [CONF / "config.yaml"]}
    for path in sorted(CONF.rglob("*.yaml")):
        if path.parent != CONF:
            groups.setdefault(path.parent.relative_to(CONF).as_posix(), []).append(path)
    return groups


def explained(group: str, path: Path) -> list[Key]:
    """Keys of an option; what it does not explain itself, another option of the group may.

    A name with dots is a key of another group, which explains it.
    """
    others = {"kind": KIND} | {
        key.path: key.meaning for other in options()[group] for key in known_keys(other) if key.meaning
    }
    own = [key for key in known_keys(path) if group or key.path.split(".")[0] != NOT_OURS]
    return [replace(key, meaning=key.meaning or others.get(key.path, "")) for key in own]


def undocumented() -> list[str]:
    """Keys that nothing explains, as file: key. A section needs no explanation where its keys have one."""
    checked = [(group, path) for group, paths in options().items() for path in paths if group not in FREE]
    return [
        f"{path.relative_to(CONF.parent)}: {key.path}"
        for group, path in checked
        for key in explained(group, path)
        if not (key.meaning or key.is_section or key.is_of_another_group)
    ]


def write(path: Path) -> None:
    """Write the page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(_page()), encoding="utf-8")


def _page() -> Iterator[str]:
    yield from _title("Configuration reference", "=")
    yield "A run is one option per group of ``conf/``, with single values changed as ``key=value``. Below stand"
    yield "the keys that each option file sets, their values in it and their meaning."
    yield ""
    for group, paths in options().items():
        yield from _title(group or "The run", "-")
        for path in paths:
            yield from _option(group, path)


def _option(group: str, path: Path) -> Iterator[str]:
    text = path.read_text(encoding="utf-8")
    if group:
        yield from _title(f"{group}={path.stem}" if group not in FREE else f"+{group}={path.stem}", "~")
    if header(text):
        yield from (escaped(header(text)), "")
    for key in explained(group, path):
        if key.meaning or not key.is_section:
            value = _shown(key.value)
            yield f"``{_place(group, text)}{key.path}``" + (f" : {value}" if value else "")
            yield f"    {escaped(key.meaning or NAMED_ELSEWHERE)}"
            yield ""


def _place(group: str, text: str) -> str:
    """What stands before a file's keys on the command line."""
    where = package(text) or group.replace("/", ".")
    return f"{where}." if where and where != "_global_" else ""


def _shown(value: str) -> str:
    """The value, where it is short enough for a table."""
    return "(in the file)" if len(value) > LONGEST_VALUE else f"``{value}``" if value else ""


def _title(text: str, line: str) -> Iterator[str]:
    yield from (text, line * len(text), "")
