"""The game as a reinforcement-learning environment: batched worlds whose actions are prediction horizons."""

import torch
from torch import Tensor

from negopipe.game.game import Game
from negopipe.game.reward import RewardConfig, reward
from negopipe.learning.rollout import Transition
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import NEAREST, World
from negopipe.tensors.prefixes import add_prefix, strip_prefix
from negopipe.tensors.tree import map_tensors, named_tensors, tree_where, with_tensors


class NegotiationEnv:
    """E worlds of one scenario; satisfies `negopipe.learning.rollout.Environment`.

    The ego's action is an index into `horizons_s`. Social vehicles drive in the styles of their tasks. A world whose
    episode is over starts a new task at once, drawn from `sampler`, which the curriculum replaces at stage ends.
    """

    def __init__(
        self,
        game: Game,
        reward_config: RewardConfig,
        horizons_s: tuple[float, ...],
        sampler: TaskSampler,
        n_worlds: int,
    ) -> None:
        self.game, self.reward_config, self.sampler, self.n_worlds = game, reward_config, sampler, n_worlds
        self.restart()
        self._horizons = torch.tensor(horizons_s, device=self.world.step.device)
        self.n_actions = len(horizons_s)

    def restart(self, is_chosen: Tensor | None = None) -> None:
        """Start a new task in every world, or in the chosen ones [E] bool only, which get the same tasks either way."""
        started = self.game.simulator.reset(self.sampler.draw(self.n_worlds))
        self.world: World = started if is_chosen is None else tree_where(is_chosen, started, self.world)
        self._observation = self.game.see(self.world)

    def observe(self) -> Tensor:
        """[E, *obs]: the present observations of the ego."""
        return self._observation

    def step(self, action: Tensor) -> Transition:
        """Drive every vehicle for one control step; `action` [E] int64 is the ego's."""
        world = self.world
        moved, events, reached = self.game.advance(world, self.game.choose(world, self._horizons[action]))
        which = (events.is_terminated | events.is_truncated).nonzero()[:, 0]
        final = self._start_again(moved, reached, which)
        return Transition(
            observation=self._observation,
            final_observation=final,
            reward=reward(self.reward_config, events.is_collision, events.is_success),
            is_terminated=events.is_terminated,
            is_truncated=events.is_truncated,
            is_success=events.is_success,
            is_collision=events.is_collision,
            final_info={
                "social_start_distance_m": world.task.start_distance[which, NEAREST],
                "style_horizon_s": world.task.style_horizon[which, NEAREST],
            },
        )

    def state_dict(self) -> dict[str, Tensor]:
        """State on which the next step depends: the worlds, their observations and the stream of tasks."""
        seen, tasks = self._observation, self.sampler.generator.get_state()
        return {**add_prefix("world", named_tensors(self.world)), "observation": seen, "tasks": tasks}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned; the sampler's families are not part of it."""
        self.world = with_tensors(self.world, strip_prefix("world", state))
        self._observation = state["observation"].to(self._observation.device)
        self.sampler.generator.set_state(state["tasks"])

    def _start_again(self, moved: World, reached: Tensor, which: Tensor) -> Tensor:
        """Continue from `moved`, with observations `reached` [E, *obs] and new tasks in the D worlds `which`.

        Returns the final observations of the D episodes that are over, [D, *obs].
        """
        self.world, self._observation = moved, reached
        final = reached[which]
        if len(which) > 0:
            started = self.game.simulator.reset(self.sampler.draw(len(which)))
            self.world = map_tensors(lambda field, new: field.index_copy(0, which, new), moved, started)
            reached.index_copy_(0, which, self.game.see(started))
        return final
