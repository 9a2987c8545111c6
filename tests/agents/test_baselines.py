"""The planners that the policy is compared with: each does what its name says, seeing what its vehicle sees."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
import yaml
from composed import compose_config
from games import draw_tasks

from negopipe.agents import route_following
from negopipe.agents.driver_config import DriverConfig
from negopipe.agents.drivers import CONFIGS, cautious, level_k, random_horizon
from negopipe.agents.encounter import Encounter, encounter
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.game.game import Game, build_game
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import Task
from negopipe.simulation.waiting_place import ROOM_M, waiting_places

TOGETHER = {"paper", "all"}
"""Options that stand for several."""
FOLDER = Path(__file__).parents[2] / "conf/evaluation/baseline"
NOT_WITH_THIS_PLANNER = ("fixed_inf",)
FILES = sorted(path for path in FOLDER.glob("*.yaml") if path.stem not in (*TOGETHER, *NOT_WITH_THIS_PLANNER))
NAMES = [path.stem for path in FILES]


@pytest.fixture(scope="module")
def baselines() -> dict[str, DriverConfig]:
    return compose_config([f"evaluation/baseline=[{','.join(NAMES)}]", "report.side_by_side=[]"]).evaluation.baselines


@pytest.fixture(scope="module")
def brief() -> Game:
    """Episodes end after 6 s, which is enough to see who does what."""
    return build_game(compose_config(["scenario.episode_steps=30"]))


def task_with(config: RunConfig, distance_m: float, style_s: float) -> Task:
    task = draw_tasks(config, 1)
    distance, style = task.start_distance.clone(), task.style_horizon.clone()
    distance[:, 1], style[:, 1] = distance_m, style_s
    return replace(task, start_distance=distance, style_horizon=style)


def drive(config: RunConfig, game: Game, baseline: DriverConfig, task: Task, n_worlds: int = 64) -> Trace:
    names = ("baseline", "x")
    ego, paid = partial(baseline.driver, game), config.evaluation.reward
    return drive_episodes(game, ego, task, n_worlds, paid, names, baseline.is_lockstep)


def kind_of(config: type) -> str:
    return get_args(config.__dataclass_fields__["kind"].type)[0]  # type: ignore[attr-defined]


def test_every_file_chooses_a_baseline_of_its_name(baselines: dict[str, DriverConfig]) -> None:
    assert list(baselines) == NAMES
    kinds = {yaml.safe_load(path.read_text())["kind"] for path in FILES}
    assert kinds == {kind_of(config) for config in CONFIGS}


@pytest.mark.parametrize(
    ("name", "distance_m", "style_s", "outcome"),
    [
        ("fixed_6", 13.0, 2.0, "success"),
        ("fixed_2", 13.0, 2.0, "deadlock"),
        ("give_way", 13.0, 2.0, "success"),  # the other is nearer: the ego waits
        ("give_way", 13.8, 0.0, "collision"),  # the ego is nearer and insists, the other does not know the rule
        ("give_way", 17.5, 6.0, "success"),
        ("cautious", 13.0, 0.0, "success"),
        ("cautious", 17.5, 6.0, "success"),
    ],
)
def test_who_gets_through(
    config: RunConfig,
    game: Game,
    baselines: dict[str, DriverConfig],
    name: str,
    distance_m: float,
    style_s: float,
    outcome: str,
) -> None:
    trace = drive(config, game, baselines[name], task_with(config, distance_m, style_s))
    assert OUTCOMES[int(trace.outcome[0])] == outcome


@pytest.mark.parametrize("overrides", [["scenario=one_sided"], ["perception.dropout_probability=0.02"]])
def test_cautious_waits_where_the_other_can_pass_and_goes_on_waiting(
    baselines: dict[str, DriverConfig], overrides: list[str]
) -> None:
    # without a waiting place made for the street, and with one missed sighting as a reason to go, about a third crash
    config = compose_config(overrides)
    task = draw_tasks(config, 16)
    blind = replace(task, style_horizon=torch.zeros_like(task.style_horizon))
    trace = drive(config, build_game(config), baselines["cautious"], blind)
    assert [OUTCOMES[outcome] for outcome in trace.outcome] == ["success"] * 16


@pytest.mark.parametrize(
    ("scenario", "side", "waiting_m"),
    [("narrow_lane", 1.0, -9.0), ("one_sided", 1.0, -10.75), ("one_sided", -1.0, -10.0)],
)
def test_a_waiting_place_leaves_room_for_the_others_route(scenario: str, side: float, waiting_m: float) -> None:
    simulator = build_game(compose_config([f"scenario={scenario}"])).simulator
    early, latest = (
        waiting_places(simulator.collisions, simulator.scenario.sizes, latest_m, ROOM_M)[int(side < 0), 0]
        for latest_m in (-9.0, 0.0)
    )
    assert early == waiting_m
    assert latest < -5.0  # in the corridor nobody can pass


def test_who_keeps_to_one_horizon_is_known_from_its_kind() -> None:
    """Whatever it is called."""
    short = ["kind=fixed", "horizon_s=1.6"]
    overrides = [f"+evaluation.baselines.random_short.{value}" for value in short]
    evaluation = compose_config(
        ["evaluation/baseline=[fixed_6,cautious]", "report.side_by_side=[]", *overrides]
    ).evaluation
    assert list(evaluation.baselines) == ["fixed_6", "cautious", "random_short"]
    assert evaluation.fixed_horizons_s == {"fixed_6": 6.0, "random_short": 1.6}


def test_only_horizons_that_a_baseline_names_are_used(config: RunConfig, baselines: dict[str, DriverConfig]) -> None:
    game = build_game(compose_config(["scenario.episode_steps=12"]))
    task = draw_tasks(config, 2, seed=3)
    short = replace(baselines["level_k"], lookahead_s=0.4)  # type: ignore[call-arg]
    for baseline in (baselines | {"level_k": short}).values():
        horizon = drive(config, game, baseline, task).horizon_s[:, :, 0]
        named = {horizon_s for values in baseline.prediction_horizons_s.values() for horizon_s in values}
        assert set(horizon[~np.isnan(horizon)].tolist()) <= named


def test_random_horizons_depend_on_the_episode_alone(
    config: RunConfig, brief: Game, baselines: dict[str, DriverConfig]
) -> None:
    task = draw_tasks(config, 3, seed=5)
    together, alone = (drive(config, brief, baselines["random"], task, n).horizon_s[:, :, 0] for n in (3, 1))
    assert np.array_equal(together, alone, equal_nan=True)
    assert not np.array_equal(together[:, 0], together[:, 1], equal_nan=True)


def sequence(game: Game, baseline: random_horizon.Config, n: int) -> torch.Tensor:
    """[T, n] the horizons that are drawn."""
    choose = baseline.driver(game, torch.arange(n)).choose_horizon
    nothing: Any = None
    return torch.stack([choose(nothing)[:, 0] for _ in range(game.simulator.scenario.episode_steps)])


def test_random_horizons_are_equally_likely_and_kept(game: Game, baselines: dict[str, DriverConfig]) -> None:
    baseline = baselines["random"]
    assert isinstance(baseline, random_horizon.Config)
    drawn = sequence(game, baseline, 400)
    n_kept = round(baseline.keep_s / game.simulator.scenario.dt_s)
    whole = drawn[: len(drawn) // n_kept * n_kept].unflatten(0, (-1, n_kept))
    assert (whole == whole[:, :1]).all()
    first = whole[:, 0]
    for horizon in baseline.horizons_s:
        assert (first == horizon).float().mean().item() == pytest.approx(1 / len(baseline.horizons_s), abs=0.02)
    again = (first[1:] == first[:-1]).float().mean().item()
    assert again == pytest.approx(1 / len(baseline.horizons_s), abs=0.02)
    longer = sequence(game, replace(baseline, keep_s=2 * baseline.keep_s), 400)
    assert not torch.equal(longer, drawn)


def test_an_encounter_by_hand(config: RunConfig, game: Game) -> None:
    task = task_with(config, 16.0, 6.0)
    perception = game.perceive(game.simulator.reset(task)).of(0)
    met = encounter(game.simulator.road, perception)
    ego_m = task.start_distance[0, 0].item()
    assert met.own.s.item() == pytest.approx(-ego_m, abs=1e-3)
    assert met.other_s.item() == pytest.approx(-16.0, abs=1e-3)
    assert met.other_speed.item() == pytest.approx(task.start_speed[0, 1].item(), abs=1e-3)
    assert met.apart_m.item() == pytest.approx(ego_m + 12.0 + 16.0, abs=1e-3)
    assert met.is_oncoming.all()
    unseen = replace(perception, is_seen=torch.zeros_like(perception.is_seen))
    assert not encounter(game.simulator.road, unseen).is_oncoming.any()
    # where they have passed each other by more than a vehicle's length, nobody comes any more
    behind = replace(
        perception, own=replace(perception.own, position=perception.own.position + torch.tensor([50.0, 0]))
    )
    assert not encounter(game.simulator.road, behind).is_oncoming.any()


def test_the_intelligent_driver_model_by_hand(baselines: dict[str, DriverConfig]) -> None:
    config = baselines["cautious"]
    assert isinstance(config, cautious.Config)
    free = route_following.Hindrance(torch.tensor(1e9), torch.tensor(0.0))

    def accel(speed: float, hindrance: route_following.Hindrance) -> float:
        return route_following.idm(config, torch.tensor(speed), torch.tensor(6.0), hindrance).item()

    assert accel(0.0, free) == pytest.approx(config.accel_mps2)
    assert accel(6.0, free) == pytest.approx(0.0, abs=1e-5)
    assert accel(3.0, free) == pytest.approx(config.accel_mps2 * (1 - 1 / 16))
    # behind a standing obstacle at 3 m/s: s* = 2 + 3 * 1 + 3 * 3 / (2 sqrt(2.4 * 2)) = 7.054 m
    assert accel(3.0, route_following.Hindrance(torch.tensor(10.0), torch.tensor(3.0))) == pytest.approx(
        2.4 * (1 - 1 / 16 - 0.7054**2), abs=1e-3
    )
    assert accel(6.0, route_following.Hindrance(torch.tensor(1.0), torch.tensor(6.0))) == -config.braking_max_mps2


def test_time_to_a_place() -> None:
    now, speed = torch.tensor([-10.0, -10.0, 5.0, 5.0]), torch.tensor([5.0, 0.0, 5.0, 0.0])
    assert cautious.time_to(0.0, now, speed).tolist() == [2.0, cautious.LONG_S, 0.0, 0.0]


@pytest.fixture(scope="module")
def usual_m(config: RunConfig, brief: Game, baselines: dict[str, DriverConfig]) -> np.ndarray:
    """Progress of the cautious driver as it is."""
    return drive(config, brief, baselines["cautious"], task_with(config, 13.0, 2.0)).progress_m


@pytest.mark.parametrize(
    "change",
    [
        {"stop_s_m": -11.0}, {"accel_mps2": 1.0}, {"decel_mps2": 0.5}, {"braking_max_mps2": 1.0},
        {"gap_m": 5.0}, {"headway_s": 3.0},
    ],
)  # fmt: skip
def test_every_value_of_the_cautious_driver_acts(
    config: RunConfig,
    brief: Game,
    baselines: dict[str, DriverConfig],
    usual_m: np.ndarray,
    change: dict[str, float],
) -> None:
    usual = baselines["cautious"]
    assert isinstance(usual, cautious.Config)
    other = drive(config, brief, replace(usual, **change), task_with(config, 13.0, 2.0))
    assert not np.array_equal(usual_m, other.progress_m)


@pytest.mark.parametrize(("other_m", "margin_s", "gap_m"), [(36.0, 1.0, 3.0), (36.0, 0.0, route_following.FREE_M)])
def test_it_waits_for_who_could_be_there_too_soon(
    game: Game, baselines: dict[str, DriverConfig], other_m: float, margin_s: float, gap_m: float
) -> None:
    """From s = -10 m at 5 m/s it is out of the corridor (12 m, half a car) in 24.25 / 5.5 = 4.4 s, the other in it in
    (36 - 2.25) / 7.5 = 4.5 s.
    """
    usual = baselines["cautious"]
    assert isinstance(usual, cautious.Config)
    one = torch.ones(1, 1)
    own = RouteState(-10 * one, 5 * one, 0 * one, 0 * one, 0 * one, 0 * one)
    each = one[None]
    met = Encounter(
        own=own,
        own_s=own.s,
        narrow_m=12 * one,
        own_m=4.5 * each,
        other_m=4.5 * each,
        other_s=-other_m * each,
        other_speed=7.5 * each,
        apart_m=58 * each,
        touch_m=4.5 * each,
        is_oncoming=each > 0,
        is_ahead=each < 0,
    )
    must_wait = replace(usual, margin_s=margin_s).must_wait(met, 6 * one)
    lines = route_following.StopLines(game.simulator, usual.stop_s_m, usual.gap_m)
    line = lines.hindrance(met, must_wait, one)
    assert line.gap_m.item() == pytest.approx(gap_m)  # to s = -9 m, and 2 m that it would keep
    assert line.closing_mps.item() == 5.0


def level_k_at(game: Game, baselines: dict[str, DriverConfig], **changes: float) -> level_k.LevelK:
    config = baselines["level_k"]
    assert isinstance(config, level_k.Config)
    return level_k.LevelK(game, replace(config, **changes))  # type: ignore[arg-type]


def test_best_responses_by_hand() -> None:
    """The game of chicken: 0 = goes, 1 = waits. Both going is worst, both waiting nothing."""
    own = torch.tensor([[[-9.0, 3.0], [1.0, 0.0]]])
    other = own.transpose(1, 2)

    def answer(goes: float, level: int) -> int:
        return level_k.best_response(own, other, torch.tensor([[goes, 1 - goes]]), level).item()  # type: ignore[return-value]

    assert answer(1.0, 1) == 1
    assert answer(0.0, 1) == 0
    assert [answer(goes, 1) for goes in (0.2, 0.3)] == [0, 1]  # -9 p + 3 (1 - p) = p at p = 3 / 13
    # at level 1 the other, to whom either is as likely, waits; so at level 2 the ego goes, and at level 3 it waits
    assert [answer(1.0, level) for level in (2, 3)] == [0, 1]


@pytest.mark.parametrize("style_s", [2.0, 4.0])
def test_the_belief_finds_the_style_from_the_motion(
    config: RunConfig, game: Game, baselines: dict[str, DriverConfig], style_s: float
) -> None:
    world = game.simulator.reset(task_with(config, 17.5, style_s))
    n = {2.0: 15, 4.0: 10}[style_s]  # then its prediction has met the ego for some steps
    for _ in range(n):
        world = game.drive(world, world.horizons(0.0)).world
    perception = game.perceive(world).of(0)
    chooser = level_k_at(game, baselines)
    belief = chooser.belief(perception, n)[0]
    assert chooser.horizons[belief.argmax()].item() == style_s
    assert belief.max() > 0.9
    assert belief.sum().item() == pytest.approx(1.0)
    vague = level_k_at(game, baselines, speed_std_mps=10.0).belief(perception, n)[0]
    assert vague.max() < 0.3
    shorter = level_k_at(game, baselines, lookback_s=0.2).belief(perception, n)[0]
    assert not torch.equal(shorter, belief)
    assert (chooser.belief(perception, 3) == 0.25).all()  # too early to tell


def test_payoffs_count_metres_and_crashes(config: RunConfig, game: Game, baselines: dict[str, DriverConfig]) -> None:
    perception = game.perceive(game.simulator.reset(task_with(config, 13.0, 2.0))).of(0)
    own, other = level_k_at(game, baselines).payoffs(perception)
    dear, _ = level_k_at(game, baselines, collision_m=500.0).payoffs(perception)
    is_crash = dear < own
    assert is_crash[0, 0, 0]  # both ignore each other
    assert not is_crash[0, 3].any()
    assert (own[is_crash] - dear[is_crash]).tolist() == pytest.approx([400.0] * int(is_crash.sum()))
    selfish, its = level_k_at(game, baselines, courtesy=0.0).payoffs(perception)
    assert own[0, 3].tolist() == pytest.approx((selfish + its)[0, 3].tolist(), abs=1e-3)
    assert torch.allclose(own, other, atol=1e-3)  # with courtesy 1 both want the same
    whole_m = config.scenario.road.corridor_length_m + config.scenario.road.target_distance_m + 13.35
    assert selfish.max() <= whole_m + 1e-3
    sooner, _ = level_k_at(game, baselines, lookahead_s=2.0).payoffs(perception)
    assert (sooner[0, 3] < own[0, 3]).all()


def test_who_is_not_seen_is_nobody(config: RunConfig, game: Game, baselines: dict[str, DriverConfig]) -> None:
    perception = game.perceive(game.simulator.reset(task_with(config, 13.0, 2.0))).of(0)
    blind = replace(perception, is_seen=torch.zeros_like(perception.is_seen))
    own, _ = level_k_at(game, baselines, courtesy=0.0, lookahead_s=5.0).payoffs(blind)
    assert own.min() > 20
    assert own.max() - own.min() < 1e-3


def test_a_choice_is_kept(config: RunConfig, game: Game, baselines: dict[str, DriverConfig], monkeypatch: Any) -> None:
    chooser, n_games = level_k_at(game, baselines, keep_s=0.6), []
    no_payoff = torch.zeros(1, 4, 4)
    monkeypatch.setattr(chooser, "payoffs", lambda perception: n_games.append(1) or (no_payoff, no_payoff))
    perception = game.perceive(game.simulator.reset(task_with(config, 13.0, 2.0))).of(0)
    for _ in range(7):
        chooser(perception)
    assert len(n_games) == 3
