"""Tasks for tests that drive."""

import torch

from negopipe.config import RunConfig
from negopipe.simulation.scenario import FamilyConfig, TaskSampler
from negopipe.simulation.state import Task

MIXTURE = {"mixture": FamilyConfig(1.0, (11.99, 18.80), [0.0, 2.0, 4.0, 6.0], None)}


def draw_tasks(config: RunConfig, n: int, seed: int = 0) -> Task:
    return TaskSampler(config.scenario, MIXTURE, torch.Generator().manual_seed(seed)).draw(n)
