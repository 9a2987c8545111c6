"""Oriented boxes by hand and against a plain-loop polygon test."""

import math

import pytest
import torch

from negopipe.simulation.drivable import is_in_a_car
from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth, wrap_angle
from negopipe.simulation.smoothstep import smoothstep


def box(x: float, y: float, yaw: float, length: float = 4.0, width: float = 2.0) -> Boxes:
    return boxes_from_pose(torch.tensor(x), torch.tensor(y), torch.tensor(yaw), length, width)


@pytest.mark.parametrize(
    ("second", "depth"),
    [
        (box(3.0, 0.0, 0.0), 1.0),  # one metre into each other, end to end
        (box(4.5, 0.0, 0.0), -0.5),  # half a metre apart
        (box(0.0, 1.75, 0.0), 0.25),  # side by side, a quarter too close
        (box(2.9, 0.0, math.pi / 2), 0.1),  # crosswise: 2 + 1 = 3 m between the centres would touch
        (box(3.1, 0.0, math.pi / 2), -0.1),
        (box(0.0, 0.0, math.pi), 2.0),  # the same place, turned round: the narrow side counts
    ],
)
def test_depth_by_hand(second: Boxes, depth: float) -> None:
    assert float(overlap_depth(box(0.0, 0.0, 0.0), second)) == pytest.approx(depth, abs=1e-6)


def test_corner_against_side_needs_the_rotated_axis() -> None:
    # the bounding boxes overlap, the rectangles do not: only the tilted one's own axes tell
    tilted = box(2.9, 1.9, math.pi / 4, 2.0, 1.0)
    assert float(overlap_depth(box(0.0, 0.0, 0.0), tilted)) < 0


def corners(boxes: Boxes, i: int) -> list[tuple[float, float]]:
    x, y, c, s = (float(f[i]) for f in boxes[:4])
    half_length, half_width = float(boxes.half_length), float(boxes.half_width)
    around = [(half_length, half_width), (-half_length, half_width), (-half_length, -half_width),
              (half_length, -half_width)]  # fmt: skip
    return [(x + u * c - v * s, y + u * s + v * c) for u, v in around]


def plain_loop_overlap(a: list[tuple[float, float]], b: list[tuple[float, float]]) -> bool:
    for polygon in (a, b):
        for (x0, y0), (x1, y1) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            nx, ny = y0 - y1, x1 - x0
            shadow_a, shadow_b = ([nx * x + ny * y for x, y in p] for p in (a, b))
            if max(shadow_a) <= min(shadow_b) or max(shadow_b) <= min(shadow_a):
                return False
    return True


def test_agrees_with_plain_loop_on_random_boxes() -> None:
    generator = torch.Generator().manual_seed(0)
    pose = torch.rand(2, 500, 3, generator=generator) * torch.tensor([8.0, 8.0, 2 * math.pi])
    a, b = (boxes_from_pose(*p.unbind(-1), 4.5, 1.8) for p in pose)
    vectorised = (overlap_depth(a, b) > 0).tolist()
    plain = [plain_loop_overlap(corners(a, i), corners(b, i)) for i in range(500)]
    assert vectorised == plain
    assert 50 < sum(plain) < 450


def test_wrap_angle() -> None:
    angle = torch.tensor([0.0, 3.0, -3.0, 4.0, 2 * math.pi, -7.0])
    wrapped = wrap_angle(angle)
    assert ((wrapped >= -math.pi) & (wrapped < math.pi)).all()
    torch.testing.assert_close(torch.sin(wrapped), torch.sin(angle), atol=1e-6, rtol=0)


def test_smoothstep_derivatives() -> None:
    x = torch.linspace(-0.2, 1.2, 50, dtype=torch.float64, requires_grad=True)
    value, first, second = smoothstep(x)
    (by_autograd,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    (second_by_autograd,) = torch.autograd.grad(by_autograd.sum(), x)
    torch.testing.assert_close(first, by_autograd)
    torch.testing.assert_close(second, second_by_autograd)


@pytest.mark.parametrize("deeper_than_m", [0.0, 0.3])
def test_cars_within_reach_are_all_that_count(deeper_than_m: float) -> None:
    random = torch.Generator().manual_seed(4)

    def boxes(*shape: int, length: float | torch.Tensor, width: float | torch.Tensor) -> Boxes:
        x, y, yaw = (scale * torch.rand(shape, generator=random) for scale in (30.0, 30.0, 6.0))
        return boxes_from_pose(x, y, yaw, length, width)

    vehicles = boxes(40, 25, length=4.5, width=1.8)
    lengths = 2 + 4 * torch.rand(40, 25, 6, generator=random)
    cars = boxes(40, 25, 6, length=lengths, width=lengths / 2)
    each = Boxes(*(field[..., None] if isinstance(field, torch.Tensor) else field for field in vehicles))
    expected = (overlap_depth(each, cars) > deeper_than_m).any(-1)
    assert 0.02 < expected.float().mean() < 0.6
    assert torch.equal(is_in_a_car(vehicles, cars, deeper_than_m), expected)
