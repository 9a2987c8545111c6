"""Tables of a street are those of the simulator, filled up, and a decision from them is the simulator's."""

from functools import cache

import numpy as np
import pytest
import torch
from games import draw_tasks, drive, tiny_config

from negopipe.config.root import RunConfig
from negopipe.deployment.decision import Decision, outputs
from negopipe.deployment.decision_file import StreetInputs, arguments_of, expected, tensors_of
from negopipe.deployment.tables import Capacity, street_tables
from negopipe.errors import UserError
from negopipe.game.game import Game, build_game
from negopipe.policy.kinds import build_policy
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.street import Street
from negopipe.simulation.streets import Streets
from negopipe.tensors.seeding import generator

FEW = ("scenario.streets.n_training=2", "scenario.streets.n_held_out=1")
KINDS = {
    "a straight street and grids": (),
    "drawn streets and objects": (
        *("scenario=random_streets", "scenario/kind=[small_car,car,van]", "planner=reversing"),
        *("observation=objects", "policy=objects", "policy.trunk_widths=[16]", "policy.own_widths=[8]", *FEW),
    ),
}
CAPACITY = Capacity(150.0, 4, 40, 160)


@cache
def built(kind: str) -> tuple[RunConfig, Game]:
    config = tiny_config("yield", "curriculum=none", *KINDS[kind])
    return config, build_game(config)


def drawn() -> Streets:
    road = built("drawn streets and objects")[1].simulator.road
    assert isinstance(road, Streets)
    return road


@pytest.mark.parametrize("number", [0, 1, 2])
def test_they_are_those_of_the_simulator(number: int) -> None:
    road = drawn()
    one, tables = Streets([road.streets[number]]), street_tables(road.streets[number], CAPACITY, room_m=2.0)
    n = one.parked.shape[1]
    np.testing.assert_allclose(tables.parked[:, :n], one.parked.numpy(), atol=2e-4)
    assert (tables.parked[:, n:, :2] > 1000).all()
    assert abs(int((tables.off_road[..., 0] < 1000).sum()) - one.off_road.shape[1]) <= 2  # cuts may move by a knot
    missing = (CAPACITY.n_knots - len(one.streets[0].curvature)) // 2
    inside = slice(missing, -missing)
    for name, polynomials in {"line_pose": one._lines._pose, "line_curvature": one._lines._curvature}.items():
        np.testing.assert_allclose(getattr(tables, name)[:, inside], polynomials._table.numpy(), atol=2e-5)
    both = tables.routes.reshape(6, 2, -1)[..., inside].reshape(6, -1)
    np.testing.assert_allclose(both, one._routes._table.numpy(), atol=1e-6)
    n_places = one.narrow_places.shape[1]
    np.testing.assert_allclose(tables.narrow_places[:, :n_places], one.narrow_places.numpy(), atol=1e-6)


@pytest.mark.parametrize(
    ("capacity", "message"),
    [
        (Capacity(20.0, 4, 40, 160), r"at most 81 knots for this export, got \d+"),
        (Capacity(150.0, 4, 1, 160), r"at most 1 parked vehicles for this export, got \d+"),
        (Capacity(150.0, 4, 40, 2), r"at most 2 rectangles beyond its kerbs for this export, got \d+"),
    ],
)
def test_a_street_beyond_the_capacity_is_refused(capacity: Capacity, message: str) -> None:
    street = max(drawn().streets, key=lambda each: len(each.parked))
    with pytest.raises(UserError, match=message):
        street_tables(street, capacity, room_m=2.0)


def test_a_street_without_a_corridor_is_refused() -> None:
    street = drawn().streets[0]
    without = Street(street.curvature, street.kerbs, street.routes, street.parked, np.zeros((0, 2)), 10.0)
    with pytest.raises(UserError, match="must have a corridor"):
        street_tables(without, CAPACITY, room_m=2.0)


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_decision_from_tables_is_the_simulators(kind: str) -> None:
    """In driven states: same horizon, same trajectory, for streets that the graph never saw."""
    config, game = built(kind)
    policy = build_policy(config.policy, config.observation.layout, torch.device("cpu"), generator(1, "weights")).eval()
    decision = Decision(config, policy).eval()
    streets = StreetInputs(config, game)
    simulator: Simulator = game.simulator
    world = simulator.reset(draw_tasks(config, 6))
    horizon = torch.full_like(world.task.direction, 4.0)
    n_same = n = 0
    for driven in drive(game, world, horizon, 45)[::9]:
        ours = expected(config, game, policy, driven)
        for index, arguments in enumerate(arguments_of(config, game, streets, driven)):
            with torch.no_grad():
                theirs = dict(zip(outputs(config), decision(**tensors_of(config, arguments)), strict=True))
            assert float(theirs["horizon"]) == float(ours["horizon"][index])
            apart = (theirs["trajectory"] - ours["trajectory"][index])[:, :2].norm(dim=-1).max()
            n, n_same = n + 1, n_same + int(apart < 1e-3)
    assert n == 36
    assert n_same >= 35  # one tie of two candidates
