"""Level-k reasoning (Costa-Gomes and Crawford 2006) over the horizons of both vehicles.

The perceived situation is simulated for a while, with every horizon of the ego against every one of the other, which
gives the payoffs of both. At level 0 a vehicle keeps one horizon; the belief in the other's horizon comes from its
latest motion. At level k a vehicle plays the best response to the other at level k - 1. The style and the desired
speed of the other are not known.

Axes: E worlds, A horizons of the ego, B of the other, V vehicles, O = V - 1 others, L past steps.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from negopipe.agents.driver import HorizonDriver
from negopipe.agents.driver_config import DriverConfig
from negopipe.schema import Horizon, NonNegativeFloat, PositiveFloat, PositiveInt, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import EGO, Casting, Task, VehicleState, World
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.game.game import Game

BEHIND_M = 100.0
"""Distance behind the ego at which a vehicle that is not seen is put, m."""


@schema
class Config(DriverConfig):
    """`conf/evaluation/baseline/level_k.yaml` says what each value means."""

    kind: Literal["level_k"]
    n_episodes: PositiveInt | None
    horizons_s: Annotated[tuple[Horizon, ...], Field(min_length=1)]
    level: PositiveInt
    lookahead_s: PositiveFloat
    keep_s: PositiveFloat
    collision_m: NonNegativeFloat
    courtesy: NonNegativeFloat
    lookback_s: PositiveFloat
    speed_std_mps: PositiveFloat

    is_lockstep: ClassVar[bool] = True

    @property
    def n_driven(self) -> int | None:
        return self.n_episodes

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        return {"horizons_s": self.horizons_s}

    @property
    def times_s(self) -> dict[str, float]:
        return {name: getattr(self, name) for name in ("lookahead_s", "keep_s", "lookback_s")}

    def driver(self, game: "Game", episode_key: Tensor) -> HorizonDriver:
        return HorizonDriver(LevelK(game, self), game.plan)


class LevelK:
    """Choice of a horizon every `keep_s`, in episodes that start together: a `agents.driver.ChooseHorizon`."""

    def __init__(self, game: "Game", config: Config) -> None:
        self.game, self.config = game, config
        self.horizons = torch.tensor(config.horizons_s, device=game.planner.times.device)
        self.dt_s = game.simulator.scenario.dt_s
        self._n_calls, self._kept = 0, self.horizons[:1]

    def __call__(self, perception: Perception) -> Tensor:
        if self._n_calls % self._n_steps(self.config.keep_s) == 0:
            own, other = self.payoffs(perception)
            belief = self.belief(perception, self._n_calls)
            self._kept = self.horizons[best_response(own, other, belief, self.config.level)]
        self._n_calls += 1
        return self._kept[:, None]

    def payoffs(self, perception: Perception) -> tuple[Tensor, Tensor]:
        """Payoffs of the ego and of the nearest other, [E, A, B] each, m.

        A payoff is the distance driven, at most to the target, plus that of the opponent with the weight `courtesy`,
        less the cost of a collision.
        """
        n = len(self.horizons)
        now = map_tensors(lambda a, b: torch.cat([a, b], 1), perception.own, _of_others(perception))
        world = imagined(
            self.game, now, _directions(self.game, perception), perception.desired_speed, _sizes(perception)
        )
        world = map_tensors(lambda field: field.repeat_interleave(n * n, 0), world)
        pairs = torch.cartesian_prod(self.horizons, self.horizons).repeat(len(now.speed), 1)
        horizon = torch.cat([pairs[:, :1], pairs[:, 1:].expand(-1, now.speed.shape[1] - 1)], 1)
        start = self._progress(world)
        for _ in range(self._n_steps(self.config.lookahead_s)):
            world = self.game.drive(world, horizon).world
        driven = self._progress(world) - start
        own, other = driven[:, EGO], driven[:, EGO + 1]
        crash = self.config.collision_m * world.has_collided.any(-1)
        gains = (a + self.config.courtesy * b - crash for a, b in ((own, other), (other, own)))
        own, other = (gain.unflatten(0, (-1, n, n)) for gain in gains)
        return own, other

    def belief(self, perception: Perception, n_driven: int) -> Tensor:
        """[E, B]: probabilities of the horizons of the nearest other, from its speeds in the last `lookback_s`.

        At each of these steps the planner gives a next speed for every horizon. The perceived next speed is taken as
        that speed plus a normal error.

        n_driven: steps since the start
        """
        pose, speed, accel = self._seen(perception)
        n = min(self._n_steps(self.config.lookback_s), n_driven - 3, accel.shape[1] - 1)
        n_horizons = len(self.horizons)
        if n < 1:
            return torch.full((len(pose), n_horizons), 1 / n_horizons, device=pose.device)
        past = slice(1, n + 1)
        then = VehicleState(
            pose[:, past, :, :2], pose[:, past, :, 2], speed[:, past], accel[:, past], 0 * accel[:, past]
        )
        direction, desired_speed, *size = (
            field[:, None].expand(-1, n, -1).flatten(0, 1)
            for field in (_directions(self.game, perception), perception.desired_speed, *_sizes(perception))
        )
        then = map_tensors(lambda field: field.flatten(0, 1), then)
        world = imagined(self.game, then, direction, desired_speed, (size[0], size[1]))
        agent = self.game.perceive(map_tensors(lambda field: field.repeat_interleave(n_horizons, 0), world)).of(EGO + 1)
        wanted = self.game.plan(agent, self.horizons.repeat(len(direction))[:, None]).state.speed
        error = wanted.reshape(-1, n, n_horizons) - speed[:, :n, EGO + 1, None]
        is_seen = perception.is_seen_history[:, : n + 4, 0, 0].unfold(1, 4, 1).all(-1)[:, :n]
        misfit = ((error / self.config.speed_std_mps) ** 2 * is_seen[..., None]).sum(1)
        return torch.softmax(-misfit / 2, -1)

    def _seen(self, perception: Perception) -> tuple[Tensor, Tensor, Tensor]:
        """Poses [E, K, V, 3], speeds [E, K - 2, V] (m/s) and accelerations [E, K - 3, V] (m/s2); index 0 is now.

        Speeds and accelerations are backward differences along the road.
        """
        pose = torch.cat([perception.own_history, perception.other_history[:, :, 0]], 2)
        s = self.game.simulator.road.progress(pose[..., :2], _directions(self.game, perception)[:, None])
        speed = ((3 * s[:, :-2] - 4 * s[:, 1:-1] + s[:, 2:]) / (2 * self.dt_s)).clamp(min=0)
        return pose, speed, (speed[:, :-1] - speed[:, 1:]) / self.dt_s

    def _progress(self, world: World) -> Tensor:
        """[E, V] m: s of each vehicle, at most that of its target."""
        road = self.game.simulator.road
        return road.progress(world.vehicles.position, world.task.direction).clamp(
            max=road.target_s(world.task.direction)
        )

    def _n_steps(self, time_s: float) -> int:
        return round(time_s / self.dt_s)


def best_response(own: Tensor, other: Tensor, belief: Tensor, level: int) -> Tensor:
    """[E] int64: index of the ego's horizon at `level`.

    own, other: payoffs [E, A, B]
    belief: [E, B], probabilities of the other's horizons at level 0. The other's belief in the ego's is uniform
    """
    expected = (own * _play(own, other, belief, level - 1)[:, None]).sum(-1)
    return expected.argmax(-1)


def _play(own: Tensor, other: Tensor, belief: Tensor, level: int) -> Tensor:
    """[E, B]: probabilities of the other's horizons at `level`."""
    if level == 0:
        return belief
    uniform = torch.full_like(own[:, :, 0], 1 / own.shape[1])
    best = best_response(other.transpose(1, 2), own.transpose(1, 2), uniform, level)
    return torch.nn.functional.one_hot(best, own.shape[2]).to(own.dtype)


def imagined(
    game: "Game", vehicles: VehicleState, direction: Tensor, desired_speed: Tensor, size: tuple[Tensor, Tensor]
) -> World:
    """Worlds as one vehicle assumes them: the others have the same desired speed, and no vehicle has a past.

    vehicles: VehicleState [E, V]; direction: [E, V]; desired_speed: [E, 1], m/s
    size: lengths and widths, [E, V] each, m
    """
    unknown = torch.zeros_like(direction)
    never, no = torch.full_like(direction, torch.inf), torch.zeros_like(direction[:, 0], dtype=torch.int64)
    wanted, nobody = desired_speed.expand_as(direction), Casting.of_nobody(direction)
    task = Task(unknown, wanted, wanted, unknown, unknown, never, never, direction, no, no, *size, nobody)
    return game.simulator.place(game.simulator.reset(task), vehicles)


def _of_others(perception: Perception) -> VehicleState:
    """[E, O]: the others; those that are not seen are put far behind the ego."""
    other = map_tensors(lambda field: field[:, 0], perception.other)
    away = torch.stack([perception.own.yaw.cos(), perception.own.yaw.sin()], -1)
    behind = (perception.own.position - BEHIND_M * away).expand_as(other.position)
    return replace(other, position=torch.where(perception.is_seen[:, 0, :, None], other.position, behind))


def _sizes(perception: Perception) -> tuple[Tensor, Tensor]:
    """Lengths and widths of the ego and of the others, [E, V] each, m."""
    return (
        torch.cat([perception.length, perception.other_length[:, 0]], 1),
        torch.cat([perception.width, perception.other_width[:, 0]], 1),
    )


def _directions(game: "Game", perception: Perception) -> Tensor:
    """[E, V]: driving directions of the ego and of the others, by their perceived headings."""
    return torch.cat(
        [
            perception.direction,
            game.simulator.road.direction_of(perception.other, perception.direction[..., None])[:, 0],
        ],
        1,
    )
