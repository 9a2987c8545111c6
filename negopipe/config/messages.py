"""Error messages for a wrong config: one line with the key, the value and what is allowed.

Hydra refuses a command line while it composes, pydantic refuses the composed values; both end up here. This
imports neither torch nor a component, so that a mistyped key is answered at once.
"""

import difflib
import json
import re
import shlex
import sys
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from pydantic import ValidationError

from negopipe.config.renamed import renaming, renaming_in
from negopipe.errors import abbreviate

LONGEST_LINE = 400
"""Longest line, in characters. A longer one is cut."""

LONGEST_HINT = 200
"""Longest hint, in characters. A longer one is left out."""

_AMBIGUOUS = re.compile(r"Ambiguous value for argument '(.*?)'\n1\. ", flags=re.DOTALL)


def as_text(override: str) -> str | None:
    """The override with its value in double quotes, quoted for a shell: `'outputs="a=b"'`.

    None where the value is more than a text, such as a list, or where quotes do not help.
    """
    key, _, text = override.partition("=")
    quoted = f"{key}={QuotedString(text, Quote.double).with_quotes()}"
    if text[:1] in ("", "[", "{", "'", '"') or len(quoted) > LONGEST_HINT or not quoted.isprintable():
        return None
    try:
        is_read = OverridesParser.create().parse_override(quoted).value() == text
    except HydraException:
        return None
    return shlex.quote(quoted) if is_read else None


def misread(values: Any, key: str = "") -> str | None:
    """Message for a value that JSON would change or refuse without its key; None where there is none.

    Such values are names that are no texts and texts that are not Unicode.
    """
    if isinstance(values, Mapping):
        odd = [name for name in values if not isinstance(name, str)]
        if odd:
            return f"{key} must have texts as names, got {json.dumps(odd[0])}: in double quotes it is a text"
        found = (misread(value, f"{key}.{name}".lstrip(".")) for name, value in values.items())
    elif isinstance(values, list):
        found = (misread(value, f"{key}.{index}") for index, value in enumerate(values))
    else:
        return f"{key} {_UNREADABLE}, got {abbreviate(values)}" if _is_not_unicode(values) else None
    return next(filter(None, found), None)


_ENCODING = sys.getfilesystemencoding()
_READ_AS = (
    "" if _ENCODING == "utf-8" else f", which is read as {_ENCODING} here (PYTHONUTF8=1 in front of it mends that)"
)
_UNREADABLE = f"must be UTF-8{_READ_AS}"


def _is_not_unicode(value: Any) -> bool:
    """Whether the value is a text with bytes that Python could not decode."""
    return isinstance(value, str) and any("\ud800" <= c <= "\udfff" for c in value)


def unknown_key(key: str, allowed: Iterable[str]) -> str:
    """Message for an unknown key. `key` is a dotted path; `allowed` are names that its last part may have."""
    names = sorted(allowed)
    near = difflib.get_close_matches(key.rpartition(".")[2], names, n=1)
    hint = f" did you mean {near[0]}?" if near else ""
    return f"{key} is not a known key,{hint} allowed: {', '.join(names) or 'none'}"


def explain_composition(error: Exception) -> str:
    """Message for an error of Hydra or OmegaConf while they composed the config or resolved its interpolations."""
    return abbreviate(_explanation(error), LONGEST_LINE)


def _explanation(error: Exception) -> str:
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if line := _renaming(error, cause):
        return line
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, option = str(error.missing_cfg_file).rpartition("/")
        return f"{group} must be one of {', '.join(sorted(error.options))}, got {option}"
    if isinstance(error, InterpolationResolutionError):
        return f"{error.full_key} cannot be resolved: {str(error).splitlines()[0]}"
    if isinstance(cause, ConfigAttributeError | ConfigKeyError) and OmegaConf.is_dict(cause.parent_node):
        return unknown_key(str(cause.full_key), map(str, cause.parent_node))
    if isinstance(error, OverrideParseException):
        return _unreadable(error)
    if ambiguous := _AMBIGUOUS.match(str(error)):
        return _ambiguous(ambiguous[1])
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is missing"
    return " ".join(str(error).replace("\\'", "'").split())


def _renaming(error: Exception, cause: BaseException | None) -> str | None:
    """Message for an old name that Hydra or OmegaConf did not find."""
    if isinstance(error, MissingConfigException):
        group, _, option = str(error.missing_cfg_file).rpartition("/")
        return renaming(f"{group}={option}")
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return renaming(str(cause.full_key))
    return renaming_in(str(error))


def _unreadable(error: OverrideParseException) -> str:
    override = str(error.override)
    if _is_not_unicode(override):
        key, _, value = override.partition("=")
        return f"{abbreviate(key)} {_UNREADABLE}, got {abbreviate(value)}"
    quoted = as_text(override)
    return f"{abbreviate(override)} cannot be read: {str(error).splitlines()[0]}{f', try {quoted}' if quoted else ''}"


def _ambiguous(override: str) -> str:
    """Message for several values without a sweep."""
    key, _, values = override.partition("=")
    ways = {"-m": "to sweep over them", shlex.quote(f"{key}=[{values}]"): "for a list", as_text(override): "for a text"}
    hints = ", ".join(f"{way} {purpose}" for way, purpose in ways.items() if way)
    return f"Ambiguous value for argument '{abbreviate(override)}', use {hints}"


def explain_validation(error: ValidationError, root: type, typed: Sequence[str] = ()) -> str:
    """Message for all problems that pydantic found in the plain mappings of a `root`.

    typed: the overrides as they were given; they show how a text was written that was read as another type
    """
    problems = (_problem(problem, root, typed) for problem in error.errors())
    return abbreviate("; ".join(dict.fromkeys(problems)), LONGEST_LINE)


def _problem(problem: Mapping[str, Any], root: type, typed: Sequence[str]) -> str:
    path, kind = [str(part) for part in problem["loc"] if part != "[key]"], problem["type"]
    key = ".".join(_keys(root, path))
    if kind == "unexpected_keyword_argument":
        return unknown_key(key, [field.name for schema in _schemas(_node(root, path[:-1])) for field in fields(schema)])
    if kind.startswith("union_tag"):
        return _wrong_variant(key, problem["ctx"])
    if kind in ("missing", "missing_argument"):
        return f"{key} is missing"
    is_whole_mapping = isinstance(problem["input"], Mapping) and not kind.endswith("_type")
    value = "" if is_whole_mapping else f", got {abbreviate(problem['input'])}"  # the rule names the values
    hint = _how_to_quote(key, typed) if kind == "string_type" else ""
    return f"{key} {_rule(problem)}{value}{hint}"


def _how_to_quote(key: str, typed: Sequence[str]) -> str:
    """Hint for a text that was read as another type."""
    written = [override for override in typed if override.partition("=")[0].lstrip("+") == key]
    quoted = as_text(written[-1]) if written else None
    return f", try {quoted}" if quoted else ", which is a text in double quotes"


def _wrong_variant(key: str, context: Mapping[str, str]) -> str:
    """Message for a group of several kinds whose field `kind` is wrong or missing."""
    names = {name: value.replace("'", "") for name, value in context.items()}
    field = f"{key}.{names['discriminator']}"
    if "tag" not in names:
        return f"{field} is missing"
    return f"{field} must be one of {names['expected_tags']}, got {abbreviate(names['tag'])}"


def _rule(problem: Mapping[str, Any]) -> str:
    """Rule that the value breaks, in pydantic's words."""
    if problem["type"] == "literal_error":
        choices = problem["ctx"]["expected"].replace(" or ", ", ").replace("'", "")
        return f"must be one of {choices}"
    if problem["type"].startswith("dataclass"):
        return "must be a mapping"
    message = str(problem["msg"]).removeprefix("Value error, ").replace("valid array", "list")
    message = message.partition(" after validation")[0]
    rule = message.partition(" should ")[2]
    return f"must {rule}" if rule else message


def _keys(root: type, path: list[str]) -> list[str]:
    """Keys on pydantic's path to a value. Within a group of several kinds the path names the kind, which is no key."""
    return [part for depth, part in enumerate(path) if len(_schemas(_node(root, path[:depth]))) < 2]


def _node(root: type, path: list[str]) -> Any:
    """Type hint at the end of pydantic's `path` from `root`; None where there is none."""
    node: Any = root
    for part in path:
        schemas = _schemas(node)
        if len(schemas) > 1:
            node = next((schema for schema in schemas if _is_kind(schema, part)), None)
        else:
            node = get_type_hints(schemas[0]).get(part) if schemas else _item_type(node)
    return node


def _schemas(hint: Any) -> list[Any]:
    """Dataclasses that a type hint is or allows; several for a group of several kinds."""
    if is_dataclass(hint):
        return [hint]
    if get_origin(hint) in (Annotated, Union, types.UnionType):
        return [schema for arg in get_args(hint) for schema in _schemas(arg)]
    return []


def _is_kind(schema: Any, tag: str) -> bool:
    return any(get_origin(hint) is Literal and tag in get_args(hint) for hint in get_type_hints(schema).values())


def _item_type(hint: Any) -> Any:
    """Type hint of the items of a list, tuple or dict."""
    return next((arg for arg in reversed(get_args(hint)) if arg is not Ellipsis), None)
