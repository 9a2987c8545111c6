"""Conflicts found at stations around a predicted vehicle, against the footprints of every trajectory at every time.

The planner measures how deep two footprints overlap at places `conflict_station_m` apart and takes the depth to
change by at most a metre per metre. Footprints also turn and drive obliquely, so a corner may be cut a little
deeper between two places than that allows. What may be driven has neither steep nor sharp paths: there the corner
is cut by 5.2 cm at most in 160 batches, less than half of the clearance beside a vehicle that stands (0.2 m).
"""

from typing import NamedTuple

import pytest
import torch
from composed import compose_config
from situations import draw_situations, world_boxes
from torch import Tensor

from negopipe.game.game import build_game
from negopipe.planner.frenet import FrenetPlanner
from negopipe.planner.prediction import predict
from negopipe.planner.situation import Situation
from negopipe.simulation.geometry import overlap_depth

CUT_M = 0.08
N_SITUATIONS = 60  # of a batch


class Checked(NamedTuple):
    """Of all trajectories of some situations, [L, C, N].

    is_conflict: bool, what the planner says
    depth: m, of the footprint in the grown box of the other, the deepest of all predicted times
    is_forward: bool, the vehicle does not reverse
    is_drivable: bool, the rest of what the planner asks of a trajectory
    """

    is_conflict: Tensor
    depth: Tensor
    is_forward: Tensor
    is_drivable: Tensor


def check(planner: FrenetPlanner, x: Situation) -> Checked:
    samples = planner.longitudinal.sample(x.route, x.desired_speed)
    paths = planner._paths(x)
    predicted = predict(planner.config.prediction, planner.road, x.others, x.direction, planner.times)
    counts = (planner.times[:, None] <= x.horizon + planner.dt_s / 2)[None]
    blocked = planner.conflicts.blocked(x, paths.coefficients, predicted, counts)[0]
    is_drivable = planner._is_drivable(samples, paths)
    is_forward = (samples.speed.amin(1) >= -0.05).expand_as(is_drivable)
    return Checked(
        blocked.holds_up(samples.travelled),
        directly(planner, x, samples.travelled, paths.coefficients).masked_fill(~counts[0], -99).amax(2),
        is_forward,
        is_drivable & (samples.travelled[:, -1] <= paths.free_distance[:, None]),
    )


def directly(planner: FrenetPlanner, x: Situation, travelled: Tensor, coefficients: tuple[Tensor, ...]) -> Tensor:
    """[L, C, T, N] m: depth of every footprint in the grown box of the other, both in the world."""
    road, size, clearance = planner.road, planner.sizes.ego, planner.config.clearance
    predicted = predict(planner.config.prediction, road, x.others, x.direction, planner.times)
    d, d_prime, _ = planner.lateral.follow(coefficients, x.route.s, x.direction, travelled)
    s = x.route.s + travelled
    tan = d_prime / (1 - road.curvature(s, x.direction)[0] * d)
    own = world_boxes(road, s, x.direction, d, tan, size.length, size.width)
    length = size.length + 2 * clearance.ahead_m
    seen = (field[0] for field in predicted)
    s, d, tan = seen
    grown = world_boxes(road, s, x.direction, d, tan, length, size.width)
    beside = clearance.beside_m + clearance.beside_s * x.others.speed[0].double()
    return overlap_depth(own, grown._replace(half_width=size.width / 2 + beside))


@pytest.fixture(scope="module", params=[("narrow_lane", 25), ("bent_street", 10)], ids=str)
def checked(request: pytest.FixtureRequest) -> Checked:
    scenario, n_batches = request.param
    planner = build_game(compose_config([f"scenario={scenario}"])).planner
    batches = (check(planner, draw_situations(planner.road, N_SITUATIONS, seed)) for seed in range(n_batches))
    return Checked(*(torch.cat(field, dim=-1) for field in zip(*batches, strict=True)))


def test_what_may_be_driven_meets_nobody(checked: Checked) -> None:
    free = checked.is_drivable & ~checked.is_conflict
    assert free.sum() > 5000
    assert float(checked.depth[free].max()) < CUT_M


def test_of_steep_paths_few_conflicts_are_missed(checked: Checked) -> None:
    is_met = checked.is_forward & (checked.depth > CUT_M)
    assert is_met.sum() > 10000
    assert float((is_met & ~checked.is_conflict).sum() / is_met.sum()) < 1e-3


def test_hardly_ever_needlessly_careful(checked: Checked) -> None:
    # where a blocked interval begins and ends is known to the spacing of the places, of 1.2 m at most
    is_careful = checked.is_forward & checked.is_conflict & (checked.depth <= 0)
    assert float(is_careful.sum() / checked.is_forward.sum()) < 0.006
    assert float(checked.depth[is_careful].min()) > -1.2 * 1.1
