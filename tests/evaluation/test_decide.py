"""One decision of everybody: in one call where all follow the planner, else vehicle by vehicle."""

import pytest
import torch
from composed import compose_config
from games import draw_tasks

from negopipe.agents.driver import HorizonDriver, fixed_horizon
from negopipe.evaluation.episodes import decide
from negopipe.game.game import Driven, build_game
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import EGO, Motion
from negopipe.tensors.tree import tensors


class OfAnotherKind:
    """A driver that is not known to follow the planner, though it does."""

    def __init__(self, driver: HorizonDriver) -> None:
        self._driver = driver

    def drive(self, perception: Perception) -> Motion:
        return self._driver.drive(perception)


@pytest.mark.parametrize("options", [[], ["safety=rss"], ["population=mixed", "scenario.n_social=2"]])
def test_both_ways_drive_alike(options: list[str]) -> None:
    config = compose_config(options)
    game = build_game(config)
    world = game.simulator.reset(game.cast.assign(draw_tasks(config, 6)))
    planned = HorizonDriver(fixed_horizon(2.0), game.plan)
    for _ in range(12):
        at_once = decide(game, {EGO: planned}, world)
        apart = decide(game, {EGO: OfAnotherKind(planned)}, world)
        for a, b in zip(tensors(at_once), tensors(apart), strict=True):
            torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4, equal_nan=True)
        world = at_once.world


def test_what_a_chunk_returns_keeps_its_names() -> None:
    config = compose_config()
    game = build_game(config)
    world = game.simulator.reset(draw_tasks(config, 130))
    driven = game.drive(world, torch.full((130, 2), 6.0))
    assert isinstance(driven, Driven)
    assert driven.motion.horizon.shape == (130, 2)
    assert driven.intervention.tolist() == [0] * 130
