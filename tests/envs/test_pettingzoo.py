"""PettingZoo takes the parallel environment as it is; every vehicle is an agent that sees with its own eyes."""

import copy
from typing import Any

import numpy as np
import pytest

from negopipe.errors import UserError

pytest.importorskip("pettingzoo")
from pettingzoo.test import parallel_api_test, parallel_seed_test

import negopipe
from negopipe.envs.gymnasium import NarrowLaneEnv
from negopipe.envs.pettingzoo import NarrowLaneParallelEnv

SHORT = ("scenario.episode_steps=12",)


def made(*overrides: str) -> NarrowLaneParallelEnv:
    return negopipe.make_parallel_env([*SHORT, *overrides])


@pytest.mark.parametrize("overrides", [(), ("scenario.n_social=2", "observation=objects", "policy=objects")])
def test_the_api_is_pettingzoos(overrides: tuple[str, ...]) -> None:
    parallel_api_test(made(*overrides), num_cycles=30)


def test_the_same_seed_gives_the_same_episodes() -> None:
    parallel_seed_test(made)


def test_agents_are_the_vehicles() -> None:
    env = made("scenario.n_social=2", "scenario.n_followers=1")
    assert env.possible_agents == ["ego", "social_1", "social_2", "social_3"]
    assert len({id(env.action_space(agent)) for agent in env.possible_agents}) == 4
    assert env.observation_space("ego") is env.observation_space("ego")


def test_an_agent_observes_and_is_paid_as_in_self_play() -> None:
    env = made()
    observations, infos = env.reset(seed=1)
    assert infos == {"ego": {}, "social_1": {}}
    game, worlds = env._worlds.game, env._worlds
    n_steps = 0
    while env.agents:
        seen = game.perceive(worlds._env.world)
        for index, agent in enumerate(env.agents):
            assert np.array_equal(observations[agent], game.draw(seen.of(index))[0].numpy() * 255)
        observations, rewards, terminations, truncations, infos = env.step({"ego": 3, "social_1": 0})
        n_steps += 1
        is_over = any(terminations.values()) or any(truncations.values())
        assert set(rewards.values()) == {worlds.config.reward.step} or is_over
    assert n_steps <= 12
    assert infos["ego"]["n_decisions"] == n_steps
    assert infos["ego"] == infos["social_1"]


def test_a_task_may_be_given() -> None:
    env = made()
    start, _ = env.reset(seed=1)
    given, _ = env.reset(seed=1, options={"task": {"ego_start_distance_m": 12.5}})
    assert not np.array_equal(start["ego"], given["ego"])


def test_the_actions_drive_every_vehicle() -> None:
    env = made("scenario.episode_steps=30")
    reached = []
    for action in (0, 3):
        env.reset(seed=1)
        for _ in range(10):
            if env.agents:
                env.step({agent: action if agent == "social_1" else 1 for agent in env.agents})
        reached.append(env._worlds.record.shot(0).moment.position)
    assert not np.allclose(reached[0][1], reached[1][1])


def test_the_ego_starts_the_task_of_the_gymnasium_environment() -> None:
    observations, _ = made().reset(seed=3)
    assert np.array_equal(observations["ego"], NarrowLaneEnv(SHORT).reset(seed=3)[0])


def test_pictures_and_copies_are_there_as_in_gymnasium() -> None:
    env = negopipe.make_parallel_env(SHORT, render_mode="rgb_array")
    env.reset(seed=1)
    env.render()
    other = copy.deepcopy(env)
    for each in (env, other):
        each.step({"ego": 1, "social_1": 1})
    picture = env.render()
    assert picture is not None
    assert np.array_equal(picture, other.render())


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: made("population=mixed"), "overrides must not change the population, which the actions drive, got"),
        (lambda: made("seed=3"), "overrides must be of scenario, "),
        (lambda: made().reset(options={"task": {"mask": 1}}), "options.task must have names among street, "),
    ],
)
def test_misuse_is_told_in_one_line(wrong: Any, said: str) -> None:
    with pytest.raises(UserError, match=f"^{said}[^\n]*$"):
        wrong()


def test_every_agent_needs_an_action() -> None:
    env = made()
    env.reset(seed=1)
    with pytest.raises(UserError, match="actions must have one for each of ego, social_1, got none for social_1"):
        env.step({"ego": 0})
    with pytest.raises(UserError, match="action must be 2 integers from 0 to 3"):
        env.step({"ego": 0, "social_1": 9})
