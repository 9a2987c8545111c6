"""Names and parameters as MLflow takes them."""

import re
from collections.abc import Mapping
from typing import Any, TypeVar

T = TypeVar("T")


def clean_name(name: str) -> str:
    """A name that MLflow takes: no `= [ ] @ %`, no empty and no `..` path parts."""
    parts = re.sub(r"[^\w\-. :/]", "_", name).split("/")
    return "/".join(part for part in parts if part not in ("", ".", ".."))


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """`{"a": {"b": 1}}` as `{"a.b": 1}`; lists stay whole."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        is_branch = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{key}.") if is_branch else {f"{prefix}{key}": value}
    return flat


def cleaned(values: Mapping[str, T]) -> dict[str, T]:
    """The same values under names that MLflow takes."""
    return {clean_name(key): value for key, value in values.items()}
