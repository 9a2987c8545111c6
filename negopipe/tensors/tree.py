"""Trees of tensors: tensors, tuples, named tuples and (nested) dataclasses of tensors."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


def map_tensors(fn: Callable[..., Tensor], *trees: T) -> T:
    """Tree of `fn` applied to the corresponding tensors of equal trees."""
    first = trees[0]
    if isinstance(first, Tensor):
        return fn(*trees)  # type: ignore[return-value]
    if isinstance(first, tuple):
        branches = [map_tensors(fn, *branch) for branch in zip(*trees, strict=True)]
        return type(first)(*branches) if hasattr(first, "_fields") else tuple(branches)  # type: ignore[return-value]
    values = {
        field.name: map_tensors(fn, *(getattr(tree, field.name) for tree in trees))
        for field in fields(first)  # type: ignore[arg-type]
    }
    return type(first)(**values)


def named_tensors(tree: Any, prefix: str = "") -> dict[str, Tensor]:
    """All tensors of a tensor dataclass by their path, such as `vehicles/speed`."""
    if isinstance(tree, Tensor):
        return {prefix: tree}
    named: dict[str, Tensor] = {}
    for field in fields(tree):
        named |= named_tensors(getattr(tree, field.name), f"{prefix}/{field.name}" if prefix else field.name)
    return named


def with_tensors(example: T, named: Mapping[str, Tensor]) -> T:
    """Tree with the structure and the device of `example`, of tensors by their path; the inverse of `named_tensors`."""
    values = iter([named[name].to(tensor.device) for name, tensor in named_tensors(example).items()])
    return map_tensors(lambda _: next(values), example)


def tensors(tree: Any) -> list[Tensor]:
    """All tensors of a tree, in the order of `map_tensors`."""
    if isinstance(tree, Tensor):
        return [tree]
    branches = tree if isinstance(tree, tuple) else [getattr(tree, field.name) for field in fields(tree)]
    return [leaf for branch in branches for leaf in tensors(branch)]


def tree_where(mask: Tensor, chosen: T, other: T) -> T:
    """`chosen` where `mask` is true, else `other`; the mask has the first axes of all their tensors, [E] or [E, V]."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask.reshape(*mask.shape, *[1] * (a.dim() - mask.dim())), a, b)

    return map_tensors(pick, chosen, other)
