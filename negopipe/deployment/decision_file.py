"""decision.onnx: states and street in, horizon and trajectory out, one decision at a time; street.onnx: tables of a
street in, those that say where to wait out."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from negopipe.agents.horizon_drivers import draw_of
from negopipe.deployment.decision import PASSAGE, STATES, Decision, last_inputs, needs, outputs
from negopipe.deployment.driven import drive_held_out
from negopipe.deployment.inputs import decision_inputs
from negopipe.deployment.onnx_file import write_onnx
from negopipe.deployment.surroundings import NAMES, Surroundings, as_tensors, with_surroundings
from negopipe.deployment.tables import StreetTables, street_tables
from negopipe.game.game import Game
from negopipe.policy.actor_critic import Policy, action_of_draw, greedy_action
from negopipe.runtime.build import with_learned
from negopipe.simulation.drawn_street import drawn_street
from negopipe.simulation.knot_tables import BEYOND_M
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.state import EGO, Motion, VehicleState, World
from negopipe.simulation.street import Street
from negopipe.simulation.streets import Streets
from negopipe.tensors.torch_settings import own_settings
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

Arguments = dict[str, np.ndarray]
"""Arguments of one decision by name."""


class StreetInputs:
    """The street arguments of the streets of a game, made once per street."""

    def __init__(self, config: "RunConfig", game: Game) -> None:
        self._config, self._road, self._surroundings = config, game.simulator.road, Surroundings(config)
        self._made: dict[int, Arguments] = {}

    def tables(self, number: int) -> StreetTables:
        """Tables without surroundings of a street; number: from 1."""
        config = self._config
        room_m = float(config.scenario.sizes.smallest.width) + 2 * config.planner.clearance.parked_near_m
        return street_tables(street_of(self._road, number), config.export.capacity.street, room_m)

    def of(self, number: int) -> Arguments:
        """number: of the street, from 1."""
        if number not in self._made:
            named = with_surroundings(self._surroundings, self.tables(number))
            self._made[number] = {name: named[name].numpy().copy() for name in needs(self._config)}
        return self._made[number]


def street_of(road: Any, number: int) -> Street:
    """Street `number` of a game's road, sampled at knots."""
    if isinstance(road, OneStreet):
        return drawn_street(road.config, road.config.reach_m + BEYOND_M)
    assert isinstance(road, Streets)
    return road.streets[number - 1]


def write_decision(path: Path, decision: Decision, arguments: Arguments, config: "RunConfig") -> None:
    """Write decision.onnx; arguments: of some decision."""
    write_onnx(path, decision, tensors_of(config, arguments), outputs(config), config.export.opset)


def tensors_of(config: "RunConfig", arguments: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Arguments of `Decision.forward` by name, in its order; the tables of the street are one of them."""

    def named(names: Iterable[str]) -> dict[str, Any]:
        return {name: torch.from_numpy(np.array(arguments[name])) for name in names}

    return named(STATES) | {"street": named(needs(config))} | named(last_inputs(config))


def write_street(path: Path, config: "RunConfig", tables: StreetTables) -> None:
    """Write street.onnx; tables: of some street."""
    write_onnx(path, Surroundings(config).eval(), {"street": as_tensors(tables)}, NAMES, config.export.opset)


def has_surroundings(config: "RunConfig") -> bool:
    """Whether the decision of a config reads tables that street.onnx computes."""
    return PASSAGE[0] in needs(config)


@own_settings()
def driven_arguments(config: "RunConfig", game: Game, policy: Policy, n: int) -> list[Arguments]:
    """Of n decisions, evenly spread over those of held-out episodes."""
    game, streets = with_learned(game, config, policy), StreetInputs(config, game)
    seen: list[Arguments] = []

    def choose(world: World) -> Tensor:
        seen.extend(arguments_of(config, game, streets, world))
        return expected(config, game, policy, world)["horizon"]

    drive_held_out(config, game, choose, n * config.export.n_worlds)
    return [seen[index] for index in np.linspace(0, len(seen) - 1, n).astype(int)]


def arguments_of(config: "RunConfig", game: Game, streets: StreetInputs, world: World) -> list[Arguments]:
    """Arguments of the ego's decision in each of E worlds."""
    perception = game.perceive(world).of(EGO)
    found = decision_inputs(perception, config.scenario.dt_s, config.export.capacity.n_others)
    if world.kept_stop.shape[1]:
        found["kept"] = world.kept_stop[:, None]
    if config.export.action == "sample":
        found["draw"] = draws(world)[:, None]
    numbers = perception.direction[:, 0].abs().long().tolist()
    return [
        {name: field[index].numpy() for name, field in found.items()} | streets.of(number)
        for index, number in enumerate(numbers)
    ]


def draws(world: World) -> Tensor:
    """[E]: uniform numbers by which an evaluation of these worlds draws the horizons of the ego."""
    return draw_of(world.task.noise_seed, world.step)


@torch.no_grad()
def expected(config: "RunConfig", game: Game, policy: Policy, world: World) -> dict[str, Tensor]:
    """The same outputs for E worlds by the game's own observation, planner and safety layer, on the game's own road.

    Where the layer intervenes, only the first state of the trajectory is what is driven.
    """
    perception = game.perceive(world).of(EGO)
    logits = policy(game.draw(perception))[0]
    action = action_of_draw(logits, draws(world)) if config.export.action == "sample" else greedy_action(logits)
    horizon = torch.tensor(config.policy.horizons_s)[action]
    states, is_full_braking = game.planner.trajectory(perception, horizon[:, None])
    motion = Motion(map_tensors(lambda field: field[:, :, 0], states), horizon[:, None], is_full_braking)
    _, motion, intervention = game.guard(world, perception, motion)
    step = map_tensors(lambda field: field[:, :1], motion.state)
    rest = map_tensors(lambda field: field[:, 0, 1:], states)
    return {
        "horizon": horizon,
        "trajectory": torch.cat([_rows(step), _rows(rest)], 1),
        "is_full_braking": motion.is_full_braking[:, 0],
        "intervention": intervention,
    }


def _rows(states: VehicleState) -> Tensor:
    """[E, T, 6] of states [E, T]."""
    return torch.cat([states.position, torch.stack([states.yaw, states.speed, states.accel, states.curvature], -1)], -1)
