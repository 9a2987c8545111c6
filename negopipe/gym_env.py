"""gymnasium's door to the game: `negopipe/NarrowLane-v0`, single and vectorised.

    import gymnasium, negopipe.gym_env
    env = gymnasium.make("negopipe/NarrowLane-v0", overrides=("scenario.n_social=2",))
    envs = gymnasium.make_vec("negopipe/NarrowLane-v0", num_envs=64, vectorization_mode="vector_entry_point")

Observations are the occupancy grids, uint8, 0 = free and 255 = occupied, as image policies expect them; actions
are indices into `policy.horizons_s`. Tasks are drawn from the families that `evaluation.settings` names. `overrides`
are those of the command line.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from negopipe.compose import compose_config
from negopipe.env import NegotiationEnv, build_game
from negopipe.learning.rollout import Transition
from negopipe.simulation.scenario import TaskSampler

ENV_ID = "negopipe/NarrowLane-v0"
OCCUPIED = 255


def _build(overrides: Sequence[str], n_worlds: int) -> NegotiationEnv:
    config = compose_config(overrides)
    game = build_game(config)
    sampler = TaskSampler(config.scenario, config.evaluated_families, torch.Generator())
    return NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, n_worlds)


def _spaces(worlds: NegotiationEnv, n_actions: int) -> tuple[Box, Discrete]:
    return Box(0, OCCUPIED, worlds.game.observation_shape, np.uint8), Discrete(n_actions)


def _grids(observation: torch.Tensor) -> np.ndarray:
    return (observation * OCCUPIED).cpu().numpy()


class NarrowLaneEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One world. `info` at an episode's end holds `is_success` and `is_collision`."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own declaration)

    def __init__(self, overrides: Sequence[str] = ()) -> None:
        self._worlds = _build(overrides, n_worlds=1)
        self.observation_space, self.action_space = _spaces(self._worlds, self._worlds.n_actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._worlds.sampler.generator.manual_seed(int(self.np_random.integers(2**62)))
        self._worlds.restart()
        return _grids(self._worlds.observe())[0], {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reached = self._worlds.step(torch.tensor([int(action)]))
        info = {"is_success": bool(reached.is_success), "is_collision": bool(reached.is_collision)}
        is_over = bool(reached.is_terminated | reached.is_truncated)
        observation = _grids(reached.final_observation if is_over else reached.observation)[0]
        return (
            observation,
            float(reached.reward),
            bool(reached.is_terminated),
            bool(reached.is_truncated),
            info,
        )


class NarrowLaneVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many worlds in one batched program; resets in the same step and hands over the final observation."""

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, overrides: Sequence[str] = ()) -> None:
        self.num_envs = num_envs
        self._worlds = _build(overrides, num_envs)
        spaces = _spaces(self._worlds, self._worlds.n_actions)
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(space, num_envs) for space in spaces)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new tasks everywhere; all worlds share one stream of tasks, so `seed` is one number."""
        if seed is not None and not isinstance(seed, int):
            raise ValueError(f"seed must be one int for all worlds, got {seed}")
        super().reset(seed=seed)
        self._worlds.sampler.generator.manual_seed(int(self.np_random.integers(2**62)))
        self._worlds.restart()
        return _grids(self._worlds.observe()), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        reached = self._worlds.step(torch.as_tensor(np.asarray(actions, dtype=np.int64)))
        terminated, truncated = reached.is_terminated.numpy(), reached.is_truncated.numpy()
        info = self._final_info(reached, terminated | truncated)
        reward = reached.reward.numpy().astype(np.float64)
        return _grids(reached.observation), reward, terminated, truncated, info

    def _final_info(self, reached: Transition, is_done: np.ndarray) -> dict[str, Any]:
        """gymnasium's layout: `final_obs` and `final_info` with masks `_final_obs` and `_final_info`."""
        if not is_done.any():
            return {}
        final_obs = np.full(self.num_envs, None, dtype=object)
        grids = _grids(reached.final_observation)
        for row, world in enumerate(is_done.nonzero()[0]):
            final_obs[world] = grids[row]
        final_info = {
            "is_success": reached.is_success.numpy(),
            "_is_success": is_done,
            "is_collision": reached.is_collision.numpy(),
            "_is_collision": is_done,
        }
        return {
            "final_obs": final_obs,
            "_final_obs": is_done,
            "final_info": final_info,
            "_final_info": is_done,
        }


gymnasium.register(
    ENV_ID,
    entry_point="negopipe.gym_env:NarrowLaneEnv",
    vector_entry_point="negopipe.gym_env:NarrowLaneVectorEnv",
)
