"""Names and parameters in the form that MLflow accepts."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

T = TypeVar("T")


def clean_name(name: str) -> str:
    """The name as MLflow accepts it: without `= [ ] @ %`, without empty and `..` path parts."""
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
    """The same values under names that MLflow accepts."""
    return {clean_name(key): value for key, value in values.items()}


def without_implied(keys: Sequence[str], configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys without those that another key implies.

    `algorithm.kind` implies all keys of `algorithm` in which configs of one kind do not differ.

    keys: keys in which the configs differ
    configs: flat mappings
    """
    kinds = [key for key in keys if key.rpartition(".")[2] == "kind"]
    return [key for key in keys if not any(_follows(key, kind, configs) for kind in kinds)]


def _follows(key: str, kind: str, configs: Sequence[Mapping[str, Any]]) -> bool:
    if key == kind or not key.startswith(kind.removesuffix("kind")):
        return False
    pairs = {(repr(config.get(kind)), repr(config.get(key))) for config in configs}
    return len(pairs) == len({of_kind for of_kind, _ in pairs})
