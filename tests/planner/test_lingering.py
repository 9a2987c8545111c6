"""Lingering: nobody plans to stay where it cannot be passed while it predicts an oncoming one to come."""

import pytest
import torch
from composed import compose_config
from games import draw_tasks, meet
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.planner.lingering import Lingering
from negopipe.simulation.perception import Perception
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, World

WAITING, LEAVING = -9.0, 21.0
"""s of the last place before and of the first behind the passage of narrow_lane, m."""


@pytest.fixture(scope="module")
def built() -> tuple[RunConfig, Game, Lingering]:
    config = compose_config(["planner=consistent_stops"])
    game = build_game(config)
    assert game.planner.lingering is not None
    return config, game, game.planner.lingering


def met(game: Game, lingering: Lingering, world: World, horizon_s: list[float]) -> list[bool]:
    seen: Perception = game.perceive(world).of(EGO)
    return lingering.is_met(game.planner.situation(seen, torch.tensor(horizon_s)[:, None])).tolist()


def test_an_oncoming_one_is_met_if_it_is_predicted_to_come(built: tuple[RunConfig, Game, Lingering]) -> None:
    config, game, lingering = built
    far = WAITING - 10.0  # 2.5 s away at 4 m/s
    s = [[-15.0, far], [-15.0, far], [-15.0, far], [-15.0, 0.0], [-15.0, 0.0], [5.0, 8.0]]
    world = meet(config, game, s, [[4.0, 4.0]] * 3 + [[4.0, 0.0]] * 3)
    # beyond 2 s; within 4 s; not at all; it stands in the passage already; predicted 0 s ahead; it has passed
    assert met(game, lingering, world, [2.0, 4.0, 0.0, 2.0, 0.0, 6.0]) == [False, True, False, True, False, False]
    endless = meet(config, game, [[-15.0, WAITING - 4.0 * 6.5]], [[4.0, 4.0]])
    assert met(game, lingering, endless, [torch.inf]) == [False]  # no prediction goes beyond the plan


def test_who_stays_in_the_passage_lingers(built: tuple[RunConfig, Game, Lingering]) -> None:
    config, game, lingering = built
    ends: list[tuple[float, float]] = [
        (WAITING, 0.0), (WAITING + 0.5, 0.0), (0.0, 1.0), (0.0, 3.5), (LEAVING, 0.0), (LEAVING - 0.5, 0.0),
    ]  # fmt: skip
    end, speed = torch.tensor(ends).T
    world = meet(config, game, [[0.0, 0.0]], [[0.0, 0.0]])
    now = game.planner.situation(game.perceive(world).of(EGO), torch.zeros(1, 1))

    def lingers(is_met: bool) -> list[bool]:
        at: list[Tensor] = [x[:, None, None] for x in (end, speed)]
        return lingering.lingers(*at, now, torch.tensor([is_met]))[:, 0].tolist()

    assert lingers(True) == [False, True, True, False, False, True]
    assert not any(lingers(False))


def n_successes(n: int, ego_s: float, *overrides: str) -> int:
    """Of n tasks of yield, in which the other predicts 2 s and comes first."""
    config = compose_config(["planner=consistent_stops", *overrides])
    game, families = build_game(config), {"yield": config.scenario.families["yield"]}
    task = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(n)
    world, horizon = game.simulator.reset(task), torch.tensor([[ego_s, 2.0]]).expand(n, 2)
    is_success = torch.zeros(n, dtype=torch.bool)
    for _ in range(100):
        world, events, *_ = game.drive(world, horizon)
        is_success |= events.is_success
    return int(is_success.sum())


def test_who_waits_can_be_passed() -> None:
    assert n_successes(16, 4.0) == 16
    assert n_successes(16, 4.0, "planner.cost.lingering=0.0") < 8


def test_who_predicts_nothing_pays_nothing(built: tuple[RunConfig, Game, Lingering]) -> None:
    config, game, _ = built
    free = build_game(compose_config(["planner=consistent_stops", "planner.cost.lingering=0.0"]))
    world, horizon = game.simulator.reset(draw_tasks(config, 16)), torch.zeros(16, 2)
    for _ in range(10):
        motion = game.plan(game.perceive(world), horizon)
        assert torch.equal(motion.state.speed, free.plan(free.perceive(world), horizon).state.speed)
        world, _ = game.simulator.step(world, motion.state)
