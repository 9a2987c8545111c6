"""Docstrings of the package as reStructuredText. Ours are plain text with three layouts:

name: text                definition of an argument, field or column; deeper lines continue it
indented lines, columns   table of symbols, formula or code, kept as it stands; indented prose is a quotation
other lines               paragraph
"""

import ast
import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence

DEFINITION = re.compile(r"((?:[a-z]\w*|[\w.]*<\w+>\w*)(?:, (?:\w|<|>)+)*): (.*)")
MARKUP = re.compile(r"([\\*_|])")
COLUMNS = re.compile(r"\S {2,}\S")
FORMAL = re.compile(r"\S {2,}\S| = |->|<-|^\s*import ", flags=re.MULTILINE)
LIST_MARK = re.compile(r"(?=(?:[-+•]|\w+[.)]|\(\w+\)) )")


def as_rst(docstring: Sequence[str], types: Mapping[str, str] | None = None) -> list[str]:
    """Lines of reStructuredText.

    types: text of the type by field, shown beside the definitions; fields without a definition follow at the end
    """
    types = types or {}
    lines: list[str] = []
    paragraphs = re.split(r"\n{2,}", "\n".join(docstring).strip("\n"))
    for number, paragraph in enumerate(paragraphs):
        for kind, part in _parts(paragraph.splitlines(), may_define=number > 0):
            lines += _rst(kind, part, types)
    defined = {name for line in lines if line.startswith("``") for name in re.findall(r"\w+", line.partition(" : ")[0])}
    rest = [f"``{name}`` (``{text}``)" for name, text in types.items() if name not in defined]
    head = "Other fields" if defined & set(types) else "Fields"
    return lines + ([f"{head}: {', '.join(rest)}.", ""] if rest else [])


def _parts(lines: Sequence[str], may_define: bool) -> Iterator[tuple[str, list[str]]]:
    """The paragraph in pieces of one layout: "definition", "indented" or "text"."""
    flush = [line for line in lines if not line.startswith(" ")]
    is_formal = any(map(COLUMNS.search, flush)) and all(map(FORMAL.search, flush))
    kind, part = "", list[str]()
    for line in lines:
        is_indented = line.startswith(" ")
        if may_define and DEFINITION.fullmatch(line):
            this = "definition"
        elif is_indented or is_formal or COLUMNS.search(line):
            this = kind if is_indented and kind == "definition" else "indented"
        else:
            this = "text"
        if part and (this != kind or (this == "definition" and not is_indented)):
            yield kind, part
            part = []
        kind = this
        part.append(line)
    if part:
        yield kind, part


def _rst(kind: str, lines: Sequence[str], types: Mapping[str, str]) -> list[str]:
    text = " ".join(line.strip() for line in lines)
    if kind == "indented" and not FORMAL.search("\n".join(lines)):
        return [f"    {escaped(text)}", ""]
    if kind == "indented":
        shown = inspect.cleandoc("\n" + "\n".join(lines)).splitlines()
        return [".. code-block:: text", "", *(f"    {line}" for line in shown), ""]
    if kind == "text":
        return [escaped(text), ""]
    names, meaning = DEFINITION.fullmatch(text).groups()  # type: ignore[union-attr]
    of_type = {types[name] for name in names.split(", ") if name in types}
    term = ", ".join(f"``{name}``" for name in names.split(", "))
    return [term + (f" : ``{of_type.pop()}``" if len(of_type) == 1 else ""), f"    {escaped(meaning)}", ""]


def escaped(text: str) -> str:
    """A paragraph whose `code` is code and whose other characters stand for themselves."""
    pieces = re.split(r"(`[^`]+`)", text)
    shown = [f"`{piece}`" if i % 2 else MARKUP.sub(r"\\\1", piece) for i, piece in enumerate(pieces)]
    return LIST_MARK.sub(r"\\", "".join(shown), count=1) if LIST_MARK.match("".join(shown)) else "".join(shown)


def field_types(cls: type) -> dict[str, str]:
    """Type by field of a dataclass, as the source writes it."""
    tree = ast.parse(inspect.cleandoc("\n" + inspect.getsource(cls)))
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    written = {node.target.id: ast.unparse(node.annotation) for node in body
               if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)}  # fmt: skip
    return {field.name: written[field.name] for field in dataclasses.fields(cls) if field.name in written}


def bases(cls: type) -> list[str]:
    """What a class of the package extends, where that is of the package, too."""
    ours = [base for base in cls.__bases__ if base.__module__.startswith("negopipe")]
    linked = ", ".join(f":py:class:`~{base.__module__}.{base.__qualname__}`" for base in ours)
    return [f"Extends {linked}.", ""] if ours else []
