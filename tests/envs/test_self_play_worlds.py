"""Self-play in the vector environment: every vehicle is an environment, the same as the agents of PettingZoo."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import negopipe
from negopipe.envs.gymnasium import NarrowLaneVectorEnv
from negopipe.errors import UserError

SHORT = ("scenario.episode_steps=8", "observation=objects", "policy=objects")
N_WORLDS = 2


def made(*overrides: str, n_vehicles: int = 2) -> NarrowLaneVectorEnv:
    return NarrowLaneVectorEnv(n_vehicles * N_WORLDS, [*SHORT, *overrides], is_self_play=True)


def test_each_environment_is_an_agent_of_pettingzoo() -> None:
    pytest.importorskip("pettingzoo")
    n_vehicles, seed = 3, 5
    envs = made("scenario.n_social=2", n_vehicles=n_vehicles)
    agents = [negopipe.make_parallel_env([*SHORT, "scenario.n_social=2"]) for _ in range(N_WORLDS)]
    seen = envs.reset(seed=seed)[0].reshape(n_vehicles, N_WORLDS, -1)
    expected = [world.reset(seed=seed + index)[0] for index, world in enumerate(agents)]
    rng, n_over = np.random.default_rng(1), 0
    for _ in range(10):
        actions = rng.integers(0, 4, (n_vehicles, N_WORLDS))
        for index, names in enumerate(expected):
            assert all(np.array_equal(seen[v, index], row) for v, row in enumerate(names.values()))
        seen, paid, terminated, truncated, info = envs.step(actions.flatten())
        seen, paid = seen.reshape(n_vehicles, N_WORLDS, -1), paid.reshape(n_vehicles, N_WORLDS)
        for index, world in enumerate(agents):
            given = dict(zip(world.agents, actions[:, index], strict=True))
            expected[index], rewards, ends, cuts, infos = world.step(given)
            assert list(rewards.values()) == paid[:, index].tolist()
            assert list(ends.values()) == terminated[index::N_WORLDS].tolist()
            assert list(cuts.values()) == truncated[index::N_WORLDS].tolist()
            if not world.agents:
                n_over += 1
                final = [info["final_obs"][v * N_WORLDS + index] for v in range(n_vehicles)]
                assert all(map(np.array_equal, final, expected[index].values()))
                assert info["final_info"]["n_decisions"][index::N_WORLDS].tolist() == [infos["ego"]["n_decisions"]] * 3
                expected[index] = world.reset()[0]
    assert n_over >= N_WORLDS


def test_a_vehicle_that_has_collided_sees_nothing_and_is_paid_nothing() -> None:
    envs = made()
    envs.reset(seed=1)
    inner = envs._worlds._env
    inner.world = replace(inner.world, has_collided=torch.tensor([[False, True], [False, False]]))
    seen, paid, *_ = envs.step(np.ones(4, dtype=np.int64))
    step = envs._worlds.config.reward.step
    assert paid.tolist() == [step, step, 0.0, step]
    assert (seen != 0).any(-1).tolist() == [True, True, False, True]


@pytest.mark.parametrize(
    ("n_envs", "overrides", "said"),
    [
        (3, (), "num_envs must be a multiple of the 2 vehicles of a world, got 3"),
        (4, ("population=mixed",), "overrides must not change the population, which the actions drive, got"),
    ],
)
def test_what_is_no_self_play_is_refused(n_envs: int, overrides: tuple[str, ...], said: str) -> None:
    with pytest.raises(UserError, match=f"^{said}"):
        negopipe.make_vec_env(n_envs, [*SHORT, *overrides], is_self_play=True)


def test_worlds_of_self_play_start_together() -> None:
    with pytest.raises(UserError, match="options must be task, got the key 'reset_mask'"):
        made().reset(options={"reset_mask": np.ones(4, dtype=bool)})
    with pytest.raises(UserError, match="seed must be an int or a list of 2 ints"):
        made().reset(seed=[1, 2, 3, 4])
