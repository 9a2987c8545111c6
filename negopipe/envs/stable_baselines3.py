"""Stable-Baselines3's door to a gymnasium vector environment; needs the extra `sb3`.

from stable_baselines3 import PPO
from negopipe.envs.gymnasium import NarrowLaneVectorEnv
from negopipe.envs.stable_baselines3 import Sb3VecEnv
PPO("CnnPolicy", Sb3VecEnv(NarrowLaneVectorEnv(64)), seed=1).learn(100_000)
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from negopipe.errors import UserError


class Sb3VecEnv(VecEnv):
    """The worlds of one vector environment, of which Stable-Baselines3 thinks as many environments.

    They step together and share their attributes: what would change or call only some of them is refused. Where an
    episode ends, its world's info holds `terminal_observation`, `TimeLimit.truncated` and what the environment says
    of the episode, `is_success` and `is_collision`.

    envs: resets in the same step; UserError for one that does not
    """

    def __init__(self, envs: gymnasium.vector.VectorEnv) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise UserError(f"envs must have the autoreset_mode {AutoresetMode.SAME_STEP}, got {mode}")
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def set_options(self, options: Sequence[dict] | dict | None = None) -> None:
        """Options of the next reset, a mapping for all worlds; UserError for a list, one per world."""
        if not isinstance(options, Mapping | None):
            raise UserError(f"options must be one mapping for all worlds, got a {type(options).__name__}")
        super().set_options(dict(options or {}))

    def reset(self) -> np.ndarray:
        """[E, *obs]. The seed and the options that were set since the last reset are used now, once."""
        observation, info = self.envs.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = [_of_world(info, world) for world in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions [E] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations [E, *obs], rewards [E] float32, which episodes are over [E] bool, and an info per world."""
        observation, reward, terminated, truncated, info = self.envs.step(self._actions)
        is_done = terminated | truncated
        infos = [(_at_the_end if is_done[world] else _of_world)(info, world) for world in range(self.num_envs)]
        for world in is_done.nonzero()[0]:
            infos[world]["TimeLimit.truncated"] = bool(truncated[world] and not terminated[world])
        return observation, reward.astype(np.float32), is_done, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of the vector environment for each world asked for; AttributeError if it has none.

        Of its spaces, `observation_space` and `action_space`, it is that of a single world.
        """
        return [getattr(self.envs, self._name(attr_name))] * len(self._worlds(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment; UserError for some of the worlds only."""
        self._all_worlds("set_attr", indices)
        setattr(self.envs, self._name(attr_name), value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """What the vector environment's method returns, called once, for each world; UserError for some of them."""
        worlds = self._all_worlds("env_method", indices)
        return [getattr(self.envs, method_name)(*args, **kwargs)] * len(worlds)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """False for each world asked for: none is an environment that something could wrap."""
        return [False] * len(self._worlds(indices))

    def _name(self, attribute: str) -> str:
        return f"single_{attribute}" if attribute in ("observation_space", "action_space") else attribute

    def _worlds(self, indices: VecEnvIndices) -> list[int]:
        worlds = list(self._get_indices(indices))
        for world in worlds:
            if not 0 <= world < self.num_envs:
                raise UserError(f"indices must be from 0 to {self.num_envs - 1}, got {world}")
        return worlds

    def _all_worlds(self, call: str, indices: VecEnvIndices) -> list[int]:
        worlds = self._worlds(indices)
        if set(worlds) != set(range(self.num_envs)):
            raise UserError(f"indices of {call} must be None or all of {self.num_envs} worlds, got {worlds}")
        return worlds


def _of_world(info: Mapping[str, Any], world: int) -> dict[str, Any]:
    """What gymnasium's info of all worlds holds of one: each name stands beside a mask of the same name."""
    return {name: info[name][world] for name in info if f"_{name}" in info and info[f"_{name}"][world]}


def _at_the_end(info: Mapping[str, Any], world: int) -> dict[str, Any]:
    return {**_of_world(info["final_info"], world), "terminal_observation": info["final_obs"][world]}
