"""The game as a parallel environment of PettingZoo: every vehicle is an agent; needs the extra `pettingzoo`.

    import negopipe
    env = negopipe.make_parallel_env(["scenario.n_social=2"])
    observations, infos = env.reset(seed=1)
    observations, rewards, terminations, truncations, infos = env.step({agent: 1 for agent in env.agents})

Observations, actions, tasks and `overrides` are those of `negopipe.envs.gymnasium`, but for the population: the actions
drive every vehicle. An agent observes what its vehicle perceives. The agents are `ego`, `social_1`, `social_2` and so
on: first those that come towards the ego, the nearest one first, then those behind it. Every decision pays each agent
`reward.step`, a collision of its vehicle `reward.collision`, and the success of all pays each `reward.success`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.utils.seeding import np_random
from pettingzoo import ParallelEnv

from negopipe.envs.given_task import TASK
from negopipe.envs.rendering import MODES, View, fps
from negopipe.envs.self_play import self_play_config
from negopipe.envs.worlds import MOST, Worlds, shown
from negopipe.errors import UserError
from negopipe.tensors.torch_settings import own_settings


def make_parallel_env(overrides: Sequence[str] = (), render_mode: str | None = None) -> "NarrowLaneParallelEnv":
    """One world in which every vehicle is an agent.

    overrides: those of the command line that an environment depends on, `["scenario.n_social=2"]`
    render_mode: None, rgb_array or human
    """
    return NarrowLaneParallelEnv(overrides, render_mode)


class NarrowLaneParallelEnv(ParallelEnv[str, np.ndarray, np.int64]):
    """One world; `infos` at the episode's end hold what those of `NarrowLaneEnv` do, of the ego.

    An agent whose vehicle has collided is terminated and sees nothing more. Its vehicle stands still while the others
    drive on.
    overrides, render_mode: as for `NarrowLaneEnv`
    """

    metadata: dict[str, Any] = {"name": "narrow_lane_v0", "render_modes": MODES}  # noqa: RUF012

    @own_settings()
    def __init__(self, overrides: Sequence[str] = (), render_mode: str | None = None) -> None:
        self._worlds = Worlds(self_play_config(overrides), 1, is_self_play=True)
        self._view, self.render_mode = View(self._worlds, render_mode), render_mode
        self.metadata = {**self.metadata, "render_fps": fps(self._worlds)}
        self.possible_agents = ["ego", *(f"social_{i + 1}" for i in range(self._worlds.config.scenario.n_others))]
        self.agents: list[str] = []
        spaces = {agent: self._worlds.spaces() for agent in self.possible_agents}
        self.observation_spaces = {agent: own[0] for agent, own in spaces.items()}
        self.action_spaces = {agent: own[1] for agent, own in spaces.items()}
        self._is_seeded = False

    def observation_space(self, agent: str) -> Box:
        """The same space at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """The same space at every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        """Start the next task of the stream of the seed, or of the one before.

        options: `task` as for `NarrowLaneEnv`; others have no effect, since PettingZoo's own test hands some over
        """
        stream = None if seed is None and self._is_seeded else int(np_random(seed)[0].integers(MOST))
        self._worlds.begin_next(stream, (options or {}).get(TASK))
        self._is_seeded = True
        self.agents = list(self.possible_agents)
        self._view.show()
        return self._by_agent(self._worlds.observe()), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Drive for one control step; `actions` has an integer for each of `agents`."""
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise UserError(f"actions must have one for each of {', '.join(self.agents)}, got none for {missing[0]}")
        given = [actions[agent] if agent in self.agents else 0 for agent in self.possible_agents]
        reached = self._worlds.step(np.asarray(given))
        observation = shown(reached.observation)
        observation[(reached.is_terminated | reached.is_truncated).numpy()] = shown(reached.final_observation)
        end = self._worlds.ended.get(0)
        infos = {agent: {} if end is None else dict(end.info) for agent in self.agents}
        by_agent = self._by_agent
        terminations = by_agent(reached.is_terminated.tolist())
        truncations = by_agent(reached.is_truncated.tolist())
        outcome = by_agent(observation), by_agent(reached.reward.tolist()), terminations, truncations, infos
        self.agents = [agent for agent in self.agents if not (terminations[agent] or truncations[agent])]
        self._view.show()
        return outcome

    def render(self) -> np.ndarray | None:
        """The present state as a picture [H, W, 3] uint8; None where a window shows it."""
        return self._view.picture()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._view.close()

    def state(self) -> np.ndarray:
        """[V, *obs]: the observations of all vehicles."""
        return self._worlds.observe()

    def _by_agent(self, values: Any) -> dict[str, Any]:
        """Of values of all vehicles, those of `agents`."""
        return {agent: value for agent, value in zip(self.possible_agents, values, strict=True) if agent in self.agents}
