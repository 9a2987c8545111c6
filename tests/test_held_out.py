"""Training never sees what is evaluated: other random streams, and on the mixture other start distances."""

import pytest
import torch
from composed import compose_config

from negopipe.config.root import RunConfig
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import build_game
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.seeding import generator

N = 4000
NEAREST = 1


def training_tasks(config: RunConfig, stage: int) -> Task:
    """As `stages/train.py` draws them."""
    stream = generator(config.seed, "training tasks", torch.device("cpu"))
    scenario = config.curriculum.scenario(config.scenario)
    return TaskSampler(scenario, config.curriculum.stages[stage].families, stream).draw(N)


def held_out(config: RunConfig, setting: str) -> Task:
    return held_out_tasks(config, build_game(config), setting)


def distance(tasks: Task) -> torch.Tensor:
    return tasks.start_distance[:, NEAREST]


@pytest.mark.parametrize("setting", ["mixture", "mixture_switching"])
def test_the_mixture_is_evaluated_at_distances_that_training_leaves_out(setting: str) -> None:
    config = compose_config(["+experiment=mixture", f"evaluation.n_episodes={N}"])
    evaluated = distance(held_out(config, setting))
    for index, stage in enumerate(config.curriculum.stages):
        trained = distance(training_tasks(config, index))
        gaps = {tuple(family.gaps_m) for family in stage.families.values()}
        assert len(gaps) == 1
        (gaps_m,) = gaps
        assert len(gaps_m) >= 3
        for low, high in gaps_m:
            assert not ((trained > low) & (trained < high)).any()
        in_gaps = sum(((evaluated > low) & (evaluated < high)).float().mean() for low, high in gaps_m)
        assert in_gaps > 0.25
    assert evaluated.min() < 12.1
    assert evaluated.max() > 18.7


def test_only_training_starts_as_the_curriculum_says() -> None:
    starts = "{ego_start_distance_m: [13.0, 14.0], start_speed_mps: [4.0, 5.0]}"
    config = compose_config(["+experiment=yield", f"curriculum.starts={starts}", f"evaluation.n_episodes={N}"])
    trained, evaluated = training_tasks(config, 0), held_out(config, "yield")
    for field, (low, high) in ((trained.start_distance[:, EGO], (13.0, 14.0)), (trained.start_speed, (4.0, 5.0))):
        assert low <= field.min() < low + 0.01
        assert high - 0.01 < field.max() <= high
    assert (evaluated.start_distance[:, EGO] == 13.35).all()
    assert (evaluated.start_speed == 4.8).all()


@pytest.mark.parametrize("seed", [1, 20210311])
@pytest.mark.parametrize("setting", ["push", "yield"])
def test_no_training_seed_draws_the_evaluated_tasks(setting: str, seed: int) -> None:
    """Not even the one that is the evaluation's own."""
    config = compose_config(["+experiment=yield", f"seed={seed}", f"evaluation.n_episodes={N}"])
    evaluated = distance(held_out(config, setting))
    trained = distance(training_tasks(config, len(config.curriculum.stages) - 1))
    n_shared = torch.isin(evaluated, trained).sum()
    assert n_shared < 0.02 * N  # some of 2^24 values meet by chance
