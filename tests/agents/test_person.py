"""A person's car: pedals along the route within its limits, or the planner with the person's horizon."""

import pytest
import torch
from composed import compose_config
from games import draw_tasks, meet

from negopipe.agents.driver import HorizonDriver, fixed_horizon
from negopipe.agents.person import PEDALS, horizon_driver, pedal_driver, seat_person
from negopipe.checks import Problem
from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.state import NEAREST, NOBODY
from negopipe.tensors.tree import tensors


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return compose_config()


@pytest.fixture(scope="module")
def game(config: RunConfig) -> Game:
    return build_game(config)


def speeds(config: RunConfig, game: Game, pedals: list[str], now_mps: list[float]) -> list[float]:
    """Speeds one control step later, m/s, one world per pedal."""
    world = meet(config, game, [[-40.0, -30.0]] * len(pedals), [[0.0, speed] for speed in now_mps])
    numbers = torch.tensor([[PEDALS.index(pedal)] for pedal in pedals])
    driver = pedal_driver(config.play.pedals, game.simulator, lambda: numbers)
    motion = driver.drive(game.perceive(world).of(NEAREST))
    assert motion.horizon.isnan().all()
    return motion.state.speed[:, 0].tolist()


def test_each_pedal_changes_the_speed_by_its_acceleration(config: RunConfig, game: Game) -> None:
    by, dt_s = config.play.pedals, config.scenario.dt_s
    expected = [3 + by.go_mps2 * dt_s, 3 - by.ease_mps2 * dt_s, 3 - by.brake_mps2 * dt_s]
    assert speeds(config, game, list(PEDALS), [3.0] * 3) == pytest.approx(expected, abs=1e-4)


def test_a_car_neither_reverses_nor_exceeds_its_desired_speed(config: RunConfig, game: Game) -> None:
    desired = config.scenario.desired_speed_mps[1]
    assert speeds(config, game, ["brake", "ease", "go"], [0.1, 0.1, desired - 0.1]) == pytest.approx([0, 0, desired])
    assert speeds(config, game, ["go"], [desired + 1]) == pytest.approx(
        [desired + 1 - 0.2 * config.play.pedals.ease_mps2]
    )


def test_a_horizon_is_driven_as_by_the_planner(config: RunConfig, game: Game) -> None:
    perception = game.perceive(meet(config, game, [[-12.0, -13.0]], [[5.0, 5.0]])).of(NEAREST)
    mine = horizon_driver(game.plan, lambda: torch.tensor([[4.0]])).drive(perception)
    planner = HorizonDriver(fixed_horizon(4.0), game.plan).drive(perception)
    assert all(torch.equal(a, b) for a, b in zip(tensors(mine), tensors(planner), strict=True))


def test_the_seat_of_a_person_has_no_other_driver() -> None:
    config = compose_config(["population=mixed", "scenario.n_social=2"])
    drawn = build_game(config).cast.assign(draw_tasks(config, 5))
    task = seat_person(drawn)
    assert (task.casting.driver[:, NEAREST] == NOBODY).all()
    assert task.style_horizon[:, NEAREST].isnan().all()
    assert torch.equal(task.casting.driver[:, 2], drawn.casting.driver[:, 2])
    assert torch.equal(task.start_distance, drawn.start_distance)


@pytest.mark.parametrize("key", ["go_mps2", "ease_mps2", "brake_mps2"])
def test_no_pedal_exceeds_what_the_planner_can_do(config: RunConfig, key: str) -> None:
    changed = compose_config([f"play.pedals.{key}=9.0"])
    (problem,) = changed.play.pedals.check("play.pedals", changed.planner.limits)
    assert isinstance(problem, Problem)
    assert problem.key == f"play.pedals.{key}"
    assert not list(config.play.pedals.check("play.pedals", config.planner.limits))
