"""Perception: a vehicle's own state, and the others as its sensor sees them.

It is all that reaches a driver. The style, the desired speed and the plan of the others are not part of it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from negopipe.checks import Problem, check_times
from negopipe.schema import Fraction, NonNegativeFloat, NonNegativeMetres, PositiveFloat, PositiveMetres, schema
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.occlusion import Occlusion
from negopipe.simulation.road import Road
from negopipe.simulation.state import Sightings, Tracks, VehicleState, World
from negopipe.simulation.tracker import Tracker, TrackerConfig
from negopipe.tensors.stateless_rng import mix, normals, uniform
from negopipe.tensors.tree import map_tensors

LAPSES = 0x1A95E
"""Offset of the key from which lapses of attention are drawn, apart from the other draws of an episode."""


@schema
class PerceptionConfig:
    """Errors and limits of the sensor; `conf/perception/noisy.yaml` says what each value means."""

    position_std_m: NonNegativeMetres
    yaw_std_rad: NonNegativeFloat
    speed_std_mps: NonNegativeFloat
    dropout_probability: Fraction
    range_m: PositiveMetres | None
    delay_s: NonNegativeFloat
    accel_window_s: PositiveFloat
    tracker: TrackerConfig | None
    occlusion: bool

    def check(self, dt_s: float) -> Iterator[Problem]:
        times_s = {"perception.delay_s": (self.delay_s,), "perception.accel_window_s": (self.accel_window_s,)}
        yield from check_times(times_s, dt_s)
        if self.tracker is not None:
            yield from self.tracker.check(dt_s)

    def memory_steps(self, dt_s: float, history_steps: int) -> int:
        """Past states that a world must remember, for perceptions that hold `history_steps` past poses."""
        return round(self.delay_s / dt_s) + max(history_steps, round(self.accel_window_s / dt_s))


@dataclass(frozen=True)
class Perception:
    """Perception of S agents (vehicles that are driven) in E worlds, each of which sees O = V - 1 others.

    own: VehicleState [E, S], state of the vehicle in its own plan (the reference of the tracking controller)
    direction: [E, S] float32, own driving direction along the road, +1 or -1
    desired_speed: [E, S] float32, m/s
    style_horizon: [E, S] float32, s, own driving style, the one in force now; NaN where the driver chooses
    driver: [E, S] int64, index of the own driver in the population; `NOBODY` without one
    last_horizon: [E, S] float32, s, own prediction horizon of the step before; NaN without one (`World.last_horizon`)
    rest_steps: [E, S] int64, control steps for which the vehicle itself has been at rest (`World.rest_steps`)
    length, width: [E, S] float32, m, of the own footprint
    other: VehicleState [E, S, O], as sighted or tracked; acceleration from the speeds of the last steps, curvature 0
    other_length, other_width: [E, S, O] float32, m, of the others' footprints, which a sensor measures without error
    is_seen: [E, S, O] bool, sighted or tracked; where false, the fields of `other` are 0 and mean nothing
    own_history: [E, K, S, 3] float32, own poses x, y, yaw (m, m, rad; world), index 0 now, one step apart
    other_history: [E, K, S, O, 3] float32, poses of the others
    is_seen_history: [E, K, S, O] bool; where false, `other_history` is 0 and means nothing
    """

    own: VehicleState
    direction: Tensor
    desired_speed: Tensor
    style_horizon: Tensor
    driver: Tensor
    last_horizon: Tensor
    rest_steps: Tensor
    length: Tensor
    width: Tensor
    other: VehicleState
    other_length: Tensor
    other_width: Tensor
    is_seen: Tensor
    own_history: Tensor
    other_history: Tensor
    is_seen_history: Tensor

    def of(self, agent: int) -> "Perception":
        """The perception of one agent, S = 1."""
        return self.of_agents([agent])

    def of_each(self, agent: Tensor) -> "Perception":
        """The perception of one agent in each world, S = 1; agent: [E] int64."""
        row = torch.arange(len(agent), device=agent.device)
        return self._picked(lambda field: field[row, agent][:, None], lambda field: field[row, :, agent][:, :, None])

    def of_agents(self, agents: list[int]) -> "Perception":
        """The perception of some agents, in the order given."""
        if agents == list(range(self.direction.shape[1])):
            return self

        def pick(field: Tensor, axis: int) -> Tensor:
            return torch.stack([field.select(axis, agent) for agent in agents], axis)

        return self._picked(partial(pick, axis=1), partial(pick, axis=2))

    def _picked(self, pick: Callable[[Tensor], Tensor], pick_past: Callable[[Tensor], Tensor]) -> "Perception":
        """The perception with some agents; pick: of fields [E, S, ...], pick_past: of fields [E, K, S, ...]."""
        return Perception(
            own=map_tensors(pick, self.own),
            direction=pick(self.direction),
            desired_speed=pick(self.desired_speed),
            style_horizon=pick(self.style_horizon),
            driver=pick(self.driver),
            last_horizon=pick(self.last_horizon),
            rest_steps=pick(self.rest_steps),
            length=pick(self.length),
            width=pick(self.width),
            other=map_tensors(pick, self.other),
            other_length=pick(self.other_length),
            other_width=pick(self.other_width),
            is_seen=pick(self.is_seen),
            own_history=pick_past(self.own_history),
            other_history=pick_past(self.other_history),
            is_seen_history=pick_past(self.is_seen_history),
        )


class Sensor:
    """Sensor of every vehicle: the others with errors, itself without.

    The errors of a sighting are a function of the task's noise seed, the step of the episode in which it was taken, the
    viewer and the vehicle seen. A sighting is therefore the same at every later step. The sensor has no state: with a
    tracker the world holds the tracks.

    history_steps: past poses in a perception beside the latest
    memory_steps: past states that a world must keep for that
    is_attentive: no driver of the population reacts late or lapses
    lowest_speed_mps: lowest speed of a vehicle; measured speeds are no lower
    """

    def __init__(
        self,
        config: PerceptionConfig,
        road: Road,
        dt_s: float,
        history_steps: int,
        is_attentive: bool = True,
        lowest_speed_mps: float = 0.0,
    ) -> None:
        self.config, self._is_attentive, self._lowest_speed = config, is_attentive, lowest_speed_mps
        self.history_steps = history_steps
        self._delay = round(config.delay_s / dt_s)
        self._window = round(config.accel_window_s / dt_s)
        self._window_s = self._window * dt_s
        self._n_sightings = 1 + max(history_steps, self._window)
        self.memory_steps = config.memory_steps(dt_s, history_steps)
        stds = (config.position_std_m, config.yaw_std_rad, config.speed_std_mps)
        self._is_noisy = any(std > 0 for std in stds)
        self._occlusion = Occlusion(road) if config.occlusion else None
        self._sees_all = config.dropout_probability == 0 and config.range_m is None and not config.occlusion
        self._tracker, self._dt_s = None, dt_s
        if config.tracker is not None:
            variances = (config.position_std_m**2, config.yaw_std_rad**2, config.speed_std_mps**2)
            self._tracker = Tracker(config.tracker, dt_s, variances, lowest_speed_mps)

    def perceive(self, world: World) -> Perception:
        """Perception of all vehicles, S = V."""
        task = world.task
        seen = self._seen(world)
        pose, speed, before, is_seen = self._attended(world, seen)
        accel = (speed - before) / self._window_s
        if not self._sees_all:
            accel = torch.where(seen.is_seen[:, 0] & seen.is_seen[:, self._window], accel, 0.0)
        n_frames = 1 + self.history_steps
        others = other_columns(task.length.shape[1], task.length.device)
        return Perception(
            own=world.reference,
            direction=task.direction,
            desired_speed=task.desired_speed,
            style_horizon=world.style_horizon,
            driver=task.casting.driver,
            last_horizon=world.last_horizon,
            rest_steps=world.rest_steps,
            length=task.length,
            width=task.width,
            other=VehicleState(pose[..., :2], pose[..., 2], speed, accel, torch.zeros_like(accel)),
            other_length=task.length[:, others],
            other_width=task.width[:, others],
            is_seen=is_seen,
            own_history=world.pose_history[:, :n_frames],
            other_history=seen.pose[:, :n_frames],
            is_seen_history=seen.is_seen[:, :n_frames],
        )

    def _attended(self, world: World, seen: Sightings) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the drivers go by: poses [E, V, O, 3], speeds [E, V, O] now and `accel_window_s` before, who is seen.

        A driver that reacts late goes by what it saw then. One that lapses sees nobody for a whole second. The past
        that observations show is not touched: late and lapsing drivers follow a planner and use no observation.
        """
        if self._is_attentive:
            return seen.pose[:, 0], seen.speed[:, 0], seen.speed[:, self._window], seen.is_seen[:, 0]
        casting = world.task.casting
        late = casting.reaction_steps[:, None, :, None].expand(-1, 1, -1, seen.speed.shape[-1])
        pose = seen.pose.gather(1, late[..., None].expand(-1, -1, -1, -1, 3))[:, 0]
        speed, before = (seen.speed.gather(1, late + steps)[:, 0] for steps in (0, self._window))
        second = (world.step * self._dt_s + 1e-3).long()[:, None]
        vehicle = torch.arange(late.shape[2], device=late.device)
        key = mix(mix(world.task.noise_seed)[:, None] + vehicle) + LAPSES
        lapses = uniform(key, second) < casting.lapse_share
        return pose, speed, before, seen.is_seen.gather(1, late)[:, 0] & ~lapses[..., None]

    def first_tracks(self, world: World) -> Tracks:
        """Tracks of a world whose vehicles have been where they are for as long as it remembers."""
        if self._tracker is None:
            return world.tracks
        return self._tracker.start(self._sightings(world, self._delay, 1), self._age_s(world), self._n_sightings)

    def next_tracks(self, world: World) -> Tracks:
        """Tracks of a world that still holds those of the step before.

        At the start of an episode the sighting of its first state is the newest one until `delay_s` has passed.
        """
        if self._tracker is None:
            return world.tracks
        latest, is_new = self._sightings(world, self._delay, 1), world.step > self._delay
        return self._tracker.follow(world.tracks, latest, is_new, self._age_s(world))

    def _age_s(self, world: World) -> Tensor:
        """[E] float32, s: age of the newest sightings."""
        return world.step.clamp(max=self._delay).float() * self._dt_s

    def _seen(self, world: World) -> Sightings:
        """The others in the last steps: as they were tracked then, else as their sightings are."""
        if self._tracker is not None:
            return world.tracks.history
        seen = self._sightings(world, self._delay, self._n_sightings)
        return replace(seen, speed=seen.speed.clamp(min=self._lowest_speed)) if self._is_noisy else seen

    def _sightings(self, world: World, ago: int, n: int) -> Sightings:
        """Sightings taken `ago` steps ago and at the n - 1 steps before: the true states with errors.

        Measured speeds may be lower than any vehicle drives.
        """
        steps = slice(ago, ago + n)
        pose, speed = world.pose_history[:, steps], world.speed_history[:, steps]
        others = other_columns(speed.shape[-1], speed.device)
        seen = Sightings(pose[:, :, others], speed[:, :, others], torch.ones_like(others, dtype=torch.bool))
        if self._sees_all and not self._is_noisy:
            return replace(seen, is_seen=seen.is_seen.expand_as(seen.speed))
        key = self._keys(world, others, torch.arange(ago, ago + n, device=others.device))
        is_seen = self._is_seen(key, pose, seen)
        if self._occlusion is not None:
            is_seen = is_seen & self._occlusion.is_visible(pose, others, world.task)
        if self._is_noisy:
            seen = self._with_errors(key, seen)
        return Sightings(
            torch.where(is_seen[..., None], seen.pose, 0.0), torch.where(is_seen, seen.speed, 0.0), is_seen
        )

    def _keys(self, world: World, others: Tensor, ago: Tensor) -> Tensor:
        """[E, J, V, O] int64: random key of each sighting, taken `ago` [J] steps ago, the same at every later step."""
        taken = (world.step[:, None] - ago).clamp(min=0)  # before the start the first state is repeated
        viewer = torch.arange(len(others), device=others.device)[:, None]
        key = mix(mix(world.task.noise_seed)[:, None] + taken)
        return mix(mix(key[..., None, None] + viewer) + others)

    def _is_seen(self, key: Tensor, pose: Tensor, seen: Sightings) -> Tensor:
        """[E, J, V, O] bool: within range of the viewer's true pose [E, J, V, 3], and not dropped."""
        config = self.config
        is_seen = uniform(key, channel=4) >= config.dropout_probability
        if config.range_m is not None:
            away = seen.pose[..., :2] - pose[..., None, :2]
            is_seen = is_seen & (away.square().sum(-1) <= config.range_m**2)
        return is_seen

    def _with_errors(self, key: Tensor, seen: Sightings) -> Sightings:
        config = self.config
        x, y = normals(key, channel=0)
        yaw, speed = normals(key, channel=2)
        true_x, true_y, true_yaw = seen.pose.unbind(-1)
        pose = torch.stack(
            [
                true_x + config.position_std_m * x,
                true_y + config.position_std_m * y,
                wrap_angle(true_yaw + config.yaw_std_rad * yaw),
            ],
            dim=-1,
        )
        return replace(seen, pose=pose, speed=seen.speed + config.speed_std_mps * speed)


def other_columns(n_vehicles: int, device: torch.device | str = "cpu") -> Tensor:
    """[V, V-1] int64: for each vehicle the columns of all others, in order."""
    column = torch.arange(n_vehicles - 1, device=device)
    viewer = torch.arange(n_vehicles, device=device)[:, None]
    return column + (column >= viewer)
