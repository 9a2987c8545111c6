"""Tasks come from the configured distributions, and from streams of their own."""

from dataclasses import replace

import pytest
import torch
from games import MIXTURE, draw_tasks

from negopipe.config import RunConfig
from negopipe.errors import UserError
from negopipe.seeding import generator
from negopipe.simulation.scenario import Families, StyleSwitchConfig, TaskSampler, pair_styles
from negopipe.simulation.state import EGO, Task


def draw(config: RunConfig, families: Families, n: int) -> Task:
    return TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(n)


def test_families_have_their_distances_and_styles(config: RunConfig) -> None:
    sampler = TaskSampler(config.scenario, config.evaluated_families, torch.Generator().manual_seed(0))
    task = sampler.draw(2000)
    for index, family in enumerate(sampler.families.values()):
        is_family = task.family == index
        low, high = family.start_distance_m
        social = task.start_distance[is_family, 1]
        assert low <= float(social.min()) < low + 0.05
        assert high - 0.05 < float(social.max()) <= high
        assert set(task.style_horizon[is_family, 1].tolist()) == set(family.style_horizon_s)
        assert 0.45 < float(is_family.float().mean()) < 0.55
    assert task.style_horizon[:, EGO].isnan().all()
    assert (task.start_distance[:, EGO] == 13.35).all()
    assert torch.equal(task.start_speed, torch.full_like(task.start_speed, 4.8))
    assert torch.equal(task.desired_speed, torch.full_like(task.desired_speed, 6.0))


def test_every_style_of_a_mixture_is_drawn(config: RunConfig) -> None:
    styles = draw_tasks(config, 1000).style_horizon[:, 1]
    for style in (0.0, 2.0, 4.0, 6.0):
        assert 0.2 < float((styles == style).float().mean()) < 0.3


def test_literal_pairing_swaps_the_styles(config: RunConfig) -> None:
    families = config.scenario.families
    swapped = pair_styles(families, "literal")
    assert swapped["push"].style_horizon_s == families["yield"].style_horizon_s
    assert swapped["yield"].style_horizon_s == families["push"].style_horizon_s
    assert swapped["push"].start_distance_m == families["push"].start_distance_m
    assert pair_styles(families, "ego_behaviour") == families
    assert pair_styles(MIXTURE, "literal") == MIXTURE


def test_literal_pairing_swaps_the_switches_too(config: RunConfig) -> None:
    switch = StyleSwitchConfig([6.0], (1.0, 2.0), None)
    families = dict(config.scenario.families)
    families["push"] = replace(families["push"], style_switch=switch)
    swapped = pair_styles(families, "literal")
    assert swapped["push"].style_switch is None
    assert swapped["yield"].style_switch == switch


def test_switches_are_drawn_from_their_intervals(config: RunConfig) -> None:
    families = config.scenario.families
    task = draw(config, {name: families[name] for name in ("mixture", "mixture_switching")}, 2000)
    is_fixed = task.family == 0
    for field in (task.switch_time, task.patience):
        assert field[is_fixed].isinf().all()
        assert field[:, EGO].isinf().all()
    assert task.next_style_horizon[is_fixed].isnan().all()
    assert task.next_style_horizon[:, EGO].isnan().all()
    for values, low, high in ((task.switch_time, 2, 8), (task.patience, 2, 6)):
        drawn = values[~is_fixed, 1]
        assert low <= float(drawn.min()) < low + 0.1
        assert high - 0.1 < float(drawn.max()) <= high
    for style in (0.0, 2.0, 4.0, 6.0):
        assert 0.2 < float((task.next_style_horizon[~is_fixed, 1] == style).float().mean()) < 0.3
    together = torch.corrcoef(torch.stack([task.style_horizon, task.next_style_horizon])[:, ~is_fixed, 1])
    assert abs(float(together[0, 1])) < 0.1


def test_a_cause_that_is_null_never_comes(config: RunConfig) -> None:
    for at_s, stuck_s in (((2.0, 2.0), None), (None, (3.0, 3.0))):
        family = replace(MIXTURE["mixture"], style_switch=StyleSwitchConfig([4.0], at_s, stuck_s))
        task = draw(config, {"one": family}, 5)
        assert (task.switch_time[:, 1] == (2.0 if at_s else torch.inf)).all()
        assert (task.patience[:, 1] == (3.0 if stuck_s else torch.inf)).all()
        assert (task.next_style_horizon[:, 1] == 4.0).all()


def test_as_many_random_values_whatever_is_drawn(config: RunConfig) -> None:
    families = config.scenario.families
    after = []
    for name in ("yield", "mixture", "mixture_switching"):
        sampler = TaskSampler(config.scenario, {name: families[name]}, torch.Generator().manual_seed(0))
        sampler.draw(7)
        after.append(float(torch.rand(1, generator=sampler.generator)))
    assert len(set(after)) == 1


def test_start_intervals_act(config: RunConfig) -> None:
    scenario = replace(
        config.scenario,
        ego_start_distance_m=(10.0, 12.0),
        start_speed_mps=(1.0, 2.0),
        desired_speed_mps=(3.0, 4.0),
    )
    task = TaskSampler(scenario, MIXTURE, torch.Generator().manual_seed(0)).draw(500)
    for values, low, high in (
        (task.start_distance[:, EGO], 10, 12),
        (task.start_speed, 1, 2),
        (task.desired_speed, 3, 4),
    ):
        assert low <= float(values.min()) < low + 0.1
        assert high - 0.1 < float(values.max()) <= high


def test_social_vehicles_queue(three_social_config: RunConfig) -> None:
    task = draw_tasks(three_social_config, 10)
    gaps = task.start_distance[:, 1:].diff(dim=1)
    torch.testing.assert_close(gaps, torch.full_like(gaps, three_social_config.scenario.social_spacing_m))
    assert task.direction.tolist() == [[1.0, -1.0, -1.0, -1.0]] * 10


def test_streams_depend_on_seed_and_purpose() -> None:
    def first(seed: int, purpose: str) -> float:
        return float(torch.rand(1, generator=generator(seed, purpose)))

    assert first(1, "training tasks") == first(1, "training tasks")
    draws = {first(seed, purpose) for seed in (1, 2, 12) for purpose in ("training tasks", "held-out tasks push")}
    assert len(draws) == 6


def test_no_family_is_an_error(config: RunConfig) -> None:
    with pytest.raises(UserError, match="at least one task family"):
        TaskSampler(config.scenario, {}, torch.Generator())
