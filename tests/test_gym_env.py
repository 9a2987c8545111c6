"""gymnasium takes the environments as they are, and so does Stable-Baselines3."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from negopipe.errors import UserError
from negopipe.gym_env import ENV_ID, NarrowLaneVectorEnv


def test_single_passes_the_checker() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ENV_ID, disable_env_checker=True).unwrapped
        check_env(env, skip_render_check=True)


def test_single_keeps_the_final_observation() -> None:
    env = gymnasium.make(ENV_ID)
    env.reset(seed=1)
    total, ended = 0.0, False
    for _ in range(128):
        observation, paid, terminated, truncated, info = env.step(0)
        total += float(paid)
        ended = terminated or truncated
        if ended:
            break
    assert ended
    assert info["is_success"] != info["is_collision"]
    assert total == pytest.approx(-0.25 * (_ + 1) + (10 if info["is_success"] else -5))
    assert env.observation_space.contains(observation)


def test_same_seed_same_observation() -> None:
    env = gymnasium.make(ENV_ID)
    first, _ = env.reset(seed=5)
    moved = env.step(2)[0]
    again, _ = env.reset(seed=5)
    assert np.array_equal(first, again)
    assert np.array_equal(moved, env.step(2)[0])


def test_overrides_act() -> None:
    env = gymnasium.make(ENV_ID, overrides=("observation.n_frames=2", "policy.horizons_s=[0.0,6.0]"))
    assert env.observation_space.shape == (2, 84, 84)
    assert env.action_space.n == 2  # type: ignore[attr-defined]
    with pytest.raises(UserError, match=r"scenario\.dt_s must be greater than 0"):
        gymnasium.make(ENV_ID, overrides=("scenario.dt_s=-1",))


def test_vector_resets_in_the_same_step() -> None:
    envs = gymnasium.make_vec(ENV_ID, num_envs=6, vectorization_mode="vector_entry_point")
    assert isinstance(envs.unwrapped, NarrowLaneVectorEnv)
    observation, _ = envs.reset(seed=2)
    assert envs.observation_space.contains(observation)
    n_ended = 0
    for _ in range(70):
        observation, paid, terminated, truncated, info = envs.step(np.zeros(6, dtype=np.int64))
        assert paid.shape == (6,)
        for world in np.nonzero(terminated | truncated)[0]:
            n_ended += 1
            assert info["_final_obs"][world]
            assert not np.array_equal(info["final_obs"][world], observation[world])
            assert info["final_info"]["is_success"][world] != info["final_info"]["is_collision"][world]
    assert n_ended >= 3


def test_vector_refuses_a_seed_per_world() -> None:
    with pytest.raises(ValueError, match="seed must be one int"):
        NarrowLaneVectorEnv(2).reset(seed=[1, 2])


def test_stable_baselines3_trains_on_the_single_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    env = gymnasium.make(ENV_ID)
    sb3_check_env(env)
    model = sb3.PPO("CnnPolicy", env, n_steps=16, batch_size=16, n_epochs=1, device="cpu")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(16)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))


def test_stable_baselines3_trains_on_the_vector_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from sb3_adapter import Sb3VecEnv

    envs = Sb3VecEnv(NarrowLaneVectorEnv(4))
    model = sb3.PPO("CnnPolicy", envs, n_steps=130, batch_size=130, n_epochs=1, device="cpu")
    model.learn(4 * 130)
    assert model.ep_info_buffer is not None
    assert envs.n_ended > 0
