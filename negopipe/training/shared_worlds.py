"""The worlds of a training, of which every rank steps a share."""

from torch import Tensor

from negopipe.learning.rollout import RunningEpisodes
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task
from negopipe.tensors.prefixes import add_prefix, strip_prefix
from negopipe.tensors.ranks import Ranks
from negopipe.tensors.share import Share
from negopipe.tensors.tree import map_tensors, named_tensors, with_tensors

SEEN, TASKS = "observation", "tasks"
"""Entries of an environment's state that are no fields of its worlds: a row per agent, and the stream of tasks."""


class SharedTasks:
    """Source of tasks (`negopipe.game.environment.TaskSource`) with one stream for the worlds of all ranks.

    The tasks are those that one process draws: at every step as many as worlds of all ranks want, in their order. Every
    rank draws all of them and keeps its own.
    """

    def __init__(self, sampler: TaskSampler, ranks: Ranks) -> None:
        self.sampler, self._ranks = sampler, ranks

    def expect(self, n: int) -> None:
        """Draw the tasks of this step; collective."""
        counts = self._ranks.each(n)
        first = sum(counts[: self._ranks.index])
        if sum(counts) > 0:
            self._next = map_tensors(lambda field: field[first : first + n], self.sampler.draw(sum(counts)))

    def draw_for(self, worlds: Tensor) -> Task:
        """The tasks of this step that are for this rank's `worlds` [n] int64."""
        return self._next

    def get_state(self) -> Tensor:
        """State of the stream, uint8."""
        return self.sampler.get_state()

    def set_state(self, state: Tensor) -> None:
        """Restore what `get_state` returned."""
        self.sampler.set_state(state)


def joined(env: dict[str, Tensor], running: RunningEpisodes, worlds: Share) -> dict[str, Tensor]:
    """State of all ranks' worlds, as that of one process; collective.

    env: state of this rank's environment
    running: its unfinished episodes
    """
    seen, tasks = env[SEEN], env[TASKS]
    by_world = {name: each for name, each in env.items() if name not in (SEEN, TASKS)}
    episodes = add_prefix("running", named_tensors(running))
    state = worlds.gather(add_prefix("env", by_world) | episodes)
    agents = worlds.repeated(len(seen) // len(running.n_steps))
    return state | agents.gather({f"env/{SEEN}": seen}) | {f"env/{TASKS}": tasks}


def own(state: dict[str, Tensor], running: RunningEpisodes, worlds: Share) -> tuple[dict[str, Tensor], RunningEpisodes]:
    """State of this rank's environment and its unfinished episodes, from what `joined` returned."""
    env, episodes = strip_prefix("env", state), strip_prefix("running", state)
    agents = worlds.repeated(len(env[SEEN]) // len(episodes["n_steps"]))
    share = {name: worlds if name != SEEN else agents for name in env if name != TASKS}
    kept = {name: each.own(env[name]) for name, each in share.items()} | {TASKS: env[TASKS]}
    return kept, with_tensors(running, {name: worlds.own(each) for name, each in episodes.items()})
