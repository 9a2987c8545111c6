"""Occlusion: parked vehicles and vehicles on the road hide what is behind them.

A vehicle sees from the middle of its footprint, where a sensor on the roof is. It sees another vehicle if there is a
free line of sight to the middle of that one's footprint or to one of its corners. Whatever hides is taken to be as high
as it needs to be; kerbs hide nothing.
"""

import torch
from torch import Tensor

from negopipe.simulation.geometry import Boxes, boxes_from_pose
from negopipe.simulation.road import Road
from negopipe.simulation.state import Task

POINTS = ((0.0, 0.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
"""Points of a footprint that are looked for, ahead and to the left, in half lengths and half widths."""


class Occlusion:
    """Lines of sight on one road."""

    def __init__(self, road: Road) -> None:
        self.road = road

    def is_visible(self, pose: Tensor, others: Tensor, task: Task) -> Tensor:
        """[E, J, V, O] bool: vehicle v has a free line of sight to vehicle `others[v, o]`.

        pose: [E, J, V, 3], x, y, yaw of all vehicles; others: [V, O] int64, columns
        """
        x, y, yaw = pose.unbind(-1)
        vehicles = boxes_from_pose(x, y, yaw, task.length[:, None], task.width[:, None])
        start = x[..., None, None], y[..., None, None]  # [E, J, V, 1, 1]
        to_x, to_y = (field[:, :, :, others, None] for field in _points(vehicles))  # [N, E, J, V, O, 1]
        parked = Boxes(*(_per_world(field) for field in self.road.parked_boxes(task.direction[:, 0])))
        hides = crosses(parked, start, (to_x, to_y)).any(-1)
        moving = Boxes(*(field.expand_as(x)[:, :, None, None] for field in vehicles))  # type: ignore[union-attr]
        return ~(hides | (crosses(moving, start, (to_x, to_y)) & _is_third(others)).any(-1)).all(0)


def crosses(boxes: Boxes, start: tuple[Tensor, Tensor], end: tuple[Tensor, Tensor]) -> Tensor:
    """[...] bool: the line from `start` to `end`, x and y of each, goes through the rectangle.

    The separating-axis theorem: along the sides of the rectangle, and across the line.
    """
    half_x, half_y = (end[0] - start[0]) / 2, (end[1] - start[1]) / 2
    x, y = start[0] + half_x - boxes.x, start[1] + half_y - boxes.y
    along, across = x * boxes.cos + y * boxes.sin, y * boxes.cos - x * boxes.sin
    line_along, line_across = half_x * boxes.cos + half_y * boxes.sin, half_y * boxes.cos - half_x * boxes.sin
    off = (along * line_across - across * line_along).abs()
    return (
        (along.abs() < boxes.half_length + line_along.abs())
        & (across.abs() < boxes.half_width + line_across.abs())
        & (off < boxes.half_length * line_across.abs() + boxes.half_width * line_along.abs())
    )


def _points(boxes: Boxes) -> tuple[Tensor, Tensor]:
    """x and y [N, ...] of the points that are looked for, m."""
    offsets = [(ahead * boxes.half_length, left * boxes.half_width) for ahead, left in POINTS]
    x = torch.stack([boxes.x + u * boxes.cos - v * boxes.sin for u, v in offsets])
    y = torch.stack([boxes.y + u * boxes.sin + v * boxes.cos for u, v in offsets])
    return x, y


def _per_world(field: Tensor | float) -> Tensor:
    """[E or 1, 1, 1, 1, P] from a field [E, P] or, of one street, [P]."""
    field = torch.as_tensor(field)
    return field[..., None, None, None, :] if field.dim() == 2 else field


def _is_third(others: Tensor) -> Tensor:
    """[V, O, V] bool: the last vehicle is neither the one that looks nor the one that is looked for."""
    column = torch.arange(len(others), device=others.device)
    return (column != column[:, None, None]) & (column != others[..., None])
