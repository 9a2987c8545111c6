"""One line for every way a config can be wrong: the key, the value and what is allowed.

Hydra refuses a command line while it composes, pydantic refuses the composed values; both end up here. This
imports neither torch nor a component, so that a typing error is answered at once.
"""

import difflib
import json
import types
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from pydantic import ValidationError

LONGEST_LINE = 400
LONGEST_VALUE = 100
"""Characters. What is longer is cut: a line that fills the terminal tells less."""


def shown(value: Any, longest: int = LONGEST_VALUE) -> str:
    """A value as a line shows it: control characters escaped, cut where it is long."""
    text = value if isinstance(value, str) and value else json.dumps(value)
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def unknown_key(key: str, allowed: Iterable[str]) -> str:
    """`key` is a dotted path; `allowed` are the names that its last part could have."""
    names = sorted(allowed)
    near = difflib.get_close_matches(key.rpartition(".")[2], names, n=1)
    hint = f" did you mean {near[0]}?" if near else ""
    return f"{key} is not a known key,{hint} allowed: {', '.join(names) or 'none'}"


def explain_composition(error: Exception) -> str:
    """What Hydra or OmegaConf found wrong while composing the config or resolving its interpolations."""
    return shown(_explanation(error), LONGEST_LINE)


def _explanation(error: Exception) -> str:
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, option = str(error.missing_cfg_file).rpartition("/")
        return f"{group} must be one of {', '.join(sorted(error.options))}, got {option}"
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if isinstance(error, InterpolationResolutionError):
        return f"{error.full_key} cannot be resolved: {str(error).splitlines()[0]}"
    if isinstance(cause, ConfigAttributeError | ConfigKeyError) and OmegaConf.is_dict(cause.parent_node):
        return unknown_key(str(cause.full_key), map(str, cause.parent_node))
    if isinstance(error, OverrideParseException):
        return f"{shown(error.override)} cannot be read: {str(error).splitlines()[0]}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is missing"
    return " ".join(str(error).replace("\\'", "'").split())


def explain_validation(error: ValidationError, root: type) -> str:
    """All problems that pydantic found when it was to make `root` of plain mappings."""
    return shown("; ".join(dict.fromkeys(_problem(problem, root) for problem in error.errors())), LONGEST_LINE)


def _problem(problem: Mapping[str, Any], root: type) -> str:
    path, kind = [str(part) for part in problem["loc"] if part != "[key]"], problem["type"]
    key = ".".join(_keys(root, path))
    if kind == "unexpected_keyword_argument":
        return unknown_key(key, [field.name for schema in _schemas(_node(root, path[:-1])) for field in fields(schema)])
    if kind.startswith("union_tag"):
        return _wrong_variant(key, problem["ctx"])
    if kind in ("missing", "missing_argument"):
        return f"{key} is missing"
    is_whole_mapping = isinstance(problem["input"], Mapping) and not kind.endswith("_type")
    value = "" if is_whole_mapping else f", got {shown(problem['input'])}"  # the rule names the values
    return f"{key} {_rule(problem)}{value}"


def _wrong_variant(key: str, context: Mapping[str, str]) -> str:
    """For a group of several kinds, one of whose fields says which kind it is."""
    names = {name: value.replace("'", "") for name, value in context.items()}
    field = f"{key}.{names['discriminator']}"
    if "tag" not in names:
        return f"{field} is missing"
    return f"{field} must be one of {names['expected_tags']}, got {shown(names['tag'])}"


def _rule(problem: Mapping[str, Any]) -> str:
    """What the value must be, in pydantic's words without its grammar."""
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
    """The keys in pydantic's way to a value: within a group of several kinds it names the kind, which is no key."""
    return [part for depth, part in enumerate(path) if len(_schemas(_node(root, path[:depth]))) < 2]


def _node(root: type, path: list[str]) -> Any:
    """Type hint of what pydantic's `path` leads to from `root`; None where it leads nowhere."""
    node: Any = root
    for part in path:
        schemas = _schemas(node)
        if len(schemas) > 1:
            node = next((schema for schema in schemas if _is_kind(schema, part)), None)
        else:
            node = get_type_hints(schemas[0]).get(part) if schemas else _item_type(node)
    return node


def _schemas(hint: Any) -> list[Any]:
    """The dataclasses that a type hint is or allows: several where a group has several kinds."""
    if is_dataclass(hint):
        return [hint]
    if get_origin(hint) in (Annotated, Union, types.UnionType):
        return [schema for arg in get_args(hint) for schema in _schemas(arg)]
    return []


def _is_kind(schema: Any, tag: str) -> bool:
    return any(get_origin(hint) is Literal and tag in get_args(hint) for hint in get_type_hints(schema).values())


def _item_type(hint: Any) -> Any:
    """What a list, tuple or dict holds."""
    return next((arg for arg in reversed(get_args(hint)) if arg is not Ellipsis), None)
