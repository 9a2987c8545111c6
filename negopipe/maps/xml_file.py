"""XML file opened and its numbers read; what is wrong becomes one line that names the file."""

from pathlib import Path
from xml.etree import ElementTree

from negopipe.errors import UserError, abbreviate


def read_root(path: Path, root: str, what: str) -> ElementTree.Element:
    """Root element, tagged `root`, of the file, which should be `what`."""
    try:
        element = ElementTree.parse(path).getroot()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error}); {what} is needed") from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: unknown encoding
        raise UserError(f"{path}: is not XML ({abbreviate(str(error))}); {what} is needed") from None
    if element.tag != root:
        raise UserError(f"{path}: its root is <{abbreviate(element.tag)}>; {what} has <{root}>")
    return element


def number(path: Path, text: str | None, what: str) -> float:
    """Finite number in a text."""
    try:
        value = float(text or "")
        if abs(value) < float("inf"):
            return value
    except ValueError:
        pass
    raise UserError(f"{path}: {what} is {_shown(text)}; a finite number is allowed")


def whole_number(path: Path, text: str | None, what: str) -> int:
    """Integer in a text."""
    try:
        return int(text or "")
    except ValueError:
        raise UserError(f"{path}: {what} is {_shown(text)}; a whole number is allowed") from None


def _shown(text: str | None) -> str:
    return repr(abbreviate(text)) if text else "missing"


def first_line_beside(path: Path, name: str) -> str:
    """First line of the file `name` in the folder of a map, or an empty text where there is none."""
    try:
        lines = (path.parent / name).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return ""
    return lines[0].strip() if lines else ""
