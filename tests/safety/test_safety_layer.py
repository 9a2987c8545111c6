"""The safety layer: which plans pass, what is driven instead, what it guarantees against whoever keeps the limits."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from games import draw_tasks, meet, place, tiny_config
from torch import Tensor

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.game.game import Game, build_game
from negopipe.game.guard import Guard
from negopipe.planner.situation import Situation
from negopipe.safety.config import RssConfig
from negopipe.safety.layer import INTERVENTIONS, SafetyLayer, nothing_kept
from negopipe.safety.stops import StopPaths
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import AT_REST_MPS, EGO, Motion, World

PASSES, LAST_PLAN, PLANNED_STOP, FULL_BRAKING = range(len(INTERVENTIONS))
IN_CORRIDOR_M = 6.0


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return tiny_config("mixture", "safety=rss")


@pytest.fixture(scope="module")
def game(config: RunConfig) -> Game:
    return build_game(config)


@pytest.fixture(scope="module")
def layer(config: RunConfig, game: Game) -> SafetyLayer:
    assert isinstance(config.safety, RssConfig)
    return SafetyLayer.of(config.safety, game.simulator)


def planned(game: Game, world: World, horizon_s: float) -> Motion:
    return game.plan(game.perceive(world), torch.full_like(world.task.start_speed, horizon_s))


def intervention(game: Game, world: World, motion: Motion) -> int:
    return int(game.guard(world, game.perceive(world), motion)[2])


def test_a_plan_that_passes_is_driven_as_it_is(config: RunConfig, game: Game) -> None:
    world = meet(config, game, [[-20.0, -20.0]], [[5.0, 5.0]])
    motion = planned(game, world, 0.0)
    _, driven, number = game.guard(world, game.perceive(world), motion)
    assert number.tolist() == [PASSES]
    assert torch.equal(driven.state.position, motion.state.position)
    assert torch.equal(driven.state.accel, motion.state.accel)


def test_a_plan_that_drives_into_an_oncoming_vehicle_is_replaced_by_braking(config: RunConfig, game: Game) -> None:
    world = meet(config, game, [[IN_CORRIDOR_M - 1, 0.0]], [[5.0, 5.0]])
    _, driven, number = game.guard(world, game.perceive(world), planned(game, world, 0.0))
    assert number.tolist() == [FULL_BRAKING]
    assert float(driven.state.accel[0, EGO]) < -7
    assert bool(driven.is_full_braking[0, EGO])


def test_only_the_ego_is_guarded(config: RunConfig, game: Game) -> None:
    world = meet(config, game, [[IN_CORRIDOR_M - 1, 0.0]], [[5.0, 5.0]])
    motion = planned(game, world, 0.0)
    _, driven, _ = game.guard(world, game.perceive(world), motion)
    assert torch.equal(driven.state.speed[:, 1:], motion.state.speed[:, 1:])


def test_a_decision_or_a_plan_of_nan_is_a_planned_stop_and_then_the_last_plan(config: RunConfig, game: Game) -> None:
    world = meet(config, game, [[-20.0, -20.0]], [[5.0, 5.0]])
    lost = planned(game, world, float("nan"))
    assert intervention(game, world, lost) == PLANNED_STOP
    kept, motion, _ = game.guard(world, game.perceive(world), planned(game, world, 0.0))
    assert intervention(game, kept, lost) == LAST_PLAN
    broken = replace(motion, state=replace(motion.state, yaw=motion.state.yaw * torch.nan))
    assert intervention(game, kept, broken) == LAST_PLAN


def test_the_last_plan_is_followed_at_its_speed_for_a_while(config: RunConfig, game: Game) -> None:
    world = meet(config, game, [[-40.0, -40.0]], [[5.0, 5.0]])
    world = game.drive(world, torch.zeros(1, 2)).world
    before, numbers = float(world.vehicles.speed[0, EGO]), []
    for _ in range(7):
        world, motion, number = game.guard(world, game.perceive(world), planned(game, world, float("nan")))
        numbers.append(int(number))
        if number == LAST_PLAN:
            assert float(motion.state.speed[0, EGO]) == pytest.approx(before, abs=0.01)
        world = replace(world, vehicles=motion.state, reference=motion.state)
    assert numbers == [LAST_PLAN] * 5 + [PLANNED_STOP] * 2


def test_the_stop_of_a_lost_plan_ends_at_the_waiting_place(config: RunConfig, game: Game, layer: SafetyLayer) -> None:
    world = meet(config, game, [[-20.0, -20.0]], [[5.0, 0.0]])
    horizon = torch.tensor([[torch.nan, 0.0]])
    for _ in range(60):
        world = game.drive(world, horizon).world
    assert not world.has_collided.any()
    s = game.simulator.road.progress(world.vehicles.position, world.task.direction)[0, EGO]
    waiting = layer.passage.waiting_s(s, world.task.direction[0, EGO], config.scenario.sizes.ego.length)
    assert float(world.vehicles.speed[0, EGO]) == 0
    assert float(s) == pytest.approx(float(waiting), abs=1.0)


def test_a_vehicle_at_rest_may_stay_whatever_comes(config: RunConfig, game: Game) -> None:
    world = meet(config, game, [[IN_CORRIDOR_M, 1.0]], [[0.0, 6.0]])
    perception = game.perceive(world)
    still = Motion(world.vehicles, torch.zeros(1, 2), torch.zeros(1, 2, dtype=torch.bool))
    assert game.guard(world, perception, still)[2].tolist() == [PASSES]


@pytest.mark.parametrize(("d", "is_clear"), [(-1.75, True), (-4.0, False), (4.0, False)])
def test_stops_are_clear_of_the_kerbs(
    config: RunConfig, game: Game, layer: SafetyLayer, d: float, is_clear: bool
) -> None:
    assert (margin_at(config, game, layer, -22.0, d, -40.0) > 0) == is_clear


def test_stops_are_clear_of_parked_cars(config: RunConfig, game: Game, layer: SafetyLayer) -> None:
    middle = IN_CORRIDOR_M
    assert margin_at(config, game, layer, middle, 0.0, -40.0) > 0
    assert margin_at(config, game, layer, middle, -1.5, -40.0) < 0


def margin_at(
    config: RunConfig,
    game: Game,
    layer: SafetyLayer,
    s: float,
    d: float,
    other_s: float,
    speed: float = 2.0,
    aside_m: float = 0.0,
) -> float:
    """Margin of the best stop from a place, with an oncoming vehicle, `aside_m` to the left of the line's route."""
    world = meet(config, game, [[s, other_s]], [[speed, 5.0]])
    aside = torch.tensor([[[0.0, 0.0], [0.0, aside_m]]])
    world = place(world, replace(world.vehicles, position=world.vehicles.position + aside))
    perception = game.perceive(world).of(EGO)
    now = Situation.of(layer.road, layer.sizes, perception, torch.zeros(1, 1))
    start = now.route._replace(d=torch.tensor([d]))
    fresh = StopPaths.fresh(layer.lateral, start, now.direction)
    starts = RouteState(*(field.expand(fresh.start_s.shape) for field in start))
    return float(layer.check(now, starts, fresh).amax())


def test_stops_are_clear_of_oncoming_vehicles(config: RunConfig, game: Game, layer: SafetyLayer) -> None:
    near, far = (margin_at(config, game, layer, IN_CORRIDOR_M, 0.0, other) for other in (0.0, -25.0))
    assert near < 0 < far


def adversary(game: Game, world: World, draw: torch.Generator) -> tuple[Tensor, ...]:
    """States one step later of social vehicles that accelerate or brake as chance will have it, on their routes."""
    road, dt = game.simulator.road, game.simulator.scenario.dt_s
    direction = world.task.direction[:, 1:]
    vehicles = replace(world.vehicles, **{k: getattr(world.vehicles, k)[:, 1:] for k in vars(world.vehicles)})
    now = road.to_route(vehicles, direction)
    accel = torch.tensor([2.4, 2.4, 0.0, -8.0])[torch.randint(4, now.s.shape, generator=draw)]
    speed = (now.s_dot + accel * dt).clamp(0, 7)
    s = now.s + (now.s_dot + speed) / 2 * dt
    moved = road.to_world(RouteState(s, speed, accel, *road.route_offset(s, direction)), direction)
    return tuple(vars(moved).values())


def worst_contact(config: RunConfig, n_steps: int = 45) -> tuple[int, float]:
    """Collisions of the ego, and its largest speed in one, against adversaries on their routes."""
    game, draw = build_game(config), torch.Generator().manual_seed(1)
    world = game.simulator.reset(draw_tasks(config, 64))
    n_collisions, worst = 0, 0.0
    for _ in range(n_steps):
        horizons = torch.tensor([0.0, 0.0, 2.0])[torch.randint(3, (64,), generator=draw)]
        perception = game.perceive(world)
        motion = game.plan(perception, world.horizons(horizons))
        world, motion, _ = game.guard(world, perception, motion)
        others = adversary(game, world, draw)
        fields = {
            name: torch.cat([own[:, :1], other], 1)
            for (name, own), other in zip(vars(motion.state).items(), others, strict=True)
        }
        moved, events = game.simulator.step(world, replace(motion.state, **fields))
        is_hit = events.is_collision & ~world.has_collided[:, EGO]
        if is_hit.any():
            worst = max(worst, float(moved.vehicles.speed[is_hit, EGO].abs().max()))
            n_collisions += int(is_hit.sum())
        world = moved
    return n_collisions, worst


def test_against_whoever_keeps_the_limits_the_ego_is_at_rest_in_every_collision() -> None:
    _, without = worst_contact(tiny_config("mixture"))
    n_collisions, guarded = worst_contact(tiny_config("mixture", "safety=rss"))
    assert without > 1.0
    assert n_collisions > 0  # nobody can help being hit at rest
    assert guarded < AT_REST_MPS


def test_without_a_layer_nothing_is_checked() -> None:
    config = tiny_config("mixture", "safety=none")
    game = build_game(config)
    world = meet(config, game, [[IN_CORRIDOR_M - 1, 0.0]], [[5.0, 5.0]])
    motion = planned(game, world, 0.0)
    same, driven, number = game.guard(world, game.perceive(world), motion)
    assert same is world
    assert driven is motion
    assert number.tolist() == [0]
    assert world.kept_stop.shape == (1, 0)
    assert Guard(config.safety, game.simulator).layer is None


def test_interventions_are_recorded_and_counted(config: RunConfig, game: Game) -> None:
    paid = config.evaluation.reward
    tasks = draw_tasks(config, 16)
    trace = drive_episodes(game, by_horizon(game, fixed_horizon(0.0)), tasks, 16, paid, ("fixed_0", "mixture"))
    table = episodes(Drives.of(config, trace), ("intervention_count", "outcome", "contact_speed_mps"))
    assert set(np.unique(trace.intervention)) <= set(range(len(INTERVENTIONS)))
    assert table["intervention_count"].sum() > 0
    hit = table["outcome"] == "collision"
    assert (table["contact_speed_mps"][hit] < AT_REST_MPS).all()
    assert table["contact_speed_mps"][~hit].isna().all()


@cache
def fingerprint(*overrides: str) -> list[float]:
    """Numbers that the layer's options change: margins at some places, and what is driven after a lost decision."""
    config = tiny_config("mixture", "safety=rss", *overrides)
    game = build_game(config)
    assert isinstance(config.safety, RssConfig)
    layer = SafetyLayer.of(config.safety, game.simulator)
    places = [(IN_CORRIDOR_M, 0.0, other, speed) for other in (0.5, -4.0) for speed in (2.0, 5.0)]
    places += [(-22.0, -3.0, -40.0, 2.0), (-10.0, -1.5, -3.0, 3.0)]
    margins = [margin_at(config, game, layer, *at) for at in places]
    margins += [margin_at(config, game, layer, -36.0, -1.75, 40.0, 2.0, aside) for aside in (-2.0, 2.0)]
    world = meet(config, game, [[-9.0, -20.0], [-20.0, -20.0]], [[6.0, 5.0], [5.0, 5.0]])
    _, motion, _ = game.guard(world, game.perceive(world), planned(game, world, float("nan")))
    kept, _, _ = game.guard(world, game.perceive(world), planned(game, world, 0.0))
    again = game.guard(kept, game.perceive(kept), planned(game, kept, float("nan")))[2]
    return [*margins, *motion.state.accel[:, EGO].tolist(), *again.tolist()]


@pytest.mark.parametrize(
    "override",
    [
        "safety.comfortable_mps2=3.0",
        "safety.hold_s=0.0",
        "safety.limits.decel_max_mps2=6.0",
        "safety.others.speed_max_mps=5.0",
        "safety.others.accel_max_mps2=4.0",
        "safety.others.response_s=1.0",
        "safety.others.braking_mps2=3.0",
        "safety.others.offset_decay_m=2.0",
        "safety.parked_m=0.2",
        "safety.ahead_m=1.0",
        "safety.beside_m=0.5",
        "safety.stops.offsets_m=[0.0]",
        "safety.stops.lengths_m=[5.0]",
    ],
)
def test_every_option_has_an_effect(override: str) -> None:
    assert fingerprint(override) != fingerprint()


def test_nothing_is_kept_at_the_start_of_an_episode(config: RunConfig, game: Game) -> None:
    world = game.simulator.reset(draw_tasks(config, 2))
    assert torch.equal(world.kept_stop.isnan(), nothing_kept(2, "cpu").isnan())
