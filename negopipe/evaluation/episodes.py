"""Evaluation episodes: driving them to the end and recording them."""

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from negopipe.agents.driver import Driver, HorizonDriver, MakeDriver, drive_together, given_horizon
from negopipe.agents.drivers import BaselineConfig
from negopipe.checks import Foresight, Memory, Problem, check_names
from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.trace import ADAPTIVE, EPISODE_AXIS, ORACLE, OUTCOMES, Trace, trace_bytes
from negopipe.game.game import Driven, Game
from negopipe.game.reward import RewardConfig, reward
from negopipe.schema import Distinct, FileName, PathText, PositiveInt, Seed, schema
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.simulator import Events
from negopipe.simulation.state import AT_REST_MPS, EGO, Motion, Task, World
from negopipe.tensors.tree import map_tensors, tree_where

DEADLOCK_S = 5.0
"""Time at rest, nose to nose, that makes a timeout a deadlock (docs/reading.md, "deadlock")."""


@schema
class EvaluationConfig:
    """`conf/evaluation/push_yield.yaml` says what each value means."""

    settings: Annotated[list[str], Field(min_length=1), Distinct]
    leading_setting: str
    n_episodes: PositiveInt
    n_traced: PositiveInt
    n_worlds: PositiveInt
    task_seed: Seed
    baselines: dict[FileName, BaselineConfig]
    oracle: PathText | None
    action: Literal["greedy", "sample"]
    reward: RewardConfig

    def check(self, scenario: ScenarioConfig, foresight: Foresight) -> Iterator[Problem]:
        """foresight: of the planner."""
        for name, who in {ADAPTIVE: "the policy", ORACLE: "the planner that evaluation.oracle brings"}.items():
            if name in self.baselines:
                yield Problem("evaluation.baselines", f"not have the name of {who}", name)
        yield from check_names("evaluation.settings", self.settings, scenario.families, "scenario.families")
        leading = [self.leading_setting]
        yield from check_names("evaluation.leading_setting", leading, self.settings, "evaluation.settings")
        for name, baseline in self.baselines.items():
            yield from baseline.check(f"evaluation.baselines.{name}", scenario.dt_s, foresight)

    def memory(self, scenario: ScenarioConfig) -> Memory:
        """Memory of the traces of all planners in all settings."""
        n_driven = self.n_episodes * len(self.settings) * (1 + len(self.baselines))
        keys = "evaluation.n_episodes evaluation.settings evaluation.baselines scenario.episode_steps scenario.n_social"
        keys += " scenario.n_followers"
        n_bytes = trace_bytes(n_driven, scenario.episode_steps, scenario.n_vehicles)
        return Memory("the evaluation", n_bytes, tuple(keys.split()))

    @property
    def fixed_horizons_s(self) -> FixedHorizons:
        """Horizon of each baseline that has a fixed one."""
        fixed = {name: baseline.fixed_horizon_s for name, baseline in self.baselines.items()}
        return {name: horizon_s for name, horizon_s in fixed.items() if horizon_s is not None}


Seats = Mapping[int, Driver]
"""Drivers by the vehicles that they drive; the population drives the others, and the ego as its task says."""


def by_cast(episode_key: Tensor) -> None:
    """No driver beside the population's: one of these drives the ego, as its task says."""


def drive_episodes(
    game: Game,
    make_ego: MakeDriver | Callable[[Tensor], None],
    tasks: Task,
    n_worlds: int,
    reward_config: RewardConfig,
    names: tuple[str, str],
    is_lockstep: bool = False,
) -> Trace:
    """Drive all `tasks` with the ego's driver, `n_worlds` at a time.

    Outcomes do not depend on `n_worlds`, since worlds do not interact.

    make_ego: driver of the ego; `by_cast` = the driver that its task names
    reward_config: reward of the record, which may differ from the reward of the training
    names: (planner, setting) of the record
    is_lockstep: the driver decides in all worlds of a batch, also in those whose episode is over; else in the running
        ones only, which saves time
    """
    batches = [
        map_tensors(lambda field, i=first: field[i : i + n_worlds], tasks) for first in range(0, len(tasks), n_worlds)
    ]
    parts = [_record(game, _seats(make_ego(batch.noise_seed)), batch, reward_config, is_lockstep) for batch in batches]
    joined = {name: np.concatenate([part[name] for part in parts], axis=EPISODE_AXIS[name]) for name in parts[0]}
    return Trace(planner=names[0], setting=names[1], dt_s=game.simulator.scenario.dt_s, **joined)


def drive_seats(game: Game, seats: Seats, tasks: Task, reward_config: RewardConfig, names: tuple[str, str]) -> Trace:
    """Drive all `tasks` at once and in lockstep with drivers in some seats; the rest is as for `drive_episodes`."""
    record = _record(game, seats, tasks, reward_config, is_lockstep=True)
    return Trace(planner=names[0], setting=names[1], dt_s=game.simulator.scenario.dt_s, **record)


def warm_up(game: Game, make_ego: MakeDriver | Callable[[Tensor], None], tasks: Task) -> None:
    """Make a first decision of all drivers in `tasks`, which compiles everything that driving needs."""
    decide(game, _seats(make_ego(tasks.noise_seed)), game.simulator.reset(tasks))


def _seats(ego: Driver | None) -> Seats:
    return {} if ego is None else {EGO: ego}


def decide(game: Game, seats: Seats, world: World) -> Driven:
    """One decision of the drivers in `seats` and of the population's in the rest."""
    horizons = game.choose(world, torch.full_like(world.step, torch.nan, dtype=torch.float32))
    perception = game.perceive(world)
    drivers = [seats.get(v, HorizonDriver(given_horizon(h), game.plan)) for v, h in enumerate(horizons.split(1, 1))]
    planned = [driver for driver in drivers if isinstance(driver, HorizonDriver) and driver.plan == game.plan]
    if len(planned) == len(drivers):  # as in training, so that nothing else has to be compiled
        chosen = [driver.choose_horizon(perception.of(vehicle)) for vehicle, driver in enumerate(planned)]
        return game.drive(world, torch.cat(chosen, 1))
    world, motion, intervention = game.guard(world, perception, drive_together(drivers, perception))
    return Driven(*game.step(world, motion), motion, intervention)


def _record(
    game: Game, seats: Seats, tasks: Task, reward_config: RewardConfig, is_lockstep: bool
) -> dict[str, np.ndarray]:
    """Fields of `Trace`."""
    world = game.simulator.reset(tasks)
    everyone = torch.arange(len(tasks), device=tasks.family.device)
    is_running = torch.ones_like(everyone, dtype=torch.bool)
    states, decisions = [_state_row(game, world)], []
    is_success = is_collision = ~is_running
    for _ in range(game.simulator.scenario.episode_steps):
        which = everyone if is_lockstep else is_running.nonzero()[:, 0]
        world, events, decision = _decide_in(game, seats, world, which, is_running[which], reward_config)
        states.append(_state_row(game, world))
        decisions.append({name: _scatter(field, which, len(tasks)) for name, field in decision.items()})
        ended = map_tensors(lambda field, at=which: _scatter(field, at, len(tasks)), events)
        is_success, is_collision = is_success | ended.is_success, is_collision | ended.is_collision
        is_running = is_running & ~(ended.is_terminated | ended.is_truncated)
        if not is_running.any():
            break
    n_missing = game.simulator.scenario.episode_steps - len(decisions)
    rows = _stack(states, n_missing) | _stack(decisions, 0)
    rows |= {name: _pad(rows[name], n_missing) for name in decisions[0]}
    is_deadlock = stands_nose_to_nose(rows["speed_mps"], world, game)
    outcome = torch.where(is_deadlock, OUTCOMES.index("deadlock"), OUTCOMES.index("timeout"))
    outcome = torch.where(is_collision, OUTCOMES.index("collision"), outcome)
    outcome = torch.where(is_success, OUTCOMES.index("success"), outcome)
    has_social_collided = world.has_collided[:, EGO + 1 :].any(-1) & ~is_collision
    rows["outcome"] = torch.where(has_social_collided, OUTCOMES.index("social_collision"), outcome)
    rows["n_steps"] = world.step
    rows["reached_step"] = _first_time(rows.pop("has_reached"))
    way = tasks.direction[:, EGO]
    rows |= {"street": way.abs().long(), "corridor_m": torch.ones_like(way) * game.simulator.road.corridor_m(way)}
    rows |= {"start_distance_m": tasks.start_distance, "style_horizon_s": tasks.style_horizon}
    rows |= {"length_m": tasks.length, "width_m": tasks.width}
    driver = game.cast.named(tasks.casting.driver)
    return {name: value.cpu().numpy() for name, value in rows.items()} | {"driver": driver}


def _decide_in(
    game: Game, seats: Seats, world: World, which: Tensor, is_running: Tensor, reward_config: RewardConfig
) -> tuple[World, Events, dict[str, Tensor]]:
    """One decision in the worlds `which` [R]; those that are not running [R] stay unchanged.

    Returns all worlds, and the events and the row of the decision of those R.
    """
    before = map_tensors(lambda field: field.index_select(0, which), world)
    moved, events, motion, intervention = decide(game, seats, before)
    moved = tree_where(is_running, moved, before)
    world = map_tensors(lambda field, new: field.index_copy(0, which, new), world, moved)
    events = map_tensors(lambda field: field & is_running, events)
    row = _decision_row(motion, events, reward_config, is_running)
    return world, events, row | {"intervention": torch.where(is_running, intervention, 0).to(torch.int8)}


def _scatter(field: Tensor, which: Tensor, n: int) -> Tensor:
    """[R, ...] as rows `which` of [n, ...]; the other rows are NaN for a horizon, else zero."""
    empty = torch.nan if field.dim() > 1 and field.is_floating_point() else 0
    return torch.full((n, *field.shape[1:]), empty, dtype=field.dtype, device=field.device).index_copy(0, which, field)


def _state_row(game: Game, world: World) -> dict[str, Tensor]:
    vehicles = world.vehicles
    return {
        "position_m": vehicles.position,
        "yaw_rad": vehicles.yaw,
        "speed_mps": vehicles.speed,
        "progress_m": game.simulator.road.progress(vehicles.position, world.task.direction),
        "has_reached": world.has_reached,
    }


def _decision_row(motion: Motion, events: Events, reward_config: RewardConfig, is_running: Tensor) -> dict[str, Tensor]:
    paid = reward(reward_config, events.is_collision, events.is_success)
    return {
        "horizon_s": torch.where(is_running[:, None], motion.horizon, torch.nan),
        "is_full_braking": motion.is_full_braking & is_running[:, None],
        "reward": torch.where(is_running, paid, 0.0),
    }


def _stack(rows: list[dict[str, Tensor]], n_repeat: int) -> dict[str, Tensor]:
    return {name: torch.stack([row[name] for row in rows + [rows[-1]] * n_repeat]) for name in rows[0]}


def _pad(decisions: Tensor, n_missing: int) -> Tensor:
    """Append decisions after the last one: no horizon, no braking, no reward."""
    empty = torch.nan if decisions.dim() == 3 and decisions.is_floating_point() else 0
    filling = torch.full((n_missing, *decisions.shape[1:]), empty, dtype=decisions.dtype, device=decisions.device)
    return torch.cat([decisions, filling])


def stands_nose_to_nose(speed: Tensor, world: World, game: Game) -> Tensor:
    """[E] bool: at the end the ego and an oncoming vehicle that it has not passed have been at rest for 5 s.

    speed: [T, E, V] m/s, until the end; world: at the end
    """
    n_steps = round(DEADLOCK_S / game.simulator.scenario.dt_s)
    is_at_rest = (speed[-n_steps:].abs() < AT_REST_MPS).all(0)
    s = game.simulator.road.progress(world.vehicles.position, world.task.direction[:, :1])
    is_ahead = s > s[:, :1]
    social = is_at_rest & is_ahead & (world.task.direction != world.task.direction[:, :1])
    return is_at_rest[:, EGO] & social.any(-1)


def _first_time(has_reached: Tensor) -> Tensor:
    """[T+1, E, V] bool -> [E, V] int64, the first true index, -1 where none is true."""
    return torch.where(has_reached.any(0), has_reached.int().argmax(0), -1)
