"""A gymnasium vector environment as one of Stable-Baselines3; needs the extra `sb3`.

import negopipe
from negopipe.envs.stable_baselines3 import Sb3VecEnv
from stable_baselines3 import PPO
PPO("CnnPolicy", Sb3VecEnv(negopipe.make_vec_env(64)), seed=1).learn(100_000)

With the overrides observation=objects and policy=objects of `make_vec_env` it is an "MlpPolicy".
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
    """The worlds of one vector environment, as the environments of Stable-Baselines3.

    They step together and share their attributes, so a change or a call for some of them only is refused. At the end
    of an episode, the info of its world holds `terminal_observation`, `TimeLimit.truncated`, and `is_success` and
    `is_collision` from the environment.

    envs: a vector environment with autoreset in the same step; UserError for another
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
        """First observations [E, *obs]; the seed and the options that were set since the last reset are used once."""
        observation, info = self.envs.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = [_of_world(info, world) for world in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions [E] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations [E, *obs], rewards [E] float32, whether an episode is over [E] bool, and an info per world."""
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
        """Attribute of the vector environment for each of the given worlds; AttributeError if it has none.

        The spaces, `observation_space` and `action_space`, are those of a single world.
        """
        return [getattr(self.envs, self._name(attr_name))] * len(self._worlds(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment; UserError for some of the worlds only."""
        self._all_worlds("set_attr", indices)
        setattr(self.envs, self._name(attr_name), value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Result of one call of the vector environment's method, for each world; UserError for some worlds only."""
        worlds = self._all_worlds("env_method", indices)
        return [getattr(self.envs, method_name)(*args, **kwargs)] * len(worlds)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """False for each of the given worlds: a world is no environment that could be wrapped."""
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
    """Info of one world from gymnasium's info of all, in which each name has a mask of the same name."""
    return {name: info[name][world] for name in info if f"_{name}" in info and info[f"_{name}"][world]}


def _at_the_end(info: Mapping[str, Any], world: int) -> dict[str, Any]:
    return {**_of_world(info["final_info"], world), "terminal_observation": info["final_obs"][world]}
