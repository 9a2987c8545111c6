"""The game as a gymnasium environment, `negopipe/NarrowLane-v0`, single and vectorised.

    import negopipe
    env = negopipe.make_env(["scenario.n_social=2"])
    envs = negopipe.make_vec_env(64)

or, where only gymnasium is to be called,

    import gymnasium, negopipe.envs.gymnasium
    env = gymnasium.make("negopipe/NarrowLane-v0", overrides=["scenario.n_social=2"])
    envs = gymnasium.make_vec("negopipe/NarrowLane-v0", num_envs=64, vectorization_mode="vector_entry_point")

Observations are the occupancy grids, uint8, 0 = free and 255 = occupied, as image policies expect them, or with the
overrides observation=objects and policy=objects a row of numbers, float32, for policies of vectors. Actions are indices
into `policy.horizons_s`. Tasks are drawn from the families that `evaluation.settings` names. `overrides` are
those of the command line that change one of these.

An episode depends on overrides, seed and actions only, not on the process's settings of torch, NumPy or Hydra, which
stay as they are. Worlds are computed in one thread on the CPU, so environments may be built in forked processes. Copies
and pickles hold the whole state and continue from it.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from negopipe.config.compose import compose_config
from negopipe.config.root import RunConfig
from negopipe.errors import UserError, abbreviate
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import build_game
from negopipe.learning.rollout import Transition
from negopipe.observation.objects import ObjectsConfig
from negopipe.observation.occupancy_grid import OccupancyGridConfig
from negopipe.runtime.build import with_learned
from negopipe.simulation.scenario import TaskSampler
from negopipe.tensors.torch_settings import own_settings

ENV_ID = "negopipe/NarrowLane-v0"
OCCUPIED = 255
"""Value of an occupied cell in an observation."""
RESET_MASK = "reset_mask"
"""gymnasium's name of the option of `reset` that selects the worlds in which a new task starts."""

KEYS = (
    *("scenario", "population", "perception", "dynamics", "planner", "safety", "observation", "reward"),
    *("policy.horizons_s", "evaluation.settings"),
)
"""Keys that an environment depends on."""
GROUPS = ("policy", "evaluation", "experiment")
"""Groups whose options set some of these keys, and others."""


def make_env(overrides: Sequence[str] = (), render_mode: str | None = None) -> gymnasium.Env[np.ndarray, np.int64]:
    """One world, `NarrowLaneEnv`, made by `gymnasium.make`: with its `spec` and gymnasium's usual wrappers.

    overrides: those of the command line that an environment depends on, `["+experiment=yield"]`; UserError for another
    render_mode: None, since nothing is drawn
    """
    return gymnasium.make(ENV_ID, render_mode=render_mode, overrides=overrides)


def make_vec_env(
    num_envs: int, overrides: Sequence[str] = ()
) -> gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]:
    """`num_envs` worlds in one batched program, `NarrowLaneVectorEnv`, made by `gymnasium.make_vec`.

    overrides: as for `make_env`
    """
    return gymnasium.make_vec(ENV_ID, num_envs=num_envs, vectorization_mode="vector_entry_point", overrides=overrides)


def config_of(overrides: Sequence[str]) -> RunConfig:
    """The configuration of an environment; UserError for an override that it does not depend on.

    Other keys may be given where the config would not be valid without them.
    """
    if isinstance(overrides, str) or not all(isinstance(override, str) for override in overrides):
        raise UserError(f"overrides must be a sequence of texts key=value, got {abbreviate(repr(overrides))}")
    config = compose_config(overrides)
    for problem in config.population.check_self("an environment"):
        raise UserError(f"{problem.key} must {problem.rule}, got {problem.value}")
    for index, override in enumerate(overrides):
        if not _is_acting(override) and _is_valid([*overrides[:index], *overrides[index + 1 :]]):
            allowed = f"of {', '.join(KEYS)} or options of {', '.join(GROUPS)}"
            raise UserError(f"overrides must be {allowed}, got {abbreviate(override)}")
    return config


def _is_acting(override: str) -> bool:
    name = override.lstrip("+~").partition("=")[0].partition("@")[0]
    key = name.replace("/", ".")
    return name in GROUPS or any(f"{key}.".startswith(f"{place}.") for place in KEYS)


def _is_valid(overrides: Sequence[str]) -> bool:
    try:
        compose_config(overrides)
    except UserError:
        return False
    return True


class _Worlds:
    """The common part of both environments: worlds of a config, a stream of tasks, copies with their whole state."""

    _config: RunConfig
    _worlds: NegotiationEnv

    def _set_up(self, config: RunConfig, n_worlds: int) -> None:
        game = with_learned(build_game(config), config, None)
        scenario, families = config.scenario, config.evaluated_families
        sampler = TaskSampler(scenario, families, torch.Generator(), game.cast.assign, scenario.training_streets)
        self._config = config
        self._worlds = NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, n_worlds)

    def _spaces(self) -> tuple[Box, Discrete]:
        """Observation and action space of one world."""
        shown, actions = self._config.observation, Discrete(self._worlds.n_actions)
        match shown:
            case OccupancyGridConfig():
                return Box(0, OCCUPIED, shown.shape, np.uint8), actions
            case ObjectsConfig():
                return Box(-shown.scales.largest, shown.scales.largest, shown.shape, np.float32), actions

    def _restart(self, random: np.random.Generator, is_chosen: torch.Tensor | None = None) -> np.ndarray:
        """Start new tasks and return their observations, [E, *obs]."""
        self._worlds.sampler.generator.manual_seed(int(random.integers(2**62)))
        self._worlds.restart(is_chosen)
        return _shown(self._worlds.observe())

    def _drive(self, action: Any) -> Transition:
        """Transition by the actions [E]; UserError if they are no actions."""
        given = np.asarray(action)
        n_worlds, n_actions = self._worlds.n_worlds, self._worlds.n_actions
        has_shape = given.shape == (n_worlds,) or given.size == n_worlds == 1
        if not (has_shape and given.dtype.kind in "iu" and (given >= 0).all() and (given < n_actions).all()):
            what = "an integer" if n_worlds == 1 else f"{n_worlds} integers"
            raise UserError(f"action must be {what} from 0 to {n_actions - 1}, got {_in_one_line(action)}")
        return self._worlds.step(torch.tensor(given.reshape(-1).astype(np.int64)))

    def __getstate__(self) -> dict[str, Any]:
        state = {name: tensor.numpy() for name, tensor in self._worlds.state_dict().items()}
        return self.__dict__ | {"_worlds": (self._worlds.n_worlds, state)}  # functions cannot be pickled

    @own_settings()
    def __setstate__(self, state: dict[str, Any]) -> None:
        n_worlds, tensors = state["_worlds"]
        self._set_up(state["_config"], n_worlds)
        self._worlds.load_state_dict({name: torch.tensor(array) for name, array in tensors.items()})
        self.__dict__ |= state | {"_worlds": self._worlds}


class NarrowLaneEnv(_Worlds, gymnasium.Env[np.ndarray, np.int64]):
    """One world. `info` at an episode's end holds `is_success` and `is_collision`.

    overrides: those of the command line, `("scenario.n_social=2",)`; UserError names one that is wrong or has no effect
    render_mode: None, since nothing is drawn
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own declaration)

    @own_settings()
    def __init__(self, overrides: Sequence[str] = (), render_mode: None = None) -> None:
        _check_render_mode(render_mode)
        self._set_up(config_of(overrides), n_worlds=1)
        self.observation_space, self.action_space = self._spaces()

    @own_settings()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new task; there are no options."""
        _check_options(options)
        super().reset(seed=seed)
        return self._restart(self.np_random)[0], {}

    @own_settings()
    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Drive for one control step; `action` is an integer of the action space or an array of one."""
        reached = self._drive(action)
        info = {"is_success": bool(reached.is_success), "is_collision": bool(reached.is_collision)}
        is_over = bool(reached.is_terminated | reached.is_truncated)
        observation = _shown(reached.final_observation if is_over else reached.observation)[0]
        return (
            observation,
            float(reached.reward),
            bool(reached.is_terminated),
            bool(reached.is_truncated),
            info,
        )


class NarrowLaneVectorEnv(_Worlds, gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """E worlds in one batched program, with autoreset in the same step and final observations in `info`.

    num_envs: number of worlds, E
    overrides, render_mode: as for `NarrowLaneEnv`
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    @own_settings()
    def __init__(self, num_envs: int = 1, overrides: Sequence[str] = (), render_mode: None = None) -> None:
        _check_render_mode(render_mode)
        if type(num_envs) is not int or num_envs < 1:
            raise UserError(f"num_envs must be an integer from 1, got {_in_one_line(num_envs)}")
        self.num_envs = num_envs
        self._set_up(config_of(overrides), num_envs)
        spaces = self._spaces()
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(space, num_envs) for space in spaces)

    @own_settings()
    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new tasks in all worlds, which share one stream of tasks, so that `seed` is one number.

        options: `{"reset_mask": [E] bool array}` starts new tasks in those worlds only, the same tasks as in a reset
            of all. The others continue, and draw their next tasks from the new stream
        """
        if seed is not None and not isinstance(seed, int):
            raise UserError(f"seed must be one int for all worlds, got {_in_one_line(seed)}")
        _check_options(options, RESET_MASK)
        is_chosen = self._mask(options[RESET_MASK]) if options else None
        super().reset(seed=seed)
        return self._restart(self.np_random, is_chosen), {}

    @own_settings()
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Drive for one control step; `actions` [E] are integers of the action space."""
        reached = self._drive(actions)
        terminated, truncated = reached.is_terminated.numpy(), reached.is_truncated.numpy()
        info = self._final_info(reached, terminated | truncated)
        reward = reached.reward.numpy().astype(np.float64)
        return _shown(reached.observation), reward, terminated, truncated, info

    def _mask(self, mask: Any) -> torch.Tensor:
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not (is_mask and mask.any()):
            allowed = f"a NumPy array of {self.num_envs} bools, one of them true"
            raise UserError(f"options.{RESET_MASK} must be {allowed}, got {_in_one_line(mask)}")
        return torch.from_numpy(mask)

    def _final_info(self, reached: Transition, is_done: np.ndarray) -> dict[str, Any]:
        """gymnasium's layout: `final_obs` and `final_info` with masks `_final_obs` and `_final_info`."""
        if not is_done.any():
            return {}
        final_obs = np.full(self.num_envs, None, dtype=object)
        final = _shown(reached.final_observation)
        for row, world in enumerate(is_done.nonzero()[0]):
            final_obs[world] = final[row]
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


def _shown(observation: torch.Tensor) -> np.ndarray:
    """Grids of 0 and 255 from grids of 0 and 1; rows of numbers are shown as they are, copied."""
    return (observation * (OCCUPIED if observation.dtype == torch.uint8 else 1)).numpy()


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode is not None:
        raise UserError(f"render_mode must be None, got {_in_one_line(render_mode)}")


def _check_options(options: dict[str, Any] | None, *allowed: str) -> None:
    for key in options or {}:
        if key not in allowed:
            raise UserError(f"options must be {' or '.join(allowed) or 'empty'}, got the key {_in_one_line(key)}")


def _in_one_line(value: Any) -> str:
    return abbreviate(" ".join(repr(value).split()))


gymnasium.register(
    ENV_ID,
    entry_point="negopipe.envs.gymnasium:NarrowLaneEnv",
    vector_entry_point="negopipe.envs.gymnasium:NarrowLaneVectorEnv",
)
