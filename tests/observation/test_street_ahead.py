"""The street ahead against loops over its parked cars, on one street and on drawn ones."""

import pytest
import torch
from composed import compose_config
from torch import Tensor

from negopipe.game.game import build_game
from negopipe.observation.street_ahead import BESIDE_M, StreetAhead
from negopipe.simulation.road import Road
from negopipe.simulation.waiting_place import Passage

LEFT, RIGHT, CURVATURE, IS_NARROW, IS_CLOSED = range(5)
SCENARIOS = {
    "narrow_lane": (),
    "one_sided": (),
    "s_curve": (),
    "random_streets": ("scenario.streets.n_training=3", "scenario.streets.n_held_out=2"),
}


def free_by_loop(road: Road, s: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
    """Left and right of the route at s [K] on one way, seen by a driver, m."""
    sigma = road.sigma(s, way)
    right, left = road.kerbs_at(sigma, way.expand_as(s))
    for at, d, length, width in road.parked_on_line[int(way.abs()) - 1]:
        side, inner = left if d > 0 else right, abs(d) - width / 2
        bound = torch.where((sigma - at).abs() <= length / 2 + BESIDE_M, side.clamp(max=inner), side)
        left, right = (bound, right) if d > 0 else (left, bound)
    if way < 0:
        left, right = right, left
    offset = road.route_offset(s, way.expand_as(s))[0]
    return left - offset, right + offset


@pytest.mark.parametrize("name", SCENARIOS)
def test_places_agree_with_a_loop(name: str) -> None:
    game = build_game(compose_config([f"scenario={name}", *SCENARIOS[name]]))
    road, passage = game.simulator.road, Passage.of(game.simulator.collisions, game.simulator.sizes)
    ahead, s = StreetAhead(road, passage), torch.arange(-60.0, 90.0, 1.5)  # knots, so that nothing is interpolated
    for way in road.ways:
        on = way.expand_as(s)
        found, (left, right) = ahead.at(s, on), free_by_loop(road, s, way)
        is_other = (found[:, LEFT] - left).abs().maximum((found[:, RIGHT] - right).abs()) > 1e-3
        assert is_other.sum() <= 2  # a car may end at a knot
        torch.testing.assert_close(found[:, CURVATURE], road.curvature(s, on)[0], atol=1e-5, rtol=1e-4)
        narrow, closed = road.narrow_place(s, on), (passage.waiting_s(s, on, 4.5), passage.leaving_s(s, on, 4.5))
        for column, (first, last) in ((IS_NARROW, narrow), (IS_CLOSED, closed)):
            is_clear = torch.minimum((first - s).abs(), (last - s).abs()) > 1e-3
            expected = ((s > first) & (s < last)).float()
            assert torch.equal(found[is_clear, column], expected[is_clear])
            assert 0 < expected.sum() < len(s)


def test_between_knots_it_is_linear_and_beyond_its_ends_constant() -> None:
    game = build_game(compose_config(["scenario=s_curve"]))
    ahead, one = (
        StreetAhead(game.simulator.road, Passage.of(game.simulator.collisions, game.simulator.sizes)),
        torch.ones(2),
    )
    knots = ahead.at(torch.tensor([4.0, 4.5]), one)
    between = ahead.at(torch.tensor([4.25, 4.25]), one)
    torch.testing.assert_close(between, knots.mean(0).expand(2, -1), atol=1e-4, rtol=1e-4)
    far = ahead.at(torch.tensor([400.0, 1e4]), one)
    torch.testing.assert_close(far[0], far[1])
