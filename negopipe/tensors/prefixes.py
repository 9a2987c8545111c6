"""Prefixes that join the states of several parts in one flat mapping: `part/name`."""

from collections.abc import Mapping

from torch import Tensor


def add_prefix(part: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a part with the part's name before every key."""
    return {f"{part}/{name}": tensor for name, tensor in state.items()}


def strip_prefix(part: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a part from the whole; the inverse of `add_prefix`."""
    prefix = f"{part}/"
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}
