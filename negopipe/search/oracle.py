"""The oracle: the best sequence of prediction horizons of each task that a search with full knowledge finds.

An episode is a function of its task and of the ego's horizons, so a search can roll it out with the true social
drivers any number of times. Its result is the reference of a planner's regret. The search starts with all sequences of
up to two switches at a grid of times, since early commitment is decisive and "wait, then push" is hard to reach by
small changes. It continues by hill climbing from the best of them: every round changes the best sequence of each task
at random and keeps the best. The result is not proven optimal; the gain of a doubled budget is measured instead
(`negopipe.stages.oracle`).

Axes: N tasks, C candidates per task and round, R sequences that are rolled out together, T decisions.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import torch
from pydantic import Field
from torch import Generator, Tensor

from negopipe.checks import N_COPIES, Memory, Problem, check_names
from negopipe.game.game import Game
from negopipe.game.reward import RewardConfig, reward
from negopipe.schema import Distinct, PositiveInt, schema
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.state import Task, World
from negopipe.tensors.tree import map_tensors, tree_where

SHIFT_CHANCE = 0.3
"""Probability that a candidate has its later decisions moved in time, beside the pieces that are overwritten."""
MAX_SHIFT_STEPS = 3
SWITCH_STEPS = range(4, 48, 4)
"""Steps of the switch in sequences with one switch: every 0.8 s until both vehicles could have passed."""
SWITCH_PAIRS = tuple(combinations(range(8, 48, 8), 2))
"""Steps of the switches in sequences with two: every 1.6 s."""
SECOND_PIECE_CHANCE = 0.5
BORROWED_CHANCE = 0.3
"""Probability that a candidate starts from the best sequence of a similar task, which often helps."""
N_ALIKE = 8
"""Number of most similar tasks that a task borrows sequences from."""
ACTION_BYTES = 8
SAME_REWARD = 1e-6
NEVER_S = 100.0
DRIVER_M = 100.0
"""Distance of two drivers in the similarity of tasks, so that tasks with one driver are similar."""
STYLE_M_PER_S = 10.0
"""Weight of a style against start distances in the similarity of tasks: 0.1 s of a style counts as 1 m, so that tasks
of one style are similar."""


@schema
class OracleConfig:
    """`conf/oracle/search.yaml` says what each value means."""

    settings: Annotated[list[str], Field(min_length=1), Distinct]
    n_episodes: PositiveInt
    population: PositiveInt
    rounds: PositiveInt

    def check(self, scenario: ScenarioConfig, n_evaluated: int, paid: RewardConfig) -> Iterator[Problem]:
        """n_evaluated: tasks of the evaluation, the first of which are searched; paid: what the search maximises."""
        yield from check_names("oracle.settings", self.settings, scenario.families, "scenario.families")
        if self.n_episodes > n_evaluated:
            rule = f"be at most evaluation.n_episodes = {n_evaluated}"
            yield Problem("oracle.n_episodes", rule, self.n_episodes)
        yield from paid.check_searchable("evaluation.reward", "the stage oracle")

    def memory(self, n_actions: int, episode_steps: int) -> Memory:
        """Memory of the sequences that are tried for all tasks of a setting."""
        keys = ("oracle.n_episodes", "oracle.population", "policy.horizons_s", "scenario.episode_steps")
        return Memory("the search", search_bytes(self.n_episodes, self.population, n_actions, episode_steps), keys)


def search_bytes(n_tasks: int, population: int, n_actions: int, episode_steps: int, n_switches: int = 2) -> int:
    """Bytes of the sequences that are played at once: a round's, or those of up to `n_switches` switches before it."""
    n_sequences = max(population, n_actions ** (1 + n_switches))
    return n_tasks * n_sequences * episode_steps * ACTION_BYTES * N_COPIES


@dataclass(frozen=True)
class Sequences:
    """Sequences of the ego's horizons and their results; the leading axis is R, or N for one per task.

    actions: [R, T] int64, indices into the horizons; those after the end of the episode have no meaning
    n_steps: [R] int64, decisions until the episode ended
    reward: [R] float64, undiscounted return
    score: [R] float64, what the search maximises: the return and, for a success, less than one step's reward more
        for the share of the last step that was left when the last vehicle arrived. Its order is that of the return.
        -inf: the rollout was cut off, nothing else is known
    """

    actions: Tensor
    n_steps: Tensor
    reward: Tensor
    score: Tensor


class Rollouts:
    """Rollouts of sequences of horizons in the true world.

    horizons_s: the ego's choices, s
    reward_config: reward of an episode; cutting off is exact if the reward of a step is not positive
    """

    def __init__(self, game: Game, horizons_s: tuple[float, ...], reward_config: RewardConfig) -> None:
        self.game, self.reward_config = game, reward_config
        self.n_actions, self.n_steps = len(horizons_s), game.simulator.scenario.episode_steps
        self._horizons = torch.tensor(horizons_s, device=game.planner.times.device)

    def play(self, tasks: Task, actions: Tensor, at_least: Tensor) -> Sequences:
        """Results of `actions` [R, T] in `tasks` (R of them).

        A rollout that can no longer score `at_least` [R] float64 is cut off. Finished worlds are left out.
        """
        paid = torch.zeros_like(at_least)
        score = torch.full_like(at_least, -torch.inf)
        n_steps = torch.zeros_like(actions[:, 0])
        world, rows = self.game.simulator.reset(tasks), torch.arange(len(tasks), device=actions.device)
        while len(rows) > 0:
            horizons = self.game.choose(world, self._horizons[actions[rows, world.step]])
            world, events, *_ = self.game.drive(world, horizons)
            paid[rows] += reward(self.reward_config, events.is_collision, events.is_success).double()
            n_steps[rows] = world.step
            is_over = events.is_terminated | events.is_truncated
            early = torch.where(events.is_success, self._step_left(world), 0.0)
            score[rows[is_over]] = (paid[rows] - self.reward_config.step * early)[is_over]
            most = paid[rows] + self.reward_config.success + self.reward_config.step * self._steps_needed(world)
            is_hopeful = most > at_least[rows]
            going = (~is_over & is_hopeful).nonzero()[:, 0]
            if len(going) < len(rows):
                rows, world = map_tensors(lambda field, i=going: field[i], (rows, world))
        return Sequences(actions, n_steps, paid, score)

    def _steps_needed(self, world: World) -> Tensor:
        """[R] float64: lower bound on the steps until the last vehicle arrives, at the highest allowed speed."""
        simulator, limits = self.game.simulator, self.game.planner.config.limits
        s = simulator.road.progress(world.vehicles.position, world.task.direction)
        left = (
            torch.where(world.has_reached, 0.0, simulator.road.target_s(world.task.direction) - s).amax(1).clamp(min=0)
        )
        return left.double() / (limits.speed_max_mps * simulator.scenario.dt_s)

    def _step_left(self, world: World) -> Tensor:
        """[R] float64 in [0, 1): share of the last step that was left when the last vehicle reached its target."""
        vehicles, simulator = world.vehicles, self.game.simulator
        road, direction = simulator.road, world.task.direction
        beyond = road.progress(vehicles.position, direction) - road.target_s(direction)
        driven = (vehicles.speed * simulator.scenario.dt_s).clamp(min=1e-3)
        return (beyond / driven).amin(1).double().clamp(0.0, 0.999)


def best_simple(rollouts: Rollouts, tasks: Task, may_switch_twice: bool = True) -> Sequences:
    """[N]: the best sequence of each task with at most two switches, the start of the search."""
    fixed = torch.arange(rollouts.n_actions, device=tasks.family.device)
    step = torch.arange(rollouts.n_steps, device=fixed.device)
    best = _best(rollouts, tasks, fixed[:, None].expand(len(tasks), -1, len(step)), None)
    for steps in (*((at,) for at in SWITCH_STEPS), *(SWITCH_PAIRS if may_switch_twice else ())):
        parts = torch.cartesian_prod(*[fixed] * (1 + len(steps)))  # [R, parts]
        parts = parts[(parts.diff(dim=1) != 0).all(1)]  # equal neighbours are a sequence with fewer switches
        part = sum((step >= at).long() for at in steps)
        found = _best(rollouts, tasks, parts[:, part].expand(len(tasks), -1, -1), best.score)
        best = tree_where(found.score >= best.score, found, best)
    return best


def improve(rollouts: Rollouts, tasks: Task, best: Sequences, population: int, random: Generator) -> Sequences:
    """One round: [N] the best of each task's `population` candidates and of `best` [N], never worse than that.

    Among equally good ones the candidate is kept, so that the search can drift where decisions have no effect.
    """
    tried = candidates(best, alike(tasks), rollouts.n_actions, population, random)
    found = _best(rollouts, tasks, tried, best.score)
    return tree_where(found.score >= best.score, found, best)


def simplify(rollouts: Rollouts, tasks: Task, best: Sequences, population: int, random: Generator) -> Sequences:
    """One round: [N] sequences of no less reward than `best` [N] with fewer switches, where some are found.

    A search leaves switches that have no effect. In each of a task's `population` candidates, one piece between two
    switches gets the horizon of the piece before or after it.
    """
    played = _play(rollouts, tasks, _merged(best, population, random), best.reward - SAME_REWARD)
    is_as_good = played.reward >= (best.reward - SAME_REWARD).repeat_interleave(population)
    n = torch.where(is_as_good & played.score.isfinite(), n_switches(played), rollouts.n_steps)
    rows = torch.arange(len(tasks), device=n.device) * population + n.reshape(-1, population).argmin(1)
    return tree_where(n[rows] < n_switches(best), map_tensors(lambda field: field[rows], played), best)


def n_switches(sequences: Sequences) -> Tensor:
    """[R] int64: number of changes of the horizon before the episode ends."""
    is_change = sequences.actions.diff(dim=1) != 0
    step = torch.arange(1, 1 + is_change.shape[1], device=is_change.device)
    return (is_change & (step < sequences.n_steps[:, None])).sum(1)


def _best(rollouts: Rollouts, tasks: Task, actions: Tensor, at_least: Tensor | None) -> Sequences:
    """[N]: the best of each task's `actions` [N, C, T]; those below `at_least` [N] may be cut off."""
    n_tasks, n_each, _ = actions.shape
    if at_least is None:
        at_least = torch.full((n_tasks,), -torch.inf, dtype=torch.float64, device=actions.device)
    played = _play(rollouts, tasks, actions, at_least)
    first = torch.arange(n_tasks, device=actions.device) * n_each
    rows = first + played.score.reshape(n_tasks, n_each).argmax(1)
    return map_tensors(lambda field: field[rows], played)


def _play(rollouts: Rollouts, tasks: Task, actions: Tensor, at_least: Tensor) -> Sequences:
    """[N * C]: each task's `actions` [N, C, T]; those below `at_least` [N] may be cut off."""
    each = map_tensors(lambda field: field.repeat_interleave(actions.shape[1], 0), (tasks, at_least))
    return rollouts.play(each[0], actions.flatten(0, 1), each[1])


def alike(tasks: Task) -> Tensor:
    """[N, K] int64: the most similar other tasks of each task; the task itself if there is no other."""
    styles = torch.cat([tasks.style_horizon, tasks.next_style_horizon, tasks.switch_time, tasks.patience], 1)
    styles = styles.nan_to_num(nan=-1.0, posinf=NEVER_S)
    drivers = DRIVER_M * tasks.casting.driver
    features = torch.cat([tasks.start_distance, STYLE_M_PER_S * styles, drivers], 1).double()
    apart = torch.cdist(features, features).fill_diagonal_(-1.0)
    n_others = min(N_ALIKE, len(tasks) - 1)
    return apart.argsort(dim=1, stable=True)[:, min(1, n_others) : n_others + 1]


def candidates(best: Sequences, likes: Tensor, n_actions: int, population: int, random: Generator) -> Tensor:
    """[N, C, T] int64: `best` [N] changed at random in the decisions before the end of the episode.

    likes: [N, K] int64, similar tasks, whose sequences may be borrowed

    One or two pieces are overwritten with one horizon each, which moves, adds and removes switches. Some candidates
    have all decisions from a step on moved in time; some are changes of a similar task's sequence.
    """
    source = _sources(likes, population, random)
    n_steps, actions = best.n_steps[source][..., None], best.actions[source]
    once = _write_over(actions, n_steps, n_actions, random)
    twice = _write_over(once, n_steps, n_actions, random)
    changed = torch.where(_uniform(actions, random) < SECOND_PIECE_CHANCE, twice, once)
    return torch.where(_uniform(actions, random) < SHIFT_CHANCE, _shift(changed, n_steps, random), changed)


def _sources(likes: Tensor, population: int, random: Generator) -> Tensor:
    """[N, C] int64: the task whose sequence a candidate changes."""
    n_tasks, n_likes = likes.shape
    own = torch.arange(n_tasks, device=likes.device)[:, None].expand(-1, population)
    choice = torch.randint(n_likes, own.shape, generator=random, device=own.device)
    is_borrowed = torch.rand(own.shape, generator=random, device=own.device) < BORROWED_CHANCE
    return torch.where(is_borrowed, likes.gather(1, choice), own)


def _write_over(actions: Tensor, n_steps: Tensor, n_actions: int, random: Generator) -> Tensor:
    """One piece of each sequence gets one horizon; lengths are log-uniform up to `n_steps` [N, C, 1]."""
    length = n_steps ** _uniform(actions, random)
    start = _uniform(actions, random) * (n_steps + length) - length
    step = torch.arange(actions.shape[2], device=actions.device)
    horizon = (_uniform(actions, random) * n_actions).long()
    return torch.where((step >= start) & (step < start + length), horizon, actions)


def _merged(best: Sequences, population: int, random: Generator) -> Tensor:
    """[N, C, T] int64: `best` [N] with the piece of a random decision merged into a neighbouring piece."""
    actions = best.actions[:, None].expand(-1, population, -1)
    piece = torch.nn.functional.pad((actions.diff(dim=2) != 0).long().cumsum(2), (1, 0))
    at = (_uniform(actions, random) * best.n_steps[:, None, None]).long()
    is_inside = piece == piece.gather(2, at)
    before = is_inside.long().argmax(2, keepdim=True) - 1
    after = before + is_inside.sum(2, keepdim=True) + 1
    like = torch.where(_uniform(actions, random) < 0.5, before, after).clamp(0, actions.shape[2] - 1)
    return torch.where(is_inside, actions.gather(2, like), actions)


def _shift(actions: Tensor, n_steps: Tensor, random: Generator) -> Tensor:
    """Decisions from a random step on, moved by up to `MAX_SHIFT_STEPS` steps."""
    by = 1 + (_uniform(actions, random) * MAX_SHIFT_STEPS).long()
    by = torch.where(_uniform(actions, random) < 0.5, by, -by)
    first = _uniform(actions, random) * n_steps
    step = torch.arange(actions.shape[2], device=actions.device)
    source = torch.where(step < first, step, (step - by).clamp(0, actions.shape[2] - 1))
    return actions.gather(2, source.expand_as(actions))


def _uniform(actions: Tensor, random: Generator) -> Tensor:
    """[N, C, 1] float32 in [0, 1), one number per candidate."""
    return torch.rand((*actions.shape[:2], 1), generator=random, device=actions.device)
