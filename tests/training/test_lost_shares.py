"""What is lost most is drawn more often: drivers and streets."""

from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.training.lost_shares import LEAST_LOST, LostShares
from negopipe.training.training import Training

SMALL = ["+experiment=smoke", "device=cpu", "compile='off'", "scenario=random_streets", "scenario.streets.n_training=3",
         "scenario.streets.n_held_out=1", "policy.encoder_width=16",
         "population/driver=[planner,give_way]", "scenario.episode_steps=12"]  # fmt: skip


def known(lost: list[bool]) -> LostShares:
    """Each of three was met a thousand times and always lost, or never."""
    found = LostShares(3, torch.device("cpu"))
    found.record(torch.arange(3).repeat(1000), ~torch.tensor(lost).repeat(1000))
    return found


def test_a_share_is_the_running_mean_of_what_is_lost() -> None:
    found = LostShares(2, torch.device("cpu"))
    assert found.shares.tolist() == [1, 1]
    found.record(torch.tensor([0, 0]), torch.tensor([True, True]))
    assert found.shares.tolist() == pytest.approx([0.99**2, 1])


def test_weights_follow_what_is_lost_as_far_as_is_asked() -> None:
    found, weights = known([True, False, False]), torch.tensor([1.0, 1.0, 2.0], dtype=torch.float64)
    assert found.weigh(weights, 0.0).tolist() == weights.tolist()
    lost = torch.tensor([1.0, LEAST_LOST, 2 * LEAST_LOST])
    expected = 0.5 * weights + 0.5 * 4 * lost / lost.sum()
    assert found.weigh(weights, 0.5).tolist() == pytest.approx(expected.tolist(), rel=1e-3)


def test_a_training_draws_lost_streets_and_drivers_more_often(tmp_path: Path) -> None:
    drawn = {}
    for hard_share in (0.0, 1.0):
        training = Training(compose_config([*SMALL, f"curriculum.hard_share={hard_share}"]), tmp_path)
        training.iterate()
        training._lost_streets.shares = known([False, False, True]).shares
        training.league.lost.shares = known([True, False, False]).shares[:2]
        training._select_task_distribution()
        task = training.env.sampler.draw_for(torch.zeros(3000))
        street, driver = task.direction[:, 0].abs().long() - 1, task.casting.driver[:, 1]
        drawn[hard_share] = [street.bincount(minlength=3) / 3000, driver.bincount(minlength=2) / 3000]
    assert drawn[0.0][0].tolist() == pytest.approx([1 / 3] * 3, abs=0.03)
    assert drawn[0.0][1].tolist() == pytest.approx([1 / 2] * 2, abs=0.03)
    assert drawn[1.0][0].tolist() == pytest.approx([0.0455, 0.0455, 0.909], abs=0.02)
    assert drawn[1.0][1].tolist() == pytest.approx([0.952, 0.048], abs=0.02)
