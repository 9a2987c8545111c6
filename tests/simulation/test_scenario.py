"""Tasks come from the configured distributions, and from streams of their own."""

from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import MIXTURE, draw_tasks
from hypothesis import example, given, settings
from hypothesis import strategies as st

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.simulation.scenario import Families, FamilyConfig, StyleSwitchConfig, TaskSampler, pair_styles
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.seeding import generator

Span = tuple[float, float]


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
    names = ("yield", "mixture", "mixture_switching")
    after = []
    for family in (*(config.scenario.families[name] for name in names), gapped([(12.0, 13.0), (14.0, 18.0)])):
        sampler = TaskSampler(config.scenario, {"one": family}, torch.Generator().manual_seed(0))
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


def gapped(gaps_m: list[Span], start_distance_m: Span = (11.99, 18.80)) -> FamilyConfig:
    return replace(MIXTURE["mixture"], start_distance_m=start_distance_m, gaps_m=gaps_m)


def distances(config: RunConfig, family: FamilyConfig, n: int = 10_000) -> torch.Tensor:
    """[n] float32, m, drawn with the same chances for every family."""
    return draw(config, {"one": family}, n).start_distance[:, 1]


def distances_at(config: RunConfig, family: FamilyConfig, chances: list[float]) -> list[float]:
    """Drawn with these chances."""
    column = torch.tensor(chances)[:, None]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "rand", lambda *size, **_: column.expand(size))
        return distances(config, family, len(chances)).tolist()


GAPS = [
    [],
    [(13.0, 14.5)],
    [(11.99, 12.5), (13.1, 13.3), (15.0, 18.2)],
    [(12.0, 13.0), (13.0, 14.0), (17.3, 18.80)],
    [(14.0, 14.0), (16.0, 16.001)],
]


def is_inside(values: torch.Tensor, gap: Span) -> torch.Tensor:
    low, high = torch.tensor(gap)
    return (low < values) & (values < high)


@pytest.mark.parametrize("gaps", GAPS)
def test_gaps_are_left_out_and_the_rest_is_uniform(config: RunConfig, gaps: list[Span]) -> None:
    drawn = distances(config, gapped(gaps))
    assert not any(is_inside(drawn, gap).any() for gap in gaps)
    pieces = gapped(gaps).pieces_m
    total = sum(high - low for low, high in pieces)
    for low, high in pieces:
        for part in (0.25, 0.5, 1.0):  # of the piece, from its beginning
            share = float(((drawn >= low - 1e-5) & (drawn <= low + part * (high - low) + 1e-5)).float().mean())
            assert share == pytest.approx(part * (high - low) / total, abs=0.02)


@pytest.mark.parametrize("gaps", GAPS)
def test_a_draw_moves_up_by_the_gaps_that_it_has_reached(config: RunConfig, gaps: list[Span]) -> None:
    chances = distances(config, gapped([], (0.0, 1.0)), 500).tolist()
    expected = []
    for chance in chances:
        distance = 11.99 + (18.80 - 11.99 - sum(high - low for low, high in gaps)) * chance
        for low, high in gaps:
            distance += high - low if distance >= low else 0.0
        expected.append(distance)
    assert distances(config, gapped(gaps), 500).tolist() == pytest.approx(expected, abs=1e-5)


def test_without_gaps_the_values_are_exactly_those_of_the_plain_interval(config: RunConfig) -> None:
    chance = distances(config, gapped([], (0.0, 1.0)))
    for interval in ((11.99, 18.80), (0.3, 900.1), (12.0, 12.0)):
        low, high = torch.tensor(interval)
        assert torch.equal(distances(config, gapped([], interval)), low + (high - low) * chance)
    few = distances(config, gapped([(12.0, 14.0)]))
    together = draw(config, {"none": gapped([]), "one": gapped([(12.0, 14.0)])}, 10_000)
    alone = torch.where(together.family == 0, distances(config, gapped([])), few)
    assert torch.equal(together.start_distance[:, 1], alone)


def test_families_have_gaps_of_their_own(config: RunConfig) -> None:
    families = {str(index): gapped(gaps) for index, gaps in enumerate(GAPS)}
    task = draw(config, families, 10_000)
    for index, gaps in enumerate(GAPS):
        drawn = task.start_distance[task.family == index, 1]
        assert not any(is_inside(drawn, gap).any() for gap in gaps)
        for low, high in families[str(index)].pieces_m:
            assert (is_inside(drawn, (low, high)).any()) == (high - low > 0.005)


@pytest.mark.parametrize(
    ("gaps", "same_as"),
    [
        ([(8.0, 10.3)], (10.3, 16.0)),
        ([(10.3, 16.0)], (8.0, 10.3)),
        ([(8.0, 9.1), (9.1, 10.3), (14.7, 16.0)], (10.3, 14.7)),
        ([(12.0, 12.0)], (8.0, 16.0)),
    ],
)
def test_a_gap_at_an_end_is_a_shorter_interval(config: RunConfig, gaps: list[Span], same_as: Span) -> None:
    assert torch.equal(distances(config, gapped(gaps, (8.0, 16.0))), distances(config, gapped([], same_as)))


def test_draws_on_the_ends_of_gaps(config: RunConfig) -> None:
    family = gapped([(9.0, 10.0), (11.0, 14.0)], (8.0, 16.0))
    just_below = 2.0**-18
    chances = [0.0, 0.25 - just_below, 0.25, 0.5 - just_below, 0.5, 1.0]
    drawn = distances_at(config, family, chances)
    assert drawn == [8.0, 9.0 - 4 * just_below, 10.0, 11.0 - 4 * just_below, 14.0, 16.0]


@given(st.lists(st.integers(0, 10_000).map(lambda cm: cm / 100), min_size=4, max_size=8, unique=True))
@example([2.49, 3.66, 7.69, 12.02])  # the sum that should be a gap's end lies below it
@example([4.53, 5.53, 14.61, 14.86])  # ... and the largest draw above the interval's end
@example([0.1, 0.1 + 1e-9, 0.2, 0.2 + 1e-9, 0.6, 0.6 + 1e-9])  # what remains is less than rounding
@settings(max_examples=200, deadline=None)
def test_rounding_brings_no_draw_into_a_gap_or_out_of_the_interval(config: RunConfig, ends: list[float]) -> None:
    low, *inner, high = sorted(ends[: len(ends) // 2 * 2])
    family = gapped(list(zip(inner[::2], inner[1::2], strict=True)), (low, high))
    lengths = torch.tensor([0.0, *(b - a for a, b in family.pieces_m)], dtype=torch.float64)
    steps = (lengths.cumsum(0) / lengths.sum() * 2**24).round()  # of a random float32, to where the pieces end
    chances = (steps[:, None] + torch.arange(-4, 5)).clamp(0, 2**24 - 1) / 2**24
    drawn = torch.tensor(distances_at(config, family, chances.flatten().tolist()))
    first, last = torch.tensor([low, high])
    assert not any(is_inside(drawn, gap).any() for gap in family.gaps_m)
    assert ((first <= drawn) & (drawn <= last)).all()


def test_further_social_vehicles_may_start_in_the_gap(three_social_config: RunConfig) -> None:
    family = gapped([(12.0, 29.0)], (10.0, 30.0))
    start = draw(three_social_config, {"one": family}, 500).start_distance
    assert not is_inside(start[:, 1], (12.0, 29.0)).any()
    assert is_inside(start[:, 2], (12.0, 29.0)).any()


@pytest.mark.parametrize(
    ("gaps", "line"),
    [
        ("[[11.0,12.5]]", "must lie within start_distance_m = [11.99, 18.8], got [11.0, 12.5]"),
        ("[[12.0,13.0],[18.0,19.0]]", "must lie within start_distance_m = [11.99, 18.8], got [18.0, 19.0]"),
        ("[[14.0,15.0],[12.0,13.0]]", "must be ascending and disjoint, got [12.0, 13.0] after [14.0, 15.0]"),
        ("[[12.0,14.0],[13.5,15.0]]", "must be ascending and disjoint, got [13.5, 15.0] after [12.0, 14.0]"),
        ("[[11.99,18.80]]", "must leave some of start_distance_m = [11.99, 18.8], got [11.99, 18.8]"),
        (
            "[[11.99,12.40],[12.40,18.80]]",
            "must leave some of start_distance_m = [11.99, 18.8], got [11.99, 12.4], [12.4, 18.8]",
        ),
    ],
)
def test_gaps_that_cannot_be_are_named(gaps: str, line: str) -> None:
    with pytest.raises(UserError) as error:
        compose_config([f"scenario.families.mixture.gaps_m={gaps}"])
    assert str(error.value) == f"scenario.families.mixture gaps_m {line}"


def test_a_gap_is_an_interval() -> None:
    with pytest.raises(UserError, match=r"families\.push\.gaps_m\.0 must be \[low, high\] with low <= high, got "):
        compose_config(["scenario.families.push.gaps_m=[[18.0,17.0]]"])


def test_social_vehicles_queue(three_social_config: RunConfig) -> None:
    task = draw_tasks(three_social_config, 10)
    gaps = task.start_distance[:, 1:].diff(dim=1)
    torch.testing.assert_close(gaps, torch.full_like(gaps, three_social_config.scenario.social_spacing_m))
    assert task.direction.tolist() == [[1.0, -1.0, -1.0, -1.0]] * 10


def test_the_spacing_of_a_queue_may_be_drawn() -> None:
    spaced = ["scenario.n_social=3", "scenario.n_followers=2", "scenario.social_spacing_m=[7.0,20.0]"]
    fixed, drawn = (draw_tasks(compose_config(overrides), 200) for overrides in (spaced[:2], spaced))
    start = drawn.start_distance
    gaps = torch.cat([start[:, 1:4].diff(dim=1), start[:, [0, 4, 5]].diff(dim=1)], dim=1)
    assert gaps.min() >= 7 - 1e-5
    assert gaps.max() <= 20 + 1e-5
    assert (gaps.amax(0) - gaps.amin(0) > 10).all()
    assert torch.corrcoef(gaps.T).fill_diagonal_(0).abs().max() < 0.3
    assert torch.equal(start[:, :2], fixed.start_distance[:, :2])  # nothing else of a task changes
    assert torch.equal(drawn.start_speed, fixed.start_speed)


@pytest.mark.parametrize("spacing", ["[4.0,20.0]", "4.0"])
def test_vehicles_of_a_queue_must_not_start_in_each_other(spacing: str) -> None:
    with pytest.raises(UserError, match=r"^scenario\.social_spacing_m must keep vehicles of scenario\.vehicle"):
        compose_config(["scenario.n_social=2", f"scenario.social_spacing_m={spacing}"])


def test_streams_depend_on_seed_and_purpose() -> None:
    def first(seed: int, purpose: str) -> float:
        return float(torch.rand(1, generator=generator(seed, purpose)))

    assert first(1, "training tasks") == first(1, "training tasks")
    draws = {first(seed, purpose) for seed in (1, 2, 12) for purpose in ("training tasks", "held-out tasks push")}
    assert len(draws) == 6


def test_no_family_is_an_error(config: RunConfig) -> None:
    with pytest.raises(UserError, match="at least one task family"):
        TaskSampler(config.scenario, {}, torch.Generator())
