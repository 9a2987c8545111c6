"""Replays: the recorded horizons give the recorded drive, and the policy is asked what it saw then."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from composed import compose_config
from games import draw_tasks

from negopipe.agents.driver import HorizonDriver
from negopipe.agents.horizon_drivers import adaptive_planner
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.replay import record_policy, replay
from negopipe.evaluation.trace import EPISODE_AXIS, Trace
from negopipe.game.game import Game, build_game
from negopipe.policy.actor_critic import ActorCritic
from negopipe.policy.kinds import build_policy
from negopipe.simulation.state import Task


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return compose_config(["scenario.episode_steps=20"])


@pytest.fixture(scope="module")
def game(config: RunConfig) -> Game:
    return build_game(config)


@pytest.fixture(scope="module")
def policy(config: RunConfig, game: Game) -> ActorCritic:
    random = torch.Generator().manual_seed(0)
    return build_policy(config.policy, config.observation.layout, torch.device("cpu"), random)


@pytest.fixture(scope="module")
def tasks(config: RunConfig) -> Task:
    return draw_tasks(config, 3)


@pytest.fixture(scope="module")
def driven(config: RunConfig, game: Game, policy: ActorCritic, tasks: Task) -> Trace:
    """With horizons that are drawn, so that they change."""

    def ego(episode_key: torch.Tensor) -> HorizonDriver:
        return HorizonDriver(adaptive_planner(policy, game, config.policy.horizons_s, episode_key), game.plan)

    return drive_episodes(game, ego, tasks, 3, config.evaluation.reward, ("adaptive", "push"), is_lockstep=True)


def chosen(trace: Trace) -> list[np.ndarray]:
    return [trace.horizon_s[:n, episode, 0] for episode, n in enumerate(trace.n_steps)]


def test_the_same_drive_again(config: RunConfig, game: Game, tasks: Task, driven: Trace) -> None:
    assert len(np.unique(np.concatenate(chosen(driven)))) > 1
    again = replay(game, tasks, chosen(driven), config.evaluation.reward, ("adaptive", "push"))
    for field in fields(Trace):
        then, now = getattr(driven, field.name), getattr(again, field.name)
        is_float = field.name in EPISODE_AXIS and then.dtype.kind == "f"
        assert np.array_equal(then, now, equal_nan=is_float) if field.name in EPISODE_AXIS else then == now


def test_the_policy_is_seen_thinking(
    config: RunConfig, game: Game, policy: ActorCritic, tasks: Task, driven: Trace
) -> None:
    paid, horizons = config.evaluation.reward, config.policy.horizons_s
    policy_traces = record_policy(game, policy, horizons, 1.0, tasks, chosen(driven), paid)
    for policy_trace, n in zip(policy_traces, driven.n_steps, strict=True):
        assert policy_trace.grids is not None
        assert policy_trace.grids.shape == (n, *game.observation_shape)
        assert policy_trace.probability.sum(1) == pytest.approx(np.ones(n), abs=1e-5)
    first = game.see(game.simulator.reset(tasks))
    with torch.no_grad():
        expected = policy(first)[0].softmax(-1)
    assert np.array_equal(np.stack([policy_trace.grids[0] for policy_trace in policy_traces]), first.numpy())
    assert np.stack([policy_trace.probability[0] for policy_trace in policy_traces]) == pytest.approx(
        expected.numpy(), abs=1e-5
    )


def test_a_policy_that_sees_no_grids_has_probabilities_only(tasks: Task) -> None:
    config = compose_config(["scenario.episode_steps=20", "observation=objects", "policy=objects"])
    policy = build_policy(config.policy, config.observation.layout, torch.device("cpu"), torch.Generator())
    horizons = [np.zeros(4, dtype=np.float32)] * 3
    paid = config.evaluation.reward
    for trace in record_policy(build_game(config), policy, config.policy.horizons_s, 1.0, tasks, horizons, paid):
        assert trace.grids is None
        assert trace.probability.shape == (4, 4)
