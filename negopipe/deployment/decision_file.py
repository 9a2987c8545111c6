"""decision.onnx: states and street in, horizon and trajectory out, one decision at a time."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from negopipe.deployment.decision import Decided, Decision, n_ahead, needs
from negopipe.deployment.inputs import decision_inputs
from negopipe.deployment.onnx_file import open_onnx, write_onnx
from negopipe.deployment.surroundings import with_surroundings
from negopipe.deployment.tables import street_tables
from negopipe.game.game import Game
from negopipe.policy.actor_critic import Policy
from negopipe.simulation.drawn_street import drawn_street
from negopipe.simulation.knot_tables import BEYOND_M
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.state import EGO, World
from negopipe.simulation.street import Street
from negopipe.simulation.streets import Streets
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

Arguments = dict[str, np.ndarray]
"""Arguments of one decision by name."""


class StreetInputs:
    """The street arguments of the streets of a game, made once per street."""

    def __init__(self, config: "RunConfig", game: Game, decision: Decision) -> None:
        self._config, self._road, self._decision = config, game.simulator.road, decision
        self._made: dict[int, Arguments] = {}

    def of(self, number: int) -> Arguments:
        """number: of the street, from 1."""
        if number not in self._made:
            config, decision = self._config, self._decision
            room_m = float(config.scenario.sizes.smallest.width) + 2 * config.planner.clearance.parked_near_m
            tables = street_tables(street_of(self._road, number), config.export.capacity.street, room_m)
            named = with_surroundings(decision.road, decision.sizes, tables, n_ahead(config), config.scenario.dt_s)
            self._made[number] = {name: named[name].numpy().copy() for name in needs(config)}
        return self._made[number]


def street_of(road: Any, number: int) -> Street:
    """Street `number` of a game's road, sampled at knots."""
    if isinstance(road, OneStreet):
        return drawn_street(road.config, road.config.reach_m + BEYOND_M)
    assert isinstance(road, Streets)
    return road.streets[number - 1]


def write_decision(path: Path, decision: Decision, arguments: Arguments, config: "RunConfig") -> None:
    """Write decision.onnx; arguments: of some decision."""
    tensors = {name: torch.from_numpy(array.copy()) for name, array in arguments.items()}
    street = {name: tensors.pop(name) for name in needs(config)}
    write_onnx(path, decision, tensors | {"street": street}, Decided._fields, config.export.opset)


def arguments_of(config: "RunConfig", game: Game, streets: StreetInputs, world: World) -> list[Arguments]:
    """Arguments of the ego's decision in each of E worlds."""
    perception = game.perceive(world).of(EGO)
    inputs = decision_inputs(perception, config.scenario.dt_s, config.export.capacity.n_others)
    numbers = perception.direction[:, 0].abs().long().tolist()
    return [
        {name: field[index].numpy() for name, field in inputs.items()} | streets.of(number)
        for index, number in enumerate(numbers)
    ]


class DecisionSession:
    """decision.onnx in onnxruntime."""

    def __init__(self, path: Path) -> None:
        self._session = open_onnx(path)
        self._names = [each.name for each in self._session.get_inputs()]

    def decide(self, arguments: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Outputs by their names in `Decided`; arguments that the graph does not read are left out."""
        found = self._session.run(list(Decided._fields), {name: arguments[name] for name in self._names})
        return dict(zip(Decided._fields, found, strict=True))


@torch.no_grad()
def expected(config: "RunConfig", game: Game, policy: Policy, world: World) -> dict[str, Tensor]:
    """The same outputs for E worlds by the game's own observation and planner, on the game's own road."""
    perception = game.perceive(world).of(EGO)
    logits = policy(game.draw(perception))[0]
    horizon = torch.tensor(config.policy.horizons_s)[logits.argmax(-1)]
    states, is_full_braking = game.planner.trajectory(perception, horizon[:, None])
    states = map_tensors(lambda field: field[:, 0], states)
    rest = (states.yaw, states.speed, states.accel, states.curvature)
    trajectory = torch.cat([states.position, torch.stack(rest, -1)], -1)
    return {"horizon": horizon, "trajectory": trajectory, "is_full_braking": is_full_braking[:, 0]}
