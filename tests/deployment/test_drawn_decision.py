"""Horizons that are drawn: by the simulator's numbers, recorded, and the same when a drive is driven again."""

import math

import numpy as np
import pytest
import torch
from games import draw_tasks
from runtime_drives import GENERALIST, drive_in_simulator, drive_with_runtime, negotiator, parts, places

from negopipe.agents.horizon_drivers import draw_of
from negopipe.config.root import as_mapping
from negopipe.deployment import Trajectory
from negopipe.deployment.draws import draw
from negopipe.deployment.negotiator import Negotiator
from negopipe.deployment.settings import Settings
from negopipe.errors import UserError
from negopipe.policy.actor_critic import action_of_draw

DRAWN = (*GENERALIST, "evaluation.action=sample")


def drive(seed: int) -> list[Trajectory]:
    """The generalist's drive of a task, its horizons drawn by a seed."""
    return drive_with_runtime(negotiator(*DRAWN, seed=seed), 8, *DRAWN, seed=0)[1]


def horizons(said: list[Trajectory]) -> list[float]:
    return [each.horizon_s for each in said]


def test_numbers_are_those_of_the_simulator() -> None:
    seeds, decisions = torch.tensor([0, 1, 12_888_623, 2**24 - 1]), torch.arange(50)[:, None]
    ours = [[np.float32(draw(seed, number)) for seed in seeds.tolist()] for number in range(50)]
    np.testing.assert_array_equal(np.array(ours), draw_of(seeds, decisions).numpy())


def test_an_action_is_drawn_by_its_share_of_the_numbers() -> None:
    logits = torch.tensor([0.1, 0.0, 0.6, 0.3]).log().expand(1000, 4)
    found = action_of_draw(logits, (torch.arange(1000) + 0.5) / 1000)
    assert found.bincount(minlength=4).tolist() == [100, 0, 600, 300]
    assert action_of_draw(logits[:1], torch.ones(1)).tolist() == [3]


def test_the_runtime_draws_as_an_evaluation_does() -> None:
    config = parts(*DRAWN)[0]
    worlds, said = drive_with_runtime(
        negotiator(*DRAWN, seed=int(draw_tasks(config, 1, 0).noise_seed[0])), 16, *DRAWN, seed=0
    )
    np.testing.assert_allclose(places(worlds), places(drive_in_simulator(16, *DRAWN, seed=0)), atol=1e-3)
    likely = [max(each.diagnostics.probabilities.items(), key=lambda item: item[1])[0] for each in said]
    assert sum(one != two for one, two in zip(likely, horizons(said), strict=True)) >= 3


def test_a_seed_decides_the_drive() -> None:
    first = drive(3)
    again, other = drive(3), drive(4)
    assert [each.states.tobytes() for each in first] == [each.states.tobytes() for each in again]
    assert horizons(first) != horizons(other)
    drawn = [np.float32(draw(3, number)) for number in range(len(first))]
    assert [each.diagnostics.draw for each in first] == drawn


def test_the_most_probable_horizon_needs_no_number() -> None:
    assert math.isnan(drive_with_runtime(negotiator(), 1, seed=0)[1][0].diagnostics.draw)


@pytest.mark.parametrize(
    ("override", "is_drawn"), [("evaluation.action=sample", True), ("export.action=greedy", False)]
)
def test_an_export_draws_as_its_evaluation_unless_it_is_told_otherwise(override: str, is_drawn: bool) -> None:
    config = parts("evaluation.action=sample", override)[0]
    assert Settings.of(as_mapping(config)).is_drawn == is_drawn


def test_a_seed_below_zero_is_refused() -> None:
    with pytest.raises(UserError, match="seed must be a whole number from 0, got -1"):
        Negotiator(Settings.of(as_mapping(parts()[0])), lambda arguments: {}, lambda tables: {}, seed=-1)
