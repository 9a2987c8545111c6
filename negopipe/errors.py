"""The error that the user can correct, and values as a line shows them."""

import json
import math
from typing import Any

LONGEST_VALUE = 100
"""Longest value in a line, in characters. A longer one is cut."""


class UserError(Exception):
    """A wrong config value, file or name. The message is one line: the key, the value and what is allowed.

    `python -m negopipe` prints it without a traceback and exits with code 1.
    """


def abbreviate(value: Any, longest: int = LONGEST_VALUE) -> str:
    """A value as a line shows it: control characters escaped, cut where it is long, infinity as `inf`."""
    plain = _without_infinity(value)
    text = plain if isinstance(plain, str) and plain else json.dumps(plain)
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def _without_infinity(value: Any) -> Any:
    """The value with texts, `inf`, `-inf` and `nan`, for the floats that JSON does not know."""
    if isinstance(value, list | tuple):
        return [_without_infinity(item) for item in value]
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value
