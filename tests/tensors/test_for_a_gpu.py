"""What a GPU needs, tested without one: there all of a sparse function is computed, and a graph records no transfer."""

from typing import Any

import pytest
import torch
from composed import FEW_STREETS, compose_config
from games import draw_tasks
from torch.utils._python_dispatch import TorchDispatchMode

from negopipe.game.game import Game, build_game
from negopipe.simulation.state import World
from negopipe.tensors.tree import tensors

N_WORLDS, N_VEHICLES = 6, 5
TRANSFERS = {"_local_scalar_dense", "nonzero", "lift_fresh"}
"""Operators that read from a GPU or write to it: a number, the places that count, a constant."""


class Transfers(TorchDispatchMode):
    """Records the operators that would transfer something."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.__name__.split(".")[0]
        is_masked = name == "index" and any(each is not None and each.dtype == torch.bool for each in args[1])
        self.found |= {name} & TRANSFERS | ({"a mask as index"} if is_masked else set())
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def game() -> Game:
    return build_game(compose_config(["+experiment=generalist", *FEW_STREETS]))


@pytest.fixture(scope="module")
def start(game: Game) -> World:
    config = compose_config(["+experiment=generalist", *FEW_STREETS])
    return game.simulator.reset(draw_tasks(config, N_WORLDS))


def driven(game: Game, world: World, n_steps: int) -> World:
    for _ in range(n_steps):
        world = game.drive(world, torch.full((N_WORLDS, N_VEHICLES), 4.0)).world
        game.see(world)
    return world


def test_the_game_drives_alike_where_all_conflicts_are_computed(
    game: Game, start: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    picked = driven(game, start, 8)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)  # computes all of them, as a GPU does
    for a, b in zip(tensors(picked), tensors(driven(game, start, 8)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=1e-4, equal_nan=True)


def test_a_decision_transfers_nothing(game: Game, start: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    driven(game, start, 1)  # makes tables that are kept
    with Transfers() as transfers:
        driven(game, start, 1)
    assert transfers.found == set()
    with transfers:
        torch.ones(2)[torch.ones(2) > 0] * torch.tensor(2.0)
    assert transfers.found == {"a mask as index", "lift_fresh"}
