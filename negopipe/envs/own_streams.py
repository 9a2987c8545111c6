"""Tasks of worlds that have a stream of tasks each, as if each were an environment of its own."""

import torch
from torch import Tensor

from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task


class OwnStreams:
    """Source of the tasks of E worlds (`negopipe.game.environment.TaskSource`), with a generator for each world."""

    def __init__(self, sampler: TaskSampler, n_worlds: int) -> None:
        self.sampler = sampler
        self.generators = [torch.Generator() for _ in range(n_worlds)]

    def seed(self, world: int, number: int) -> None:
        """Begin the stream of a world anew."""
        self.generators[world].manual_seed(number)

    def expect(self, n: int) -> None:
        """Nothing to prepare: every world has a stream of its own."""

    def draw_for(self, worlds: Tensor) -> Task:
        """Draw the next task of each of the worlds [n] int64."""
        return self.sampler.draw_each([self.generators[world] for world in worlds.tolist()])

    def get_state(self) -> Tensor:
        """[E, bytes] uint8: states of the streams."""
        return torch.stack([generator.get_state() for generator in self.generators])

    def set_state(self, state: Tensor) -> None:
        """Restore what `get_state` returned."""
        for generator, own in zip(self.generators, state, strict=True):
            generator.set_state(own.clone())  # torch reads from the start of the storage
