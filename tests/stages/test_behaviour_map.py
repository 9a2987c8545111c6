"""The behaviour map: rows that agree with the drives, verdicts by hand, options that act."""

import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from composed import compose_config
from games import tiny_config
from tracked import RecordedRun

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.config.root import RunConfig, run_name
from negopipe.errors import UserError
from negopipe.evaluation.behaviour_map import EQUAL, FAILS, HOLDS, UNKNOWN, Opponent, claims, trends
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.safety import footprints, smallest_gap
from negopipe.evaluation.trace import OUTCOMES
from negopipe.game.game import Game, build_game
from negopipe.report.map_figure import behaviour_map as draw
from negopipe.report.map_figure import reading
from negopipe.stages import behaviour_map

TINY = (
    "behaviour_map.n_episodes=2",
    "behaviour_map.horizons_s=[0.0,6.0]",
    "behaviour_map.styles_s=[0.0,6.0]",
    "algorithm.n_worlds=2",
)


def tiny(*overrides: str) -> RunConfig:
    return tiny_config("behaviour_map", *TINY, *overrides)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    run = RecordedRun(tmp_path_factory.mktemp("run"))
    behaviour_map.run(tiny("evaluation.settings=[push,yield]"), run)
    return run


def test_rows_agree_with_the_drives(ran: RecordedRun) -> None:
    table = pd.read_csv(ran.folder / "behaviour_map.csv")
    keys = ["setting", "social_style_s", "ego_horizon_s"]
    pairs = [(style, horizon) for style in (0.0, 6.0) for horizon in (0.0, 6.0)]
    assert [tuple(key) for key in table[keys].to_numpy()] == [(s, *pair) for s in ("push", "yield") for pair in pairs]
    config = tiny()
    game = build_game(config)
    columns = {"timeout": "other_timeout_rate"} | {name: f"{name}_rate" for name in OUTCOMES[:3]}
    for row in table[table["setting"] == "push"].to_dict("records"):
        tasks = behaviour_map.map_tasks(config, game, "push", Opponent(row["social_style_s"], ""))
        choose = fixed_horizon(row["ego_horizon_s"])
        trace = drive_episodes(game, by_horizon(game, choose), tasks, 2, config.evaluation.reward, ("again", "push"))
        again = episodes(Drives.of(config, trace))
        shares = again["outcome"].value_counts(normalize=True)
        for outcome, name in columns.items():
            assert row[name] == shares.get(outcome, 0.0), name
        for name in ("ego_time_s", "social_time_s", "suspend_count", "suspend_time_s"):
            assert row[name] == pytest.approx(again[name].mean(), nan_ok=True), name
        first = again.loc[again["passes_first"] != "none", "passes_first"]
        assert row["ego_passes_first_rate"] == pytest.approx((first == "ego").mean(), nan_ok=True)
        assert row["smallest_gap_m"] == pytest.approx(smallest_gap(footprints(trace)).mean())
        assert row["full_braking_rate"] == trace.is_full_braking[:, :, 0].sum() / trace.n_steps.sum()
        assert row["n_episodes"] == 2
    assert table["success_rate"].any()
    assert table["ego_passes_first_rate"].isin([0, 1]).any()


def test_two_who_do_not_look_collide_and_touch(ran: RecordedRun) -> None:
    table = pd.read_csv(ran.folder / "behaviour_map.csv")
    blind = table[(table["ego_horizon_s"] == 0) & (table["social_style_s"] == 0)]
    assert blind["collision_rate"].tolist() == [1.0, 1.0]
    assert blind["smallest_gap_m"].tolist() == [0.0, 0.0]
    assert blind["ego_time_s"].isna().all()


def test_the_behaviour_map_is_written_and_logged(ran: RecordedRun) -> None:
    assert ran.artifacts == [
        ("behaviour_map.csv", ""),
        ("behaviour_map.png", "figures"),
        ("behaviour_map.svg", "figures"),
    ]
    verdicts = ran.sections["behaviour_map"]["claims"]
    assert set(verdicts) == {"ego_passes_first_rate", "smallest_gap_m"}
    assert set(verdicts["smallest_gap_m"]["push"]) == {"social_0", "social_6"}
    assert ran.description.startswith(
        "Claim 8, that a shorter prediction horizon of the ego gives more aggressive driving"
    )


def test_every_style_meets_the_tasks_of_the_evaluation(config: RunConfig, game: Game) -> None:
    gaps = "scenario.families.yield.gaps_m=[[12.5,13.5]]"
    as_many = compose_config(["device=cpu", gaps, f"behaviour_map.n_episodes={config.evaluation.n_episodes}"])
    own = held_out_tasks(as_many, game, "yield")
    for style_s in (0.0, 4.0):
        tasks = behaviour_map.map_tasks(as_many, game, "yield", Opponent(style_s, ""))
        assert torch.equal(tasks.start_distance, own.start_distance)
        assert (tasks.style_horizon[:, 1:] == style_s).all()


@pytest.fixture(scope="module")
def mixed() -> tuple[RunConfig, Game]:
    drivers = "population/driver=[planner,cautious,undecided,idm]"
    one = ("behaviour_map.styles_s=[6.0]", "evaluation.settings=[yield]")
    config = tiny(*one, drivers, "population.drivers.idm.weight=0.0")
    return config, build_game(config)


@pytest.fixture(scope="module")
def mixed_map(mixed: tuple[RunConfig, Game]) -> pd.DataFrame:
    return behaviour_map.drive_map(*mixed)


def test_drivers_of_the_population_have_rows_of_their_own(mixed_map: pd.DataFrame) -> None:
    table = mixed_map
    whom = [("", 0.0), ("", 6.0), ("cautious", 0.0), ("cautious", 6.0), ("undecided", 0.0), ("undecided", 6.0)]
    assert list(zip(table["social_driver"], table["ego_horizon_s"], strict=True)) == whom
    assert table["social_style_s"].isna().tolist() == [False] * 2 + [True] * 4
    assert table.loc[2, "success_rate"] == 1.0  # cautious waits for an ego that does not look
    assert {finding.social_style_s for finding in trends(table)} == {6.0}
    alone = tiny("behaviour_map.styles_s=[6.0]", "evaluation.settings=[yield]")
    pd.testing.assert_frame_equal(behaviour_map.drive_map(alone, build_game(alone)), table[:2])


def test_every_driver_meets_the_starts_of_the_styles(mixed: tuple[RunConfig, Game]) -> None:
    config, game = mixed
    style, driver = (
        behaviour_map.map_tasks(config, game, "yield", Opponent(*each)) for each in ((6.0, ""), (math.nan, "cautious"))
    )
    assert torch.equal(style.start_distance, driver.start_distance)
    assert torch.equal(style.noise_seed, driver.noise_seed)
    assert game.cast.named(driver.casting.driver).tolist() == [["", "cautious"]] * 2


def test_the_figure_names_the_drivers(mixed_map: pd.DataFrame) -> None:
    figure = draw(mixed_map)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["6", "cautious", "undecided"]
    assert figure.get_supylabel() == "social driver: prediction horizon [s] or name"


def make_table(first: list[float], gap: list[float]) -> pd.DataFrame:
    rows = {"ego_horizon_s": [0.0, 2.0, 4.0, 6.0], "ego_passes_first_rate": first, "smallest_gap_m": gap}
    return pd.DataFrame({"setting": "push", "social_style_s": 2.0} | rows)


@pytest.mark.parametrize(
    ("first", "verdict", "turn"),
    [
        ([1.0, 1.0, 0.5, 0.0], HOLDS, None),
        ([1.0, math.nan, 0.5, 0.5], HOLDS, None),
        ([1.0, 0.5, 0.75, 0.0], FAILS, ((2.0, 0.5), (4.0, 0.75))),
        ([0.5, 0.5, math.nan, 0.5], EQUAL, None),
        ([math.nan, 0.5, math.nan, math.nan], UNKNOWN, None),
    ],
)
def test_passing_first_must_not_grow_with_the_horizon(first: list[float], verdict: str, turn: Any) -> None:
    found = trends(make_table(first, [0.0, 0.5, 0.495, 1.0]).sample(frac=1, random_state=0))
    assert (found[0].verdict, found[0].turn) == (verdict, turn)
    assert found[1].verdict == HOLDS  # half a centimetre is no difference
    assert claims(found)["ego_passes_first_rate"] == {"push": {"social_2": verdict}}


def test_the_paragraph_on_claim_8_names_the_cases_against_it() -> None:
    text = reading(trends(make_table([1.0, 1.0, 0.5, 0.0], [0.7, 0.9, 0.25, 1.0])))
    assert "More first passages: holds in 1 of 1 (push against 2 s)." in text
    assert "Smaller gap: does not hold in 1 of 1 (push against 2 s [0.90 m at 2 s but 0.25 m at 4 s])." in text


def test_the_figure_shows_the_numbers(ran: RecordedRun) -> None:
    table = pd.read_csv(ran.folder / "behaviour_map.csv")
    outcomes, passages = draw(table).axes[:2]
    push = table[table["setting"] == "push"]
    shown = [text.get_text() for text in passages.texts]
    assert len(shown) == 2 * len(push)
    for row in push.to_dict("records"):
        assert f"{row['smallest_gap_m']:.2f} m" in shown
    assert ("none" in shown) == push["ego_passes_first_rate"].isna().any()
    assert {text.get_text() for text in outcomes.texts} <= {f"{n}" for n in range(30, 101)}
    assert outcomes.get_title(loc="left") == "Push: outcomes [%]"


def test_formats_are_those_of_the_report(tmp_path: Path) -> None:
    run = RecordedRun(tmp_path)
    one = ("behaviour_map.horizons_s=[0.0]", "behaviour_map.styles_s=[0.0]", "evaluation.settings=[yield]")
    behaviour_map.run(tiny(*one, "report.figure_formats=[svg]"), run)
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["behaviour_map.svg"]
    assert len(pd.read_csv(tmp_path / "behaviour_map.csv")) == 1


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("behaviour_map.styles_s=[7.0]", "behaviour_map.styles_s must be at most planner.horizon_s = 6.0, got 7.0"),
        ("behaviour_map.horizons_s=[7.0]", "behaviour_map.horizons_s must be at most planner.horizon_s = 6.0, got 7.0"),
        ("behaviour_map.horizons_s=[2.0,2.0]", "behaviour_map.horizons_s must name every value once"),
        ("behaviour_map.n_episodes=0", "behaviour_map.n_episodes must be greater than or equal to 1, got 0"),
    ],
)
def test_a_wrong_map_is_named(override: str, line: str) -> None:
    with pytest.raises(UserError) as error:
        tiny(override)
    assert str(error.value).startswith(line)


def test_the_map_names_a_run_only_where_it_is_drawn() -> None:
    more = "behaviour_map.n_episodes=3"
    assert run_name(tiny(more)) != run_name(tiny())
    assert run_name(compose_config([more])) == run_name(compose_config())
    beside = "stages=[train,evaluate,behaviour_map,report]"
    assert run_name(compose_config([beside, more])) == run_name(compose_config())
