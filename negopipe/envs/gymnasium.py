"""The game as gymnasium environments, single and vectorised; docs/environments.md says what they do.

    import negopipe
    env = negopipe.make_env(["scenario.n_social=2"], render_mode="rgb_array")
    envs = negopipe.make_vec_env(64)

or by their ids, see `negopipe.envs.registration`:

    import gymnasium, negopipe
    env = gymnasium.make("negopipe/Push-v0", overrides=["scenario.n_social=2"])
    envs = gymnasium.make_vec("negopipe/Push-v0", num_envs=64)

Observations are the occupancy grids, uint8, 0 = free and 255 = occupied, as image policies expect them, or with the
overrides observation=objects and policy=objects a row of numbers, float32, for policies of vectors. Actions are indices
into `policy.horizons_s`. Tasks are drawn from the families that `evaluation.settings` names. `overrides` are
those of the command line that change one of these.

An episode depends on overrides, seed and actions only, not on the process's settings of torch, NumPy or Hydra, which
stay as they are. World i of a vector environment with the seed s drives the episodes of a single one with the seed
s + i. Environments may be built in forked processes.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from negopipe.envs.given_task import TASK
from negopipe.envs.overrides import check_options, config_of, in_one_line
from negopipe.envs.registration import ENV_ID
from negopipe.envs.rendering import MODES, Camera, View, fps
from negopipe.envs.self_play import self_play_config
from negopipe.envs.worlds import MOST, Worlds, shown
from negopipe.errors import UserError
from negopipe.tensors.torch_settings import own_settings

RESET_MASK = "reset_mask"
"""gymnasium's name of the option of `reset` that selects the worlds in which a new task starts."""


def make_env(overrides: Sequence[str] = (), render_mode: str | None = None) -> gymnasium.Env[np.ndarray, np.int64]:
    """One world, `NarrowLaneEnv`, made by `gymnasium.make`: with its `spec` and gymnasium's usual wrappers.

    overrides: those of the command line that an environment depends on, `["+experiment=yield"]`
    render_mode: None, rgb_array or human
    """
    return gymnasium.make(ENV_ID, render_mode=render_mode, overrides=overrides)


def make_vec_env(
    num_envs: int, overrides: Sequence[str] = (), render_mode: str | None = None, is_self_play: bool = False
) -> gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]:
    """`num_envs` worlds in one batched program, `NarrowLaneVectorEnv`, made by `gymnasium.make_vec`.

    overrides: as for `make_env`
    render_mode: None or rgb_array
    is_self_play: every vehicle of a world is one of the `num_envs` environments
    """
    given: dict[str, Any] = {"overrides": overrides, "render_mode": render_mode, "is_self_play": is_self_play}
    return gymnasium.make_vec(ENV_ID, num_envs=num_envs, vectorization_mode="vector_entry_point", **given)


class NarrowLaneEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One world. `info` at an episode's end holds `is_success`, `is_collision` and `episode_record.METRICS`.

    overrides: those of the command line, `("scenario.n_social=2",)`; UserError names one that is wrong or has no effect
    render_mode: None; rgb_array = `render` returns a picture; human = a window shows every state in real time
    preset: overrides of the environment's id, which come first
    """

    metadata: dict[str, Any] = {"render_modes": MODES}  # noqa: RUF012 (gymnasium's own declaration)

    @own_settings()
    def __init__(
        self, overrides: Sequence[str] = (), render_mode: str | None = None, preset: Sequence[str] = ()
    ) -> None:
        self._worlds, self.render_mode = Worlds(config_of(overrides, preset), n_worlds=1), render_mode
        self._view = View(self._worlds, render_mode)
        self.metadata = {**self.metadata, "render_fps": fps(self._worlds)}
        self.observation_space, self.action_space = self._worlds.spaces()
        self._is_seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start the next task of the stream of the seed, or of the one before.

        options: `{"task": {"street": 3}}` gives values of the task, see `negopipe.envs.given_task`
        """
        check_options(options, TASK)
        super().reset(seed=seed)
        is_new = seed is not None or not self._is_seeded
        self._worlds.begin_next(int(self.np_random.integers(MOST)) if is_new else None, (options or {}).get(TASK))
        self._is_seeded = True
        self._view.show()
        return self._worlds.observe()[0], {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Drive for one control step; `action` is an integer of the action space or an array of one."""
        reached = self._worlds.step(action)
        self._view.show()
        end = self._worlds.ended.get(0)
        observation = shown(reached.observation if end is None else reached.final_observation)[0]
        is_over = bool(reached.is_terminated), bool(reached.is_truncated)
        return observation, float(reached.reward), *is_over, {} if end is None else end.info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The present state as a picture [H, W, 3] uint8; None where a window shows it."""
        return self._view.picture()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._view.close()


class NarrowLaneVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """E worlds in one batched program, with autoreset in the same step and final observations in `info`.

    An environment is a world, or in self-play a vehicle of a world, which observes and is paid as an agent of
    `negopipe.envs.pettingzoo`: environment v E + e is vehicle v of world e. One whose vehicle has collided sees zeros
    and is paid nothing until the others' episode is over.
    num_envs: number of environments, E or V E
    overrides, preset: as for `NarrowLaneEnv`; in self-play nothing of the population
    render_mode: None; rgb_array = `render` returns a picture of every world
    max_episode_steps: gymnasium's name of a time limit below `scenario.episode_steps`; None = there is none
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    autoreset_mode = AutoresetMode.SAME_STEP
    """The same as gymnasium's own vector environments and TorchRL have it."""

    @own_settings()
    def __init__(
        self,
        num_envs: int = 1,
        overrides: Sequence[str] = (),
        render_mode: str | None = None,
        preset: Sequence[str] = (),
        max_episode_steps: int | None = None,
        is_self_play: bool = False,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode must be rgb_array or None, got {in_one_line(render_mode)}")
        if type(num_envs) is not int or num_envs < 1:
            raise UserError(f"num_envs must be an integer from 1, got {in_one_line(num_envs)}")
        config = (self_play_config if is_self_play else config_of)(overrides, preset)
        if max_episode_steps is not None:
            n_steps = min(config.scenario.episode_steps, max_episode_steps)
            config = replace(config, scenario=replace(config.scenario, episode_steps=n_steps))
        n_agents = config.scenario.n_vehicles if is_self_play else 1
        if num_envs % n_agents:
            raise UserError(f"num_envs must be a multiple of the {n_agents} vehicles of a world, got {num_envs}")
        self.num_envs, self.render_mode = num_envs, render_mode
        self._worlds = Worlds(config, num_envs // n_agents, is_self_play)
        self.metadata = {**self.metadata, "render_fps": fps(self._worlds)}
        spaces = self._worlds.spaces()
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(space, num_envs) for space in spaces)
        self._camera = Camera(config.planner.horizon_s)
        self._is_seeded = False

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start the next tasks in all worlds, each of a stream of its own.

        seed: of world 0, those of the others follow; or a list with one for each, None = its stream goes on
        options: `{"task": {...}}` as for one world; `{"reset_mask": [E] bool array}` starts new tasks in those worlds
            only, not in self-play
        """
        check_options(options, TASK, *(() if self._worlds.is_self_play else (RESET_MASK,)))
        options = options or {}
        which = self._chosen(options[RESET_MASK]) if RESET_MASK in options else list(range(self._worlds.n_worlds))
        seeds = self._streams(seed)
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._worlds.restart(which, [seeds[world] for world in which], options.get(TASK))
        self._is_seeded = True
        return self._worlds.observe(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Drive for one control step; `actions` [E] are integers of the action space."""
        is_driving = self._worlds.is_driving()
        reached = self._worlds.step(actions)
        terminated, truncated = reached.is_terminated.numpy(), reached.is_truncated.numpy()
        info: dict[str, Any] = {}
        over = (terminated | truncated).nonzero()[0].tolist()
        for env, final in zip(over, shown(reached.final_observation), strict=True):
            end = self._worlds.ended.get(env % self._worlds.n_worlds)  # None: the vehicle alone has collided
            info = self._add_info(info, {"final_obs": final, "final_info": {} if end is None else end.info}, env)
        reward = np.where(is_driving, reached.reward.numpy(), 0.0).astype(np.float64)
        return shown(reached.observation), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Pictures [H, W, 3] uint8 of the present states of all worlds; None without a render mode."""
        if self.render_mode is None:
            return None
        road, record = self._worlds.game.simulator.road, self._worlds.record
        return tuple(self._camera.picture(road, record.shot(world)) for world in range(self._worlds.n_worlds))

    def _streams(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Numbers that the streams of the worlds are seeded with; None = a stream goes on."""
        n = self._worlds.n_worlds
        seeds: Sequence[Any] = [seed + i for i in range(n)] if type(seed) is int else seed or [None] * n  # type: ignore[assignment]
        is_list = isinstance(seeds, Sequence) and len(seeds) == n
        if not is_list or not all(each is None or type(each) is int for each in seeds):
            raise UserError(f"seed must be an int or a list of {n} ints, got {in_one_line(seed)}")
        numbers = [None if each is None else int(np_random(each)[0].integers(MOST)) for each in seeds]
        if self._is_seeded:
            return numbers
        return [int(self.np_random.integers(MOST)) if number is None else number for number in numbers]

    def _chosen(self, mask: Any) -> list[int]:
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not (is_mask and mask.any()):
            allowed = f"a NumPy array of {self.num_envs} bools, one of them true"
            raise UserError(f"options.{RESET_MASK} must be {allowed}, got {in_one_line(mask)}")
        return [int(world) for world in mask.nonzero()[0]]
