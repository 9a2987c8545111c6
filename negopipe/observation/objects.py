"""The agent, the other road users and the street ahead as a row of numbers, each about 1 in size.

All places are relative to the agent: along its own route from where it is, and from the mouths of the narrow place in
which it is or to which it comes next. A vehicle knows of the others what it perceives, and nothing else. What it does
not know is 0, beside a number that says so.

Axes here: E worlds, F frames, O others, N others that are described, K points of the street.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Memory, Observed
from negopipe.observation.frames import FramesConfig
from negopipe.observation.street_ahead import N_FEATURES, StreetAhead
from negopipe.schema import NonNegativeMetres, PositiveFloat, PositiveInt, PositiveMetres, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.state import VehicleState
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.materialize import materialize
from negopipe.tensors.row_blocks import Elements, RowBlocks
from negopipe.tensors.tree import map_tensors

OWN = 17
"""Numbers of the agent beside its past places."""

PER_FRAME = 3
"""Numbers of another in each frame: whether it was seen, its way to its mouth, its offset from the line."""

PER_OTHER = 15
"""Numbers of another beside those of its frames."""


@schema
class ScalesConfig:
    """Sizes that become 1; `conf/observation/objects.yaml` says what each value means."""

    distance_m: PositiveMetres
    width_m: PositiveMetres
    speed_mps: PositiveFloat
    accel_mps2: PositiveFloat
    heading_rad: PositiveFloat
    curvature_1pm: PositiveFloat
    time_s: PositiveFloat
    largest: PositiveFloat


@schema
class ObjectsConfig(FramesConfig):
    """`conf/observation/objects.yaml` says what each value means."""

    kind: Literal["objects"]
    n_others: PositiveInt
    n_points: PositiveInt
    behind_m: NonNegativeMetres
    ahead_m: PositiveMetres
    scales: ScalesConfig

    @property
    def layout(self) -> RowBlocks:
        """Blocks of one observation."""
        n_past = self.n_frames - 1
        return RowBlocks(
            own=OWN + n_past,
            others=Elements(self.n_others, PER_OTHER + PER_FRAME * self.n_frames),
            street=Elements(self.n_points, 1 + N_FEATURES),
        )

    @property
    def shape(self) -> tuple[int]:
        """Numbers of one observation."""
        return (self.layout.n_numbers,)

    @property
    def observed(self) -> Observed:
        """Size of one observation in float32."""
        n_numbers = self.layout.n_numbers
        keys = ("observation.n_others", "observation.n_frames", "observation.n_points")
        return Observed(n_numbers, n_numbers * FLOAT_BYTES, keys)

    def memory(self, n_boxes: int, n_worlds: int) -> Memory:
        """Memory of describing `n_worlds` worlds; the boxes are those of the vehicles and parked cars of a world."""
        n_numbers = n_worlds * (self.layout.n_numbers + self.n_frames * n_boxes)
        keys = (*self.observed.keys, "scenario.n_social", "scenario.road.n_parked_per_side")
        return Memory("the description of objects", n_numbers * FLOAT_BYTES * N_TEMPORARIES, keys)


class _Place(NamedTuple):
    """Where the agents of E worlds are.

    pose: [E, 3], x, y, yaw (m, m, rad; world)
    route: RouteState [E]
    direction, first, last: [E], way along the street; first and last s (m) of the agent's narrow place
    """

    pose: Tensor
    route: RouteState
    direction: Tensor
    first: Tensor
    last: Tensor


class Objects:
    """Rows of numbers of one agent in each of E worlds.

    passage: stretches of the road in which vehicles cannot pass each other
    """

    def __init__(self, config: ObjectsConfig, passage: Passage, dt_s: float) -> None:
        self.config, self.passage, self._dt_s = config, passage, dt_s
        self.road: Road = passage.road
        self.shape = config.shape
        self._stride = config.frame_stride(dt_s)
        self._street = StreetAhead(self.road, passage)
        by = config.scales
        self._scale = torch.tensor([by.width_m, by.width_m, by.curvature_1pm, 1.0, 1.0], device=self.road.device)
        self._points = torch.linspace(-config.behind_m, config.ahead_m, config.n_points, device=self.road.device)

    def draw(self, perception: Perception) -> Tensor:
        """[E, numbers] float32, blocks as in `ObjectsConfig.layout`.

        perception: of one agent, S = 1
        """
        own, direction = map_tensors(lambda field: field[:, 0], perception.own), perception.direction[:, 0]
        route = RouteState(*materialize(*self.road.to_route(own, direction)))
        pose = torch.cat([own.position, own.yaw[:, None]], -1)
        place = _Place(pose, route, direction, *self.road.narrow_place(route.s, direction))
        others = self._nearest(*self._others(perception, place))
        blocks = (self._own(perception, own, place), others.flatten(1), self._ahead(place).flatten(1))
        return torch.cat(blocks, -1).clamp(-self.config.scales.largest, self.config.scales.largest)

    def _own(self, perception: Perception, own: VehicleState, place: _Place) -> Tensor:
        """[E, OWN + F - 1]: the agent itself; the last F - 1 are its ways since the past frames."""
        by, road, passage = self.config.scales, self.road, self.passage
        s, direction = place.route.s, place.direction
        offset, slope, _ = road.route_offset(s, direction)
        rest_s = perception.rest_steps[:, 0] * self._dt_s
        length, width = perception.length[:, 0], perception.width[:, 0]
        to_places = (
            place.first,
            place.last,
            passage.waiting_s(s, direction, length),
            passage.leaving_s(s, direction, length),
            s.new_zeros(()) + road.target_s(direction),
        )
        features = [
            own.speed / by.speed_mps,
            own.accel / by.accel_mps2,
            perception.desired_speed[:, 0] / by.speed_mps,
            (place.route.d - offset) / by.width_m,
            (place.route.d_prime - slope) / by.heading_rad,
            own.curvature / by.curvature_1pm,
            *((at - s) / by.distance_m for at in to_places),
            *self._horizon(perception.last_horizon[:, 0]),
            rest_s / (rest_s + by.time_s),
            length / by.width_m,
            width / by.width_m,
        ]
        past = perception.own_history[:, self._stride : self._n_past : self._stride, 0, :2]
        driven = (s[:, None] - road.progress(past, direction[:, None])) / by.distance_m
        return torch.cat([torch.stack(features, -1), driven], -1)

    def _horizon(self, horizon: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A prediction horizon [E] (s): whether there is one, whether it is infinite, else its size; [E] each."""
        is_finite = horizon.isfinite()
        size = torch.where(is_finite, horizon, 0.0) / self.config.scales.time_s
        return (~horizon.isnan()).float(), horizon.isinf().float(), size

    def _others(self, perception: Perception, place: _Place) -> tuple[Tensor, Tensor]:
        """All others, as the agent perceives them, [E, O, PER_OTHER + PER_FRAME F].

        Returns as well how far away along the road they were when last seen, [E, O] m, inf where they are not known.
        """
        by, road, way = self.config.scales, self.road, place.direction[:, None]
        pose = perception.other_history[:, : self._n_past : self._stride, 0]  # [E, F, O, 3]
        is_seen = perception.is_seen_history[:, : self._n_past : self._stride, 0]
        line, sign = road.line(way[..., None]), road.sign(way)
        sigma, d = line.project(pose[..., 0], pose[..., 1])
        heading = torch.cos(pose[..., 2] - line.heading(sigma)) * sign[..., None]
        s = sign[..., None] * sigma + road.corridor_m(way[..., None]) / 2  # [E, F, O], along the agent's route
        newest = is_seen.float().argmax(1, keepdim=True)  # [E, 1, O], the latest frame in which it was seen
        is_oncoming = heading.gather(1, newest)[:, 0] < 0
        first, last = place.first[:, None], place.last[:, None]
        to_mouth = torch.where(is_oncoming[:, None], s - last[:, None], first[:, None] - s)
        offset = sign[..., None] * d - place.route.d[:, None, None]
        frames = torch.stack([torch.ones_like(s), to_mouth / by.distance_m, offset / by.width_m], -1)
        frames = torch.where(is_seen[..., None], frames, 0.0).transpose(1, 2).flatten(2)  # [E, O, 3 F]
        now = torch.stack(self._now(perception, place, pose[:, 0], s[:, 0], is_oncoming), -1)
        now = torch.where(is_seen[:, 0, :, None], now, 0.0)
        is_known = is_seen.any(1)
        known = torch.stack([is_known.float(), (is_known & is_oncoming).float(), self._unseen(perception)], -1)
        apart = (s.gather(1, newest)[:, 0] - place.route.s[:, None]).abs()
        described = torch.cat([torch.where(is_known[..., None], known, 0.0), now, frames], -1)
        return described, torch.where(is_known, apart, torch.inf)

    def _now(self, perception: Perception, place: _Place, pose: Tensor, s: Tensor, is_oncoming: Tensor) -> list[Tensor]:
        """[E, O] each: the others now, at poses [E, O, 3] and places s [E, O] (m) along the agent's route."""
        by, own_s, way = self.config.scales, place.route.s[:, None], place.direction[:, None]
        corridor, passage = self.road.corridor_m(way), self.passage
        length, width = perception.other_length[:, 0], perception.other_width[:, 0]
        ends = [
            torch.where(is_oncoming, their(own_s, way, length) - corridor + s, own(own_s, way, length) - s)
            for own, their in (
                (passage.waiting_s, passage.their_waiting_s),
                (passage.leaving_s, passage.their_leaving_s),
            )
        ]
        to_end = torch.where(is_oncoming, s - place.first[:, None], place.last[:, None] - s)
        dx, dy = pose[..., 0] - place.pose[:, :1], pose[..., 1] - place.pose[:, 1:2]
        cos, sin = torch.cos(place.pose[:, 2:]), torch.sin(place.pose[:, 2:])
        turned = pose[..., 2] - place.pose[:, 2:]
        other = map_tensors(lambda field: field[:, 0], perception.other)
        return [
            *((each / by.distance_m) for each in (*ends, to_end, s - own_s, dx * cos + dy * sin)),
            (dy * cos - dx * sin) / by.width_m,
            torch.cos(turned),
            torch.sin(turned) / by.heading_rad,
            other.speed / by.speed_mps,
            other.accel / by.accel_mps2,
            length / by.width_m,
            width / by.width_m,
        ]

    def _unseen(self, perception: Perception) -> Tensor:
        """[E, O]: time since each of the others was seen; as long as the agent remembers where it was not."""
        is_seen = perception.is_seen_history[:, :, 0]
        steps = torch.where(is_seen.any(1), is_seen.float().argmax(1), is_seen.shape[1])
        return steps * (self._dt_s / self.config.scales.time_s)

    def _nearest(self, others: Tensor, apart: Tensor) -> Tensor:
        """[E, N, width]: the nearest of the others [E, O, width], by `apart` [E, O] (m); or all of them, and zeros."""
        n_missing = self.config.n_others - others.shape[1]
        if n_missing >= 0:
            return torch.nn.functional.pad(others, (0, 0, 0, n_missing))
        index = apart.topk(self.config.n_others, largest=False).indices
        return others.gather(1, index[..., None].expand(-1, -1, others.shape[-1]))

    def _ahead(self, place: _Place) -> Tensor:
        """[E, K, 1 + N_FEATURES]: points of the street, each with its distance ahead."""
        by = self.config.scales
        features = self._street.at(place.route.s[:, None] + self._points, place.direction[:, None])
        ahead = (self._points / by.distance_m).expand(len(features), -1)[..., None]
        return torch.cat([ahead, features / self._scale], -1)

    @property
    def _n_past(self) -> int:
        """Steps of the past up to the oldest frame, with now."""
        return 1 + self.config.history_steps(self._dt_s)
