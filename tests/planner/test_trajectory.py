"""The whole plan of a vehicle: its first state is that of the step that is driven, and it keeps on from there."""

import pytest
import torch
from games import draw_tasks, drive, tiny_config

from negopipe.game.game import Game, build_game
from negopipe.planner.frenet import FrenetPlanner
from negopipe.simulation.state import VehicleState, World

PLANNERS = {
    "polynomials": (),
    "stops": ("planner=consistent_stops",),
    "reversing": ("planner=reversing", "scenario=bent_street"),
}
HORIZONS_S = (0.0, 2.0, 6.0)


@pytest.fixture(scope="module", params=list(PLANNERS))
def driven(request: pytest.FixtureRequest) -> tuple[Game, list[World]]:
    """Worlds in which vehicles meet, at every tenth step."""
    config = tiny_config("yield", *PLANNERS[request.param])
    game = build_game(config)
    world = game.simulator.reset(draw_tasks(config, 8))
    return game, drive(game, world, torch.full((8, 2), 6.0), 60)[::10]


def planned(game: Game, world: World, horizon_s: float) -> tuple[VehicleState, VehicleState, torch.Tensor]:
    """State of `plan`, states of `trajectory`, and who brakes fully."""
    perception, horizon = game.perceive(world), torch.full((len(world.step), 2), horizon_s)
    planner: FrenetPlanner = game.planner
    states, is_full_braking = planner.trajectory(perception, horizon)
    motion = planner.plan(perception, horizon)
    assert torch.equal(is_full_braking, motion.is_full_braking)
    return motion.state, states, is_full_braking


@pytest.mark.parametrize("horizon_s", HORIZONS_S)
def test_its_first_state_is_the_step_that_is_driven(driven: tuple[Game, list[World]], horizon_s: float) -> None:
    game, worlds = driven
    for world in worlds:
        step, states, _ = planned(game, world, horizon_s)
        for name in ("position", "yaw", "speed", "accel", "curvature"):
            torch.testing.assert_close(getattr(states, name)[:, :, 0], getattr(step, name), atol=1e-5, rtol=0)


@pytest.mark.parametrize("horizon_s", HORIZONS_S)
def test_places_and_speeds_agree(driven: tuple[Game, list[World]], horizon_s: float) -> None:
    game, worlds = driven
    dt_s = game.planner.dt_s
    for world in worlds:
        _, states, _ = planned(game, world, horizon_s)
        assert states.speed.shape == (len(world.step), 2, len(game.planner.times))
        moved = states.position.diff(dim=2).norm(dim=-1)
        mean = (states.speed[..., 1:] + states.speed[..., :-1]).abs() / 2 * dt_s
        assert (moved - mean).abs().max() < 0.05  # m, the trapezoid's error at 8 m/s2
