"""State that is made of parts, as one flat table of tensors: `part/name`."""

from collections.abc import Mapping

from torch import Tensor


def add_prefix(part: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a part as it stands in the whole."""
    return {f"{part}/{name}": tensor for name, tensor in state.items()}


def strip_prefix(part: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What `add_prefix` was given."""
    prefix = f"{part}/"
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}
