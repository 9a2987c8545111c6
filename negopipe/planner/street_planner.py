"""The Frenet planner on its own: rows of numbers in, whole trajectories out, on one street and for any number of cars.

    from negopipe.planner.street_planner import StreetPlanner

    planner = StreetPlanner.of("narrow_lane", "frenet")
    ego, other = [-20.0, -1.75, 0.0, 4.8], [22.0, 1.75, 3.1416, 5.0]  # x, y, yaw, speed
    plans = planner.plan([ego], [[other]], horizon_s=4.0, desired_speed_mps=6.0)
    print(plans.states.position[0], plans.is_full_braking[0])

Neither Hydra nor MLflow is imported. Simulation and training use `FrenetPlanner` through `game.Game.plan`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from negopipe.planner.config import PlannerConfig
from negopipe.planner.frenet import FrenetPlanner
from negopipe.planner.options import planner_option, scenario_option
from negopipe.simulation.build_road import build_road
from negopipe.simulation.perception import Perception
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import NOBODY, VehicleState
from negopipe.tensors.chunked import ChunkedFunction
from negopipe.tensors.compiled import compiled
from negopipe.tensors.tree import map_tensors

Rows = Tensor | Sequence[Any]
"""Numbers as a tensor or as nested lists."""

N_AT_ONCE = 64
"""Plans per call where there are several: many enough to outweigh the cost of a call."""


class Plans(NamedTuple):
    """Trajectories of N vehicles.

    states: VehicleState [N, T], at the T times `StreetPlanner.times`, in the world frame
    is_full_braking: [N] bool, no candidate was feasible: the trajectory is the hardest stop
    """

    states: VehicleState
    is_full_braking: Tensor


class StreetPlanner:
    """Planner of any number of cars on the first street of a scenario.

    The world frame is right-handed. Its origin is the middle of the corridor between the parked cars, +x leads along
    the street. All cars have the size `scenario.vehicle`.

    times: [T] float32, s, of the states of a plan, from one control step after now on
    n_candidates: trajectories that are checked for a plan
    is_compiled: compile at the first plan of one vehicle and at the first of several, which takes up to a minute each
        and needs a C++ compiler; later plans are several times faster
    """

    def __init__(self, scenario: ScenarioConfig, planner: PlannerConfig, is_compiled: bool = False) -> None:
        ego = scenario.sizes.ego
        self.road, self._size = build_road(scenario), ego
        self._frenet = FrenetPlanner(planner, self.road, Sizes(ego, ego, ego), scenario.dt_s)
        self.times, self.n_candidates = self._frenet.times, self._frenet.n_combinations
        compiler = compiled if is_compiled else None
        self._plan_one = ChunkedFunction(self._trajectories, (1,), compiler)  # compiled code has one shape
        self._plan_many = ChunkedFunction(self._trajectories, (N_AT_ONCE,), compiler)

    @staticmethod
    def of(
        scenario: str, planner: str, road: Mapping[str, Any] | None = None, is_compiled: bool = False
    ) -> "StreetPlanner":
        """Planner by the names of options in conf/scenario and conf/planner.

        road: sizes of the street that differ, by key of `scenario.road`, as `{"corridor_gap_m": 3.4}`

        UserError names an option, a key or a value that is not allowed.
        """
        changes = {"road": dict(road)} if road else None
        return StreetPlanner(scenario_option(scenario, changes), planner_option(planner), is_compiled)

    def plan(
        self, vehicles: Rows, others: Rows | None, horizon_s: Rows | float, desired_speed_mps: Rows | float
    ) -> Plans:
        """Best trajectory of each of N vehicles.

        vehicles: [N, 4] x, y, yaw, speed (m, m, rad, m/s), or [N, 6] with acceleration (m/s2) and curvature (1/m) of
            the path that is driven; the yaw says which way along the street a vehicle goes
        others: [N, O, 4] x, y, yaw, speed of the O vehicles that each of them sees; a row of NaN is nobody. None =
            nobody anywhere
        horizon_s: [N] or one number, s: how far the others are predicted; beyond it they are ignored
        desired_speed_mps: [N] or one number, m/s

        ValueError where a shape is another.
        """
        own = _rows(vehicles)
        if own.dim() != 2 or own.shape[1] not in (4, 6):
            raise ValueError(f"vehicles must have the shape [N, 4] or [N, 6], got {list(own.shape)}")
        n = len(own)
        seen = torch.full((n, 1, 4), torch.nan) if others is None else _rows(others)
        if seen.dim() != 3 or seen.shape[0] != n or seen.shape[2] != 4:
            raise ValueError(f"others must have the shape [{n}, O, 4], got {list(seen.shape)}")
        own = torch.cat([own, own.new_zeros(n, 6 - own.shape[1])], dim=1)
        numbers = (_rows(each).expand(n) for each in (horizon_s, desired_speed_mps))
        plan = self._plan_one if n == 1 else self._plan_many
        return Plans(*plan(own, seen, *numbers))

    def _trajectories(self, own: Tensor, seen: Tensor, horizon: Tensor, desired: Tensor) -> tuple[VehicleState, Tensor]:
        state = _state(own[:, None])
        direction, _ = self.road.to_own_route(state, torch.ones_like(state.yaw))
        nobody = torch.full_like(direction, NOBODY, dtype=torch.int64)
        unknown, is_seen = torch.full_like(direction, torch.nan), ~seen.isnan().any(-1)[:, None]
        other = _state(torch.cat([seen, torch.zeros_like(seen[..., :2])], dim=-1).nan_to_num()[:, None])
        perception = Perception(
            own=state,
            direction=direction,
            desired_speed=desired[:, None],
            style_horizon=unknown,
            driver=nobody,
            last_horizon=unknown,
            rest_steps=torch.zeros_like(nobody),
            length=torch.full_like(direction, float(self._size.length)),
            width=torch.full_like(direction, float(self._size.width)),
            other=other,
            other_length=torch.full_like(other.yaw, float(self._size.length)),
            other_width=torch.full_like(other.yaw, float(self._size.width)),
            is_seen=is_seen,
            own_history=state.position.new_zeros(len(own), 0, 1, 3),  # the planner looks at the present alone
            other_history=state.position.new_zeros(len(own), 0, *is_seen.shape[1:], 3),
            is_seen_history=is_seen.new_zeros(len(own), 0, *is_seen.shape[1:]),
        )
        states, is_full_braking = self._frenet.trajectory(perception, horizon[:, None])
        return map_tensors(lambda field: field[:, 0], states), is_full_braking[:, 0]


def _state(rows: Tensor) -> VehicleState:
    """State of rows [..., 6]: x, y, yaw, speed, acceleration, curvature."""
    return VehicleState(rows[..., :2], *rows[..., 2:].unbind(-1))


def _rows(numbers: Rows | float) -> Tensor:
    return torch.as_tensor(numbers, dtype=torch.float32)
