"""Training by several ranks is that of one process: the same tasks, draws and episodes, and weights up to rounding."""

from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from composed import compose_config
from rank_threads import in_ranks
from torch import Generator, Tensor

from negopipe.config.root import RunConfig
from negopipe.runtime.build import build, save_policy
from negopipe.tensors.ranks import Ranks
from negopipe.tracking.snapshots import Snapshots
from negopipe.training.training import Training

SMALL = (
    "+experiment=smoke",
    "device=cpu",
    "n_threads=1",
    "algorithm.n_worlds=6",
    "algorithm.minibatch_size=20",
    "scenario.episode_steps=5",  # so that tasks are drawn in every iteration, by some ranks more than by others
)
OBJECTS = ("policy=objects", "observation=objects")
LEAGUE = (
    "population/driver=[planner,self,league]",
    "population.drivers.league.driver.every_iterations=1",
    "scenario.n_social=2",
    "curriculum.hard_share=0.3",
    "algorithm.n_epochs=2",
)
ROUNDING = 2e-5
"""Largest difference of a weight after an iteration. Sums of some hundred float32 numbers in another order differ by
1e-6 of their size; the inverses of the Fisher matrix, or Adam's division by the gradient's own size, make more of it.
The tests ask for weights that have moved fifty times as far."""
ULP = 1.2e-7


class Trained(NamedTuple):
    """State of a training after its iterations; moved: largest change of a weight since its start."""

    weights: dict[str, Tensor]
    episodes: dict[str, Tensor]
    rows: list[dict]
    moved: float


def trained(
    config: RunConfig, number: int, n_iterations: int, folder: Path | None = None, nudge: int | None = None
) -> Trained:
    """Result of so many ranks, which hold the same bits; they resume from the snapshots in `folder` and leave one.

    nudge: seed of changes of the first weights by less than a unit in the last place; None = no changes
    """
    build(config)  # its game is shared by the threads

    def work(ranks: Ranks) -> Trained:
        training = Training(config, None, ranks)
        start = {name: weight.detach().clone() for name, weight in training.policy.named_parameters()}
        snapshots = Snapshots(folder, 1) if folder is not None and ranks.is_first else None
        training.resume(snapshots)
        if nudge is not None:
            with torch.no_grad():
                random = Generator().manual_seed(nudge)
                for weight in training.policy.parameters():
                    weight.mul_(1 + ULP * (2 * torch.rand(weight.shape, generator=random) - 1))
        for _ in range(n_iterations):
            training.iterate()
        training.save_to(snapshots)
        weights = training.policy.state_dict()
        moved = max(float((weights[name] - weight).abs().max()) for name, weight in start.items())
        return Trained(weights, training.curve.episodes, training.curve.rows, moved)

    first, *others = in_ranks(number, work)
    for other in others:
        assert all(torch.equal(other.weights[name], weight) for name, weight in first.weights.items())
        assert all(torch.equal(other.episodes[n], e) or e.isnan().any() for n, e in first.episodes.items())
    return first


def distance(result: Trained, expected: Trained) -> float:
    """Largest difference of a weight."""
    return max(float((result.weights[name] - weight).abs().max()) for name, weight in expected.weights.items())


def assert_alike(result: Trained, expected: Trained, rounding: float = ROUNDING) -> None:
    assert expected.moved > 50 * rounding
    assert distance(result, expected) < rounding
    assert result.episodes.keys() == expected.episodes.keys()
    for name, values in expected.episodes.items():
        torch.testing.assert_close(result.episodes[name], values, equal_nan=True)
    for own, other in zip(result.rows, expected.rows, strict=True):
        for name in ("stage", "decisions", "success_rate", "policy_loss", "value_loss", "explained_variance"):
            assert own[name] == pytest.approx(other[name], abs=1e-3, nan_ok=True)


def test_two_ranks_train_with_kfac_as_one_process_does() -> None:
    config = compose_config([*SMALL, *OBJECTS, "algorithm.minibatch_size=3", "algorithm.n_steps=4"])
    assert_alike(trained(config, 2, 1), trained(config, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 4])
@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("algorithm.minibatch_size=3", "algorithm.n_steps=4"),  # some ranks have no decision of a minibatch
        ("algorithm=acktr_adam",),
        (*OBJECTS, "algorithm=a2c"),
        (*OBJECTS, *LEAGUE, "algorithm=ppo"),
        (*OBJECTS, *LEAGUE, "algorithm=acktr"),
    ],
    ids=lambda overrides: " ".join(overrides) or "acktr",
)
def test_any_number_of_ranks_trains_as_one_process_does(number: int, overrides: tuple[str, ...]) -> None:
    config = compose_config([*SMALL, *overrides])
    whole = trained(config, 1, 3)
    nudged = [distance(trained(config, 1, 3, nudge=seed), whole) for seed in range(3)]
    assert_alike(trained(config, number, 3), whole, max(ROUNDING, 10 * max(nudged)))


@pytest.mark.slow
def test_ranks_learn_from_the_demonstrations_that_one_process_finds() -> None:
    sizes = {"n_tasks": 1, "rounds": 1, "population": 2, "n_decisions": 9}
    few = [f"curriculum.demonstrations.{name}={n}" for name, n in sizes.items()]
    config = compose_config([*SMALL, *OBJECTS, "curriculum=demonstrations", *few])
    assert_alike(trained(config, 2, 1), trained(config, 1, 1))


@pytest.mark.slow
def test_ranks_learn_from_a_teacher_as_one_process_does(tmp_path: Path) -> None:
    config = compose_config([*SMALL, *OBJECTS, *LEAGUE])
    save_policy(tmp_path / "teacher.safetensors", build(config)[1], config, 0)
    wanted = f"curriculum.teacher={{checkpoint: {tmp_path / 'teacher.safetensors'}, until: 0.5}}"
    config = compose_config([*SMALL, *OBJECTS, *LEAGUE, "seed=2", wanted])
    assert_alike(trained(config, 2, 2), trained(config, 1, 2))


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 3])
def test_any_number_of_ranks_resumes_what_others_began(tmp_path: Path, number: int) -> None:
    config = compose_config([*SMALL, *OBJECTS, *LEAGUE])
    whole = trained(config, 2, 4)
    trained(config, 2, 2, tmp_path)
    resumed = trained(config, number, 2, tmp_path)
    assert distance(resumed, whole) < whole.moved / 50
    assert len(resumed.rows) == 4
    if number == 2:
        assert all(torch.equal(resumed.weights[name], weight) for name, weight in whole.weights.items())
