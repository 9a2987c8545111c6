"""What the planner says of kerbs and parked cars, against the true footprints in the world.

On a straight road the check is exact but for the nooks between parked cars, which count as parked: who turns a
corner into one, by less than 0.1 m, is refused. On a bent road the line is an arc around each car, to second order
in the angle between car and footprint: a corner lies up to 3 cm off after 4 m at a radius of 40 m, and a kerb is
taken to bulge over the footprint's whole length.
"""

from typing import NamedTuple

import pytest
import torch
from composed import compose_config
from situations import CAR, world_boxes
from torch import Tensor

from negopipe.game.game import build_game
from negopipe.planner.roadside import Roadside
from negopipe.simulation.geometry import overlap_depth
from negopipe.simulation.one_street import OneStreet

OFF_M = 0.05
"""By how much a footprint must be deeper than 0 for the planner to know, on a bent road."""


class Places(NamedTuple):
    """Footprints, fields [N]."""

    s: Tensor
    direction: Tensor
    d: Tensor
    d_prime: Tensor


def draw_places(n: int, corridor_m: float) -> Places:
    generator = torch.Generator().manual_seed(1)
    low, high = torch.tensor([[-12.0, -1.0, -2.6, -0.6], [corridor_m + 12, 1.0, 2.6, 0.6]])
    s, sign, d, d_prime = (low + (high - low) * torch.rand(n, 4, generator=generator)).T
    return Places(s, sign.sign(), d, d_prime)


def touches(roadside: Roadside, at: Places, grown_m: float) -> Tensor:
    """[N] bool: a footprint with its clearance and `grown_m` on every side meets a parked car or a kerb."""
    road = roadside.road
    tan = at.d_prime / (1 - road.curvature(at.s, at.direction)[0] * at.d)
    length, width = (2 * (float(half) + grown_m) for half in (side / 2 + roadside.clearance_m for side in CAR))
    boxes = world_boxes(road, at.s, at.direction, at.d, tan, length, width)
    columns = boxes._replace(**{name: getattr(boxes, name)[:, None] for name in ("x", "y", "cos", "sin")})
    return road.is_off_road(boxes) | (overlap_depth(columns, road.parked_boxes()) > 0).any(-1)


@pytest.mark.parametrize(
    ("scenario", "n", "optimistic_m", "careful_m"),
    [
        ("narrow_lane", 40000, 0.0, 0.1),
        ("wide_gap", 40000, 0.0, 0.1),
        ("one_sided", 40000, 0.0, 0.1),
        ("bent_street", 6000, OFF_M, 0.15),
        ("s_curve", 6000, OFF_M, 0.15),
    ],
)
def test_excess_tells_who_touches_the_roadside(scenario: str, n: int, optimistic_m: float, careful_m: float) -> None:
    config = compose_config([f"scenario={scenario}"])
    roadside = Roadside(OneStreet(config.scenario.road.street), config.scenario.sizes, torch.tensor([0.2]))
    at = draw_places(n, config.scenario.road.corridor_length_m)
    excess = roadside.excess(at.s[None], at.direction, at.d[None, None], at.d_prime[None, None], CAR)[0, 0]
    is_refused = excess > 0
    assert 0.3 < float(is_refused.float().mean()) < 0.9
    assert is_refused[touches(roadside, at, -optimistic_m - 1e-4)].all()
    assert touches(roadside, at, careful_m)[is_refused].all()
    # ... and nearly always it is exact
    assert float((touches(roadside, at, 0.0) != is_refused).float().mean()) < (0.002 if optimistic_m == 0 else 0.02)


def test_cars_without_room_between_them_are_one_row() -> None:
    # three cars of 3.6 m in 12 m stand 0.6 m apart; three of 2 m stand 3 m apart, wide enough for 1.8 m
    near, apart = (
        build_game(compose_config(["scenario=one_sided", f"scenario.road.parked_car_length_m={length}"])).planner
        for length in (3.6, 2.0)
    )
    along = torch.ones(1)
    (row,) = near.roadside.rows(along)
    assert (float(row.sigma), float(row.half_length), float(row.side)) == (0.0, pytest.approx(6.0), 1)
    assert len(apart.roadside.rows(along)) == 3
