"""Formulas of plane geometry on batched tensors: angles, oriented boxes."""

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Size(NamedTuple):
    """Lengths and widths of footprints, [...] float32, m; a float is that of all."""

    length: Tensor | float
    width: Tensor | float


def half_diagonal(size: Size) -> Tensor | float:
    """Distance of the corners of footprints from their centres, [...] m."""
    if isinstance(size.length, Tensor) and isinstance(size.width, Tensor):
        return torch.hypot(size.length, size.width) / 2
    return math.hypot(size.length, size.width) / 2


class Boxes(NamedTuple):
    """Oriented rectangles; every field broadcasts against the others.

    x, y: [...] float32, m, centre
    cos, sin: [...] float32, of the heading
    half_length, half_width: [...] float32 or float, m
    """

    x: Tensor
    y: Tensor
    cos: Tensor
    sin: Tensor
    half_length: Tensor | float
    half_width: Tensor | float


def boxes_from_pose(x: Tensor, y: Tensor, yaw: Tensor, length: Tensor | float, width: Tensor | float) -> Boxes:
    """Boxes at poses [...] (m, m, rad), of sizes that broadcast with these."""
    return Boxes(x, y, torch.cos(yaw), torch.sin(yaw), length / 2, width / 2)


def box_rows(rows: Tensor) -> Tensor:
    """[..., 6], the fields of `Boxes`, from rows [..., 5]: x, y, yaw, length, width (m, m, rad, m, m)."""
    x, y, yaw, length, width = rows.unbind(-1)
    return torch.stack([x, y, torch.cos(yaw), torch.sin(yaw), length / 2, width / 2], dim=-1)


def overlap_depth(a: Boxes, b: Boxes) -> Tensor:
    """Depth of the overlap of oriented rectangles, [...] m: positive where they overlap.

    The separating-axis theorem: along each side of the two rectangles the sum of both half extents is compared
    with the distance of the centres. The smallest surplus is the depth. It is a number and no boolean, because maxima
    over numbers run on vector units and reductions over booleans do not.
    """
    dx, dy = b.x - a.x, b.y - a.y
    cos = (a.cos * b.cos + a.sin * b.sin).abs()  # of the relative heading
    sin = (a.cos * b.sin - a.sin * b.cos).abs()
    along_a = a.half_length + b.half_length * cos + b.half_width * sin - (dx * a.cos + dy * a.sin).abs()
    across_a = a.half_width + b.half_length * sin + b.half_width * cos - (dy * a.cos - dx * a.sin).abs()
    along_b = b.half_length + a.half_length * cos + a.half_width * sin - (dx * b.cos + dy * b.sin).abs()
    across_b = b.half_width + a.half_length * sin + a.half_width * cos - (dy * b.cos - dx * b.sin).abs()
    return torch.minimum(torch.minimum(along_a, across_a), torch.minimum(along_b, across_b))


def time_to_collision(a: Boxes, b: Boxes, velocity_x: Tensor, velocity_y: Tensor) -> Tensor:
    """[...] s until the rectangles overlap, where b moves at a velocity (m/s) relative to a, without a turn.

    It is 0 where they overlap already and inf where they never will.

    Along each of the four sides' directions the extents overlap for an interval of time (the separating-axis
    theorem); the rectangles overlap where all four intervals do.
    """
    first, last = torch.zeros_like(a.x * b.x), torch.full_like(a.x * b.x, torch.inf)
    for axis in (a, b):
        for cos, sin in ((axis.cos, axis.sin), (-axis.sin, axis.cos)):
            apart = (b.x - a.x) * cos + (b.y - a.y) * sin
            closing = velocity_x * cos + velocity_y * sin
            reach = _extent(a, cos, sin) + _extent(b, cos, sin)
            moves = closing.abs() > 1e-9
            per_closing = 1 / torch.where(moves, closing, 1.0)
            one, two = (-reach - apart) * per_closing, (reach - apart) * per_closing
            never = torch.where(apart.abs() < reach, -torch.inf, torch.inf)
            first = torch.maximum(first, torch.where(moves, torch.minimum(one, two), never))
            last = torch.minimum(last, torch.where(moves, torch.maximum(one, two), torch.inf))
    return torch.where(first < last, first, torch.inf)


def _extent(box: Boxes, cos: Tensor, sin: Tensor) -> Tensor:
    """Half extent of the rectangle along a direction, m."""
    along = (box.cos * cos + box.sin * sin).abs()
    across = (box.cos * sin - box.sin * cos).abs()
    return box.half_length * along + box.half_width * across


def rim(boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Positions x, y [6, ...] (m) of the corners and of the middles of the long sides."""
    points = [(ahead, left) for left in (1.0, -1.0) for ahead in (1.0, 0.0, -1.0)]
    offsets = [(ahead * boxes.half_length, left * boxes.half_width) for ahead, left in points]
    x = torch.stack([boxes.x + u * boxes.cos - v * boxes.sin for u, v in offsets])
    y = torch.stack([boxes.y + u * boxes.sin + v * boxes.cos for u, v in offsets])
    return x, y


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in [-pi, pi), rad."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
