"""One decision as a function of tensors: states and street in, horizon and trajectory out.

Axes: K past states (index 0 now), N other road users, T times of the plan, A actions. The street comes as the tables of
`tables.StreetTables`, with the places to wait of `passage.py`. All arguments are float32 but for `n_places` (int64).
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from negopipe.deployment.graph_road import bound_road
from negopipe.observation.objects import Objects, ObjectsConfig
from negopipe.observation.occupancy_grid import WORD_BITS, OccupancyGrid
from negopipe.observation.street_ahead import AROUND_M
from negopipe.observation.street_ahead import KNOT_M as AHEAD_KNOT_M
from negopipe.planner.frenet import FrenetPlanner
from negopipe.planner.roadside import Half, ParkedRow, Roadside
from negopipe.policy.actor_critic import Policy, action_of_draw, greedy_action
from negopipe.safety.config import NoSafetyConfig, RssConfig
from negopipe.safety.layer import SafetyLayer
from negopipe.safety.stops import N_PATH, StopPaths, braked
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.perception import Perception, other_columns
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import NOBODY, Motion, VehicleState
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

OWN = ("x", "y", "yaw", "speed", "accel", "curvature", "desired_speed", "last_horizon", "rest_s", "length", "width")
"""Columns of `own`: the state in the own plan (world; m, rad, m/s, m/s2, 1/m), wish (m/s), horizon of the decision
before (s, NaN = none), time at rest (s), footprint (m); then `direction`, +1 along the street's line, -1 against it."""

OTHER = ("x", "y", "yaw", "speed", "accel", "length", "width")
"""Columns of `others`."""

STATES = ("own", "own_history", "others", "others_history", "is_seen", "direction")
"""Arguments of every decision, in front of the street."""

PASSAGE = ("waiting", "leaving", "their_waiting", "their_leaving")


class Decided(NamedTuple):
    """Outputs of one decision.

    horizon: [1] s; action: [1] int64; logits: [1, A]
    trajectory: [T, 6], x, y, yaw, speed, accel, curvature at the times of the plan
    is_full_braking: [1] bool, no candidate was feasible
    intervention: [1] int64, of the safety layer, index into `safety.layer.INTERVENTIONS`; keep: [1, N_KEPT], `kept` of
        the next decision. Without a layer the two are no outputs
    """

    horizon: Tensor
    action: Tensor
    logits: Tensor
    trajectory: Tensor
    is_full_braking: Tensor
    intervention: Tensor
    keep: Tensor


@dataclass(frozen=True)
class AnySizes(Sizes):
    """Sizes of vehicles that are never taken as alike: every footprint is an input."""

    @property
    def is_one(self) -> bool:
        return False


class PlainGrid(OccupancyGrid):
    """Grids for a graph: rectangles are united by halves, which takes few nodes, and cells are made bit by bit, since
    ONNX cannot read a word as four bytes.
    """

    def _union(self, spans: Tensor) -> Tensor:
        n_boxes = spans.shape[-3]
        while n_boxes > 1:
            half = n_boxes // 2
            pairs = torch.bitwise_or(spans[..., :half, :, :], spans[..., half : 2 * half, :, :])
            spans = torch.cat([pairs, spans[..., 2 * half :, :, :]], -3) if n_boxes % 2 else pairs
            n_boxes = spans.shape[-3]
        return spans[..., 0, :, :]

    def _cells(self, rows: Tensor) -> Tensor:
        words = rows.transpose(-1, -2)[..., None]
        bits = torch.bitwise_right_shift(words, torch.arange(WORD_BITS, dtype=torch.int32)).bitwise_and(1)
        return bits.flatten(-2)[..., : self.config.n_cells].to(torch.uint8)


class BroadcastRoadside(Roadside):
    """A roadside that is checked row by row in one computation: there may be many, and a graph must stay small."""

    def _into_rows(self, s: Tensor, direction: Tensor, d: Tensor, d_prime: Tensor, half: Half) -> Tensor:
        rows = self.road.pick(self._rows, direction)  # [P, 4]
        fields = (field[:, None, None, None] for field in rows.unbind(-1))  # [P, 1, 1, 1]
        return self._into_row(ParkedRow(*fields), s, direction, d, d_prime, half).amax(0)


class Decision(nn.Module):
    """The decision of one vehicle, for the config of an export."""

    def __init__(self, config: "RunConfig", policy: Policy) -> None:
        super().__init__()
        scenario, sizes = config.scenario, config.scenario.sizes
        self.policy, self._dt_s = policy, scenario.dt_s
        self.road = bound_road(config)
        self.sizes = AnySizes(sizes.ego, sizes.smallest, sizes.largest)
        self.planner = FrenetPlanner(config.planner, self.road, self.sizes, scenario.dt_s)
        planner, reversing = self.planner, self.planner.reversing
        planner.roadside = self._broadcast(planner.roadside)
        if reversing is not None:
            reversing._roadside = self._broadcast(reversing._roadside)
        self.observation = self._observation(config)
        self.guard = None if isinstance(config.safety, NoSafetyConfig) else self._guard(config.safety)
        self.horizons: Tensor
        self.register_buffer("horizons", torch.tensor(config.policy.horizons_s))

    def _broadcast(self, roadside: Roadside) -> BroadcastRoadside:
        return BroadcastRoadside(self.road, self.sizes, roadside.clearance_m[:, 0])

    def _observation(self, config: "RunConfig") -> OccupancyGrid | Objects:
        kind, dt_s = config.observation, self._dt_s
        if not isinstance(kind, ObjectsConfig):
            return PlainGrid(kind, self.road, self.sizes, dt_s)
        objects = Objects(kind, self._passage(), dt_s)
        objects._street._n_knots = n_ahead(config)
        return objects

    def _passage(self) -> Passage:
        return Passage.of(CollisionCheck(self.road, self._dt_s, other_columns(2)), self.sizes)

    def _guard(self, config: RssConfig) -> SafetyLayer:
        layer = SafetyLayer(config, self.road, self.sizes, self._dt_s, self._passage())
        layer.roadside = self._broadcast(layer.roadside)
        return layer

    def forward(
        self,
        own: Tensor,
        own_history: Tensor,
        others: Tensor,
        others_history: Tensor,
        is_seen: Tensor,
        direction: Tensor,
        street: dict[str, Tensor],
        kept: Tensor | None = None,
        draw: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Fields of `Decided`, as many as `outputs` names.

        own: [11], `OWN`; own_history: [K, 3], x, y, yaw; others: [N, 7], `OTHER`; others_history: [K, N, 3];
        is_seen: [K, N], 1 where seen, index 0 now; direction: [1]; street: tables by name
        kept: [1, N_KEPT] of the decision before, NaN in the first one; None without a safety layer
        draw: [1], uniform number in (0, 1) by which the horizon is drawn; None = the most probable one
        """
        self._bind(street)
        perception = self._perception(own, own_history, others, others_history, is_seen > 0.5, direction)
        logits = self.policy(self.observation.draw(perception))[0]
        action = greedy_action(logits) if draw is None else action_of_draw(logits, draw)
        horizon = self.horizons[action]
        states, is_full_braking = self.planner.trajectory(perception, horizon[:, None])
        decided = (horizon, action, logits, _rows(map_tensors(lambda field: field[0, 0], states)), is_full_braking[0])
        if self.guard is None or kept is None:
            return decided
        motion = Motion(map_tensors(lambda field: field[:, :, 0], states), horizon[:, None], is_full_braking)
        return self._guarded(decided, self.guard, perception, motion, kept)

    def _guarded(
        self, decided: tuple[Tensor, ...], guard: SafetyLayer, perception: Perception, motion: Motion, kept: Tensor
    ) -> tuple[Tensor, ...]:
        """The decision with what the safety layer drives: its step, and then the stop that it has checked."""
        horizon, action, logits, trajectory, _ = decided
        checked = guard.guard(perception, motion, kept)
        step, direction = map_tensors(lambda field: field[:, 0], checked.motion.state), perception.direction[:, 0]
        paths = StopPaths.unpack(checked.kept[:, :N_PATH])
        decel = torch.full_like(paths.start_s, guard.config.limits.decel_max_mps2)
        seconds = self.planner.times[:-1, None]  # after the step
        stopping = braked(self.road, direction, self.road.to_route(step, direction), paths, decel, seconds)
        rest = _rows(map_tensors(lambda field: field[:, 0], self.road.to_world(stopping, direction)))
        stop = torch.cat([_rows(step), rest])
        trajectory = torch.where(checked.intervention[:, None] > 0, stop, trajectory)
        is_full_braking = checked.motion.is_full_braking[0]
        return Decided(horizon, action, logits, trajectory, is_full_braking, checked.intervention, checked.kept)

    def _bind(self, street: dict[str, Tensor]) -> None:
        """Take over a street's tables in all parts that hold some."""
        self.road.bind(street)
        planner, observation = self.planner, self.observation
        planner.roadside._rows = street["rows"]
        holders = (planner.give_way, planner.reversing, planner.lingering, self.guard)
        parts: list[Any] = [part for part in holders if part]
        if planner.reversing is not None:
            planner.reversing._roadside._rows = street["rows"]
        if self.guard is not None:
            self.guard.roadside._rows = street["rows"]
        if isinstance(observation, Objects):
            parts += [observation]
            observation._street._table = street["ahead"]
        else:
            observation._static = torch.cat([street["parked"], street["off_road"]], dim=1)
        for part in parts:
            part.passage = replace(part.passage, **{name: street[name] for name in PASSAGE})

    def _perception(
        self, own: Tensor, own_history: Tensor, others: Tensor, others_history: Tensor, seen: Tensor, direction: Tensor
    ) -> Perception:
        """The perception of one agent in one world."""
        x, y, yaw, speed, accel, curvature, desired_speed, last_horizon, rest_s, length, width = own[:, None, None]
        their_x, their_y, their_yaw, their_speed, their_accel, their_length, their_width = others.T[:, None, None]
        own_state = VehicleState(torch.stack([x, y], -1), yaw, speed, accel, curvature)
        position = torch.stack([their_x, their_y], -1)
        return Perception(
            own=own_state,
            direction=direction[None],
            desired_speed=desired_speed,
            style_horizon=torch.full_like(speed, torch.nan),
            driver=torch.full_like(speed, NOBODY, dtype=torch.int64),
            last_horizon=last_horizon,
            rest_steps=rest_s / self._dt_s,
            length=length,
            width=width,
            other=VehicleState(position, their_yaw, their_speed, their_accel, torch.zeros_like(their_accel)),
            other_length=their_length,
            other_width=their_width,
            is_seen=seen[:1, None],
            own_history=own_history[None, :, None],
            other_history=others_history[None, :, None],
            is_seen_history=seen[None, :, None],
        )


def _rows(states: VehicleState) -> Tensor:
    """[T, 6]: x, y, yaw, speed, acceleration, curvature of states [T]."""
    position, *rest = vars(states).values()
    return torch.cat([position, torch.stack(rest, -1)], -1)


def outputs(config: "RunConfig") -> tuple[str, ...]:
    """Names of the outputs of the decision of a config."""
    return Decided._fields[:-2] if isinstance(config.safety, NoSafetyConfig) else Decided._fields


def last_inputs(config: "RunConfig") -> tuple[str, ...]:
    """Arguments of the decision of a config behind the street."""
    kept = () if isinstance(config.safety, NoSafetyConfig) else ("kept",)
    return (*kept, "draw") if config.export.action == "sample" else kept


def n_ahead(config: "RunConfig") -> int:
    """Knots of the table of the street ahead, for corridors up to the reach of the export."""
    return 2 + int((config.export.capacity.reach_m + 2 * AROUND_M) / AHEAD_KNOT_M)


def needs(config: "RunConfig") -> list[str]:
    """Names of the street's tables that the decision of a config reads, in order."""
    is_grid = not isinstance(config.observation, ObjectsConfig)
    planner = config.planner
    names = ["line_curvature", "line_pose", "line_points", "routes", "near_kerbs", "corridor", "rows"]
    if is_grid:
        names += ["parked", "off_road"]
    else:
        names += ["target", "ahead", "narrow_places"]
    waits = planner.give_way or planner.reversing or planner.cost.lingering
    if not is_grid or waits or not isinstance(config.safety, NoSafetyConfig):
        names += PASSAGE
    return names
