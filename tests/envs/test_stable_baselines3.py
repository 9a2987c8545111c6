"""Stable-Baselines3 takes the environments, the vector one through the adapter; what it sets acts or is refused."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from negopipe.envs.gymnasium import NarrowLaneVectorEnv
from negopipe.envs.registration import ENV_ID
from negopipe.errors import UserError

sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import VecMonitor  # noqa: E402

from negopipe.envs.stable_baselines3 import Sb3VecEnv  # noqa: E402

SHORT = ("scenario.episode_steps=20",)
SMALL: dict[str, Any] = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "device": "cpu"}


@pytest.fixture(scope="module")
def envs() -> Sb3VecEnv:
    return Sb3VecEnv(NarrowLaneVectorEnv(3, SHORT))


def weights(model: Any) -> list[np.ndarray]:
    return [parameter.detach().numpy().copy() for parameter in model.policy.parameters()]


def is_same(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_trains_on_the_single_env() -> None:
    env = gymnasium.make(ENV_ID)
    check_env(env)
    model = sb3.PPO("CnnPolicy", env, **SMALL)
    before = weights(model)
    model.learn(16)
    assert not is_same(before, weights(model))


def test_a_seed_makes_training_repeatable() -> None:
    learnt = []
    for seed in (1, 1, 2):
        model = sb3.PPO("CnnPolicy", Sb3VecEnv(NarrowLaneVectorEnv(2)), seed=seed, **SMALL)
        model.learn(32)
        learnt.append(weights(model))
    assert is_same(learnt[0], learnt[1])
    assert not is_same(learnt[0], learnt[2])


def test_the_seed_is_that_of_the_next_reset(envs: Sb3VecEnv) -> None:
    expected = NarrowLaneVectorEnv(3, SHORT).reset(seed=7)[0]
    assert envs.seed(7) == [7, 8, 9]
    assert np.array_equal(envs.reset(), expected)
    assert not np.array_equal(envs.reset(), expected)


def starts(envs: Sb3VecEnv) -> list[float]:
    """Start distances of the social vehicles: grids of two tasks may be alike."""
    envs.reset()
    return envs.envs._worlds._env.world.task.start_distance[:, 1].tolist()  # type: ignore[attr-defined]


def test_options_are_those_of_the_next_reset(envs: Sb3VecEnv) -> None:
    first = starts(envs)
    envs.set_options({"reset_mask": np.array([False, True, False])})
    second = starts(envs)
    assert [a == b for a, b in zip(first, second, strict=True)] == [True, False, True]
    assert starts(envs)[0] != second[0]
    envs.set_options({"start_m": 3})
    with pytest.raises(UserError, match="options must be task or reset_mask, got the key 'start_m'"):
        envs.reset()
    envs.set_options(None)
    envs.reset()
    with pytest.raises(UserError, match="options must be one mapping for all worlds, got a list"):
        envs.set_options([{}, {}, {}])


def test_an_end_is_told_as_stable_baselines3_expects_it(envs: Sb3VecEnv) -> None:
    other, n_ended = NarrowLaneVectorEnv(3, SHORT), 0
    envs.seed(1)
    envs.reset()
    other.reset(seed=1)
    for _ in range(25):
        actions = np.zeros(3, np.int64)
        observation, reward, is_done, infos = envs.step(actions)
        expected, paid, terminated, truncated, info = other.step(actions)
        assert reward.dtype == np.float32
        assert is_same([observation, reward, is_done], [expected, paid, terminated | truncated])
        assert [bool(each) for each in infos] == is_done.tolist()
        for world in is_done.nonzero()[0]:
            n_ended += 1
            assert np.array_equal(infos[world]["terminal_observation"], info["final_obs"][world])
            assert infos[world]["TimeLimit.truncated"] == truncated[world]
            assert infos[world]["is_success"] == info["final_info"]["is_success"][world]
    assert n_ended > 0


def test_a_monitor_counts_episodes_and_successes() -> None:
    envs = VecMonitor(Sb3VecEnv(NarrowLaneVectorEnv(2, SHORT)))
    model = sb3.PPO("CnnPolicy", envs, **SMALL | {"n_steps": 24}, seed=1)
    model.learn(2 * 24)
    assert len(model.ep_info_buffer) == len(model.ep_success_buffer) == 2


def test_attributes_are_those_of_the_vector_environment(envs: Sb3VecEnv) -> None:
    assert envs.has_attr("num_envs")
    assert not envs.has_attr("nothing_of_this_name")
    assert envs.get_attr("num_envs") == [3, 3, 3]
    assert envs.get_attr("num_envs", [2, 0]) == [3, 3]
    assert envs.get_attr("num_envs", 1) == [3]
    assert envs.get_attr("action_space", 1) == [gymnasium.spaces.Discrete(4)]
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        envs.get_attr("nothing_of_this_name")
    envs.set_attr("mark", 5)
    assert envs.get_attr("mark") == [5, 5, 5]
    envs.set_attr("mark", 6, [0, 1, 2])
    assert envs.get_attr("mark", 0) == [6]


def test_methods_are_called_once_for_all_worlds(envs: Sb3VecEnv) -> None:
    calls = []
    envs.set_attr("count", lambda *args, **kwargs: calls.append((args, kwargs)) or len(calls))
    assert envs.env_method("count", 1, by=2) == [1, 1, 1]
    assert calls == [((1,), {"by": 2})]
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        envs.env_method("nothing_of_this_name")


def test_no_world_is_wrapped(envs: Sb3VecEnv) -> None:
    assert envs.env_is_wrapped(Monitor) == [False, False, False]
    assert envs.env_is_wrapped(Monitor, [1]) == [False]


REFUSED: dict[str, tuple[Callable[[Sb3VecEnv], Any], str]] = {
    "set_attr": (
        lambda e: e.set_attr("mark", 1, [0]),
        r"indices of set_attr must be None or all of 3 .*, got \[0\]",
    ),
    "env_method": (lambda e: e.env_method("render", indices=1), r"indices of env_method must be None .*, got \[1\]"),
    "behind": (lambda e: e.get_attr("num_envs", 3), "indices must be from 0 to 2, got 3"),
    "before": (lambda e: e.env_is_wrapped(Monitor, [-1]), "indices must be from 0 to 2, got -1"),
    "action": (lambda e: e.step(np.array([0, 1, 9])), "action must be 3 integers from 0 to 3, got"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_act_is_refused(envs: Sb3VecEnv, case: str) -> None:
    call, message = REFUSED[case]
    with pytest.raises(UserError, match=message):
        call(envs)


def test_other_vector_environments_are_taken_if_they_reset_in_the_same_step() -> None:
    def make() -> gymnasium.Env:
        return gymnasium.make("CartPole-v1", max_episode_steps=5)

    with pytest.raises(UserError, match=r"envs must have the autoreset_mode .*SAME_STEP, got .*NEXT_STEP"):
        Sb3VecEnv(SyncVectorEnv([make]))
    envs = Sb3VecEnv(SyncVectorEnv([make, make], autoreset_mode=AutoresetMode.SAME_STEP))
    envs.seed(1)
    envs.reset()
    for _ in range(5):
        _, _, is_done, infos = envs.step(np.array([0, 1]))
    assert is_done.all()
    assert all(info["TimeLimit.truncated"] and info["terminal_observation"].shape == (4,) for info in infos)
