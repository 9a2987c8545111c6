"""The oracle's search: exact where all sequences can be played, never worse, repeatable, and it drives what it says."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
import torch
from games import draw_tasks

from negopipe.agents.horizon_drivers import by_horizon, sequence_planner
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.game.game import Game
from negopipe.search import oracle
from negopipe.search.oracle import Rollouts, Sequences, alike, best_simple, candidates, improve, n_switches, simplify
from negopipe.simulation.state import Task
from negopipe.tensors.tree import map_tensors

pytestmark = pytest.mark.slow  # the fast tests of the oracle stage search, too


@pytest.fixture(scope="module", autouse=True)
def few_switches() -> Iterator[None]:
    """A coarse grid to start from, for time; with three decisions there is none at all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(oracle, "SWITCH_STEPS", (8, 24))
        patch.setattr(oracle, "SWITCH_PAIRS", ())
        yield


@pytest.fixture(scope="module")
def rollouts(config: RunConfig, game: Game) -> Rollouts:
    return Rollouts(game, config.policy.horizons_s, config.evaluation.reward)


def searched(rollouts: Rollouts, tasks: Task, rounds: int, population: int = 4) -> list[Sequences]:
    """The best at the start and after each round."""
    random = torch.Generator().manual_seed(0)
    found = [best_simple(rollouts, tasks)]
    for _ in range(rounds):
        found.append(improve(rollouts, tasks, found[-1], population, random))
    return found


@pytest.fixture(scope="module")
def tasks(config: RunConfig) -> Task:
    """All have something to find with three decisions, one has with all decisions."""
    return map_tensors(lambda field: field[[1, 3, 4, 6]], draw_tasks(config, 8, seed=1))


@pytest.fixture(scope="module")
def found(rollouts: Rollouts, tasks: Task) -> list[Sequences]:
    return searched(rollouts, tasks, rounds=2)


def none_given_up(n: int) -> torch.Tensor:
    return torch.full((n,), -torch.inf, dtype=torch.float64)


def test_no_round_makes_it_worse(found: list[Sequences], rollouts: Rollouts, tasks: Task) -> None:
    for horizon in range(rollouts.n_actions):
        fixed = torch.full((len(tasks), rollouts.n_steps), horizon)
        assert (found[0].reward >= rollouts.play(tasks, fixed, none_given_up(len(tasks))).reward).all()
    for before, after in pairwise(found):
        assert (after.score >= before.score).all()
        assert (after.reward >= before.reward).all()
    assert (found[-1].score > found[0].score).any()


def test_same_seed_same_result(found: list[Sequences], rollouts: Rollouts, tasks: Task) -> None:
    random = torch.Generator().manual_seed(0)
    again = improve(rollouts, tasks, found[0], 4, random)
    assert torch.equal(again.score, found[1].score)
    assert torch.equal(again.actions, found[1].actions)
    one, same, other = (
        candidates(found[0], alike(tasks), 4, 3, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_it_drives_what_it_claims(config: RunConfig, game: Game, found: list[Sequences], tasks: Task) -> None:
    best = found[-1]
    horizon_s = torch.tensor(config.policy.horizons_s)[best.actions.T]
    names = ("oracle", "mixture")
    trace = drive_episodes(
        game, by_horizon(game, sequence_planner(horizon_s)), tasks, len(tasks), config.evaluation.reward, names
    )
    assert trace.reward.sum(0).tolist() == best.reward.tolist()
    assert trace.n_steps.tolist() == best.n_steps.tolist()
    for task, n in enumerate(trace.n_steps):
        assert np.array_equal(trace.horizon_s[:n, task, 0], horizon_s[:n, task])


def test_the_score_orders_as_the_return_does(found: list[Sequences]) -> None:
    for each in found:
        assert ((each.score >= each.reward) & (each.score < each.reward + 0.25)).all()


class Held(Rollouts):
    """Three decisions per episode, each held for 2 s and the last one to the end, so that all can be played."""

    n_held = 10

    def __init__(self, config: RunConfig, game: Game) -> None:
        super().__init__(game, config.policy.horizons_s, config.evaluation.reward)
        self.n_drive_steps, self.n_steps = self.n_steps, 3

    def play(self, tasks: Task, actions: torch.Tensor, at_least: torch.Tensor) -> Sequences:
        which = (torch.arange(self.n_drive_steps) // self.n_held).clamp(max=self.n_steps - 1)
        played = super().play(tasks, actions[:, which], at_least)
        n_decisions = (played.n_steps / self.n_held).ceil().long().clamp(max=self.n_steps)
        return replace(played, actions=actions, n_steps=n_decisions)


def test_it_finds_the_best_of_all_sequences(config: RunConfig, game: Game, tasks: Task) -> None:
    rollouts = Held(config, game)
    every = torch.tensor(list(product(range(4), repeat=3)))
    tasks = map_tensors(lambda field: field[[0, 3]], tasks)
    found = searched(rollouts, tasks, rounds=12, population=16)
    each = map_tensors(lambda field: field.repeat_interleave(len(every), 0), (tasks, found[0].score))
    exact = rollouts.play(each[0], every.repeat(len(tasks), 1), each[1]).score.reshape(len(tasks), -1).amax(1)
    assert (exact > found[0].score + 0.2).all()  # there is something to find
    torch.testing.assert_close(found[-1].score, exact, atol=1e-3, rtol=0)


def test_giving_up_loses_nothing_that_counts(rollouts: Rollouts, found: list[Sequences], tasks: Task) -> None:
    best = found[0]
    tried = candidates(best, alike(tasks), rollouts.n_actions, 1, torch.Generator().manual_seed(5))[:, 0]
    whole = rollouts.play(tasks, tried, none_given_up(len(tasks)))
    hurried = rollouts.play(tasks, tried, best.score)
    counts = whole.score >= best.score
    assert torch.equal(hurried.score[counts], whole.score[counts])
    assert (hurried.n_steps <= whole.n_steps).all()
    too_much = rollouts.play(tasks, tried, torch.full((len(tasks),), 10.0, dtype=torch.float64))
    assert too_much.n_steps.tolist() == [1] * len(tasks)
    assert too_much.score.tolist() == [-np.inf] * len(tasks)


def test_candidates_change_decisions_that_count(rollouts: Rollouts, found: list[Sequences]) -> None:
    best = found[0]
    alone = torch.arange(4)[:, None]  # nobody borrows from another
    tried = candidates(best, alone, rollouts.n_actions, 400, torch.Generator().manual_seed(0))
    assert tried.shape == (4, 400, rollouts.n_steps)
    assert set(tried.unique().tolist()) == {0, 1, 2, 3}
    is_changed = tried != best.actions[:, None]
    for task, n in enumerate(best.n_steps.tolist()):
        assert is_changed[task, :, :n].any(0).all()
        assert is_changed[task, :, :n].any(1).float().mean() > 0.6  # a piece may get the horizon that it had


def test_switches_without_effect_are_taken_out(rollouts: Rollouts, found: list[Sequences], tasks: Task) -> None:
    """What two horizons do alike is driven with one of them; nothing is lost by it."""
    step = torch.arange(rollouts.n_steps)
    flickering = torch.where(step % 2 == 0, found[0].actions, (found[0].actions + 1) % 4)
    late = torch.where(step >= found[0].n_steps[:, None] - 8, flickering, found[0].actions)  # both are past by then
    best = played = rollouts.play(tasks, late, none_given_up(len(tasks)))
    assert (n_switches(played) > n_switches(found[0])).any()
    random = torch.Generator().manual_seed(0)
    for _ in range(3):
        best = simplify(rollouts, tasks, best, 6, random)
    assert (n_switches(best) <= n_switches(played)).all()
    assert n_switches(best).sum() < n_switches(played).sum()
    assert (best.reward >= played.reward).all()
    again = rollouts.play(tasks, best.actions, none_given_up(len(tasks)))
    assert torch.equal(again.reward, best.reward)


def test_switches_are_counted_until_the_end() -> None:
    actions = torch.tensor([[0, 1, 1, 2, 0], [3, 3, 3, 3, 0]])
    zero = torch.zeros(2, dtype=torch.float64)
    assert n_switches(Sequences(actions, torch.tensor([4, 4]), zero, zero)).tolist() == [2, 0]


def test_tasks_borrow_from_their_like(tasks: Task, found: list[Sequences]) -> None:
    """The nearest starts of the same style come first, never the task itself; what is borrowed is another's."""
    start = torch.tensor([[12.0, 12.0], [12.5, 12.0], [18.0, 12.0], [12.0, 12.1]])
    style = torch.tensor([[torch.nan, 2.0], [torch.nan, 2.0], [torch.nan, 2.0], [torch.nan, 6.0]])
    ordered = alike(replace(tasks, start_distance=start, style_horizon=style))
    assert ordered.tolist() == [[1, 2, 3], [0, 2, 3], [1, 0, 3], [0, 1, 2]]
    assert alike(map_tensors(lambda field: field[:1], tasks)).tolist() == [[0]]
    marked = replace(found[0], actions=torch.arange(4)[:, None].expand(4, 128), n_steps=torch.full((4,), 128))
    tried = candidates(marked, ordered[:, :1], 4, 400, torch.Generator().manual_seed(0))
    most = tried.mode(2).values  # pieces that are written over are mostly short
    own = (most == torch.arange(4)[:, None]).float().mean(1)
    borrowed = (most == ordered[:, :1]).float().mean(1)
    assert ((own > 0.5) & (own < 0.8)).all()
    assert ((borrowed > 0.2) & (borrowed < 0.45)).all()
