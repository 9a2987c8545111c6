"""Vehicles of different sizes: each plans with its own size and those of the others."""

from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks, drive, meet
from situations import draw_situations, world_boxes
from torch import Tensor

from negopipe.game.game import Game, build_game
from negopipe.planner.frenet import FrenetPlanner
from negopipe.planner.prediction import predict
from negopipe.planner.situation import Situation
from negopipe.simulation.geometry import Size, overlap_depth
from negopipe.simulation.state import EGO, World

KINDS = ("scenario/kind=[bus,cyclist]",)


@pytest.fixture(scope="module")
def game() -> Game:
    return build_game(compose_config(["scenario/kind=[small_car,van,bus,cyclist]"]))


def sized(x: Situation, own: Size, other: Size) -> Situation:
    return x._replace(size=own, others=x.others._replace(size=other))


def between(low: float, high: float, n: int, seed: int) -> Tensor:
    return low + (high - low) * torch.rand(n, generator=torch.Generator().manual_seed(seed))


def test_no_candidate_meets_a_footprint_of_another_size(game: Game) -> None:
    """What the check lets through is free of the other's grown box, in the world, whatever both sizes are."""
    planner, n = game.planner, 120
    x = draw_situations(planner.road, n, 3)  # type: ignore[arg-type]
    own = Size(between(1.8, 7.4, n, 1), between(0.7, 2.0, n, 2))
    other = Size(between(1.8, 7.4, n, 3)[None], between(0.7, 2.0, n, 4)[None])
    x = sized(x, own, other)
    samples, paths = planner.longitudinal.sample(x.route, x.desired_speed), planner._paths(x)
    predicted = predict(planner.config.prediction, planner.road, x.others, x.direction, planner.times)
    counts = (planner.times[:, None] <= x.horizon + planner.dt_s / 2)[None]
    blocked = planner.conflicts.blocked(x, paths.coefficients, predicted, counts)[0]
    depth = directly(planner, x, samples.travelled, paths.coefficients, own, other).masked_fill(~counts[0], -99).amax(2)
    is_forward = (samples.speed.amin(1) >= -0.05).expand(depth.shape)
    is_met, is_conflict = (depth > 0.05) & is_forward, blocked.holds_up(samples.travelled)
    assert float(is_met.float().mean()) > 0.05
    assert float((is_met & ~is_conflict).float().mean()) < 1e-3
    assert float((is_conflict & is_forward & (depth < -0.3)).float().mean()) < 0.01


def directly(
    planner: FrenetPlanner, x: Situation, travelled: Tensor, coefficients: tuple[Tensor, ...], own: Size, other: Size
) -> Tensor:
    """[L, C, T, N] m: depth of every footprint in the grown box of the other, both in the world."""
    road, clearance = planner.road, planner.config.clearance
    predicted = predict(planner.config.prediction, road, x.others, x.direction, planner.times)
    d, d_prime, _ = planner.lateral.follow(coefficients, x.route.s, x.direction, travelled)
    body = world_boxes(road, x.route.s + travelled, x.direction, d, d_prime, 1.0, 1.0)  # type: ignore[arg-type]
    body = body._replace(half_length=own.length / 2, half_width=own.width / 2)
    s, d, tan = (field[0] for field in predicted)
    grown = world_boxes(road, s, x.direction, d, tan, 1.0, 1.0)  # type: ignore[arg-type]
    beside = clearance.beside_m + clearance.beside_s * x.others.speed[0]
    return overlap_depth(
        body,
        grown._replace(
            half_length=torch.as_tensor(other.length)[0] / 2 + clearance.ahead_m,
            half_width=torch.as_tensor(other.width)[0] / 2 + beside,
        ),
    )


def test_the_roadside_is_that_of_the_own_size(game: Game) -> None:
    roadside, n = game.planner.roadside, 200
    n_stations = len(roadside.clearance_m)
    s, direction = between(-12, 24, n_stations * n, 5).reshape(n_stations, n), torch.ones(n)
    d, d_prime = between(-1.5, 1.5, n, 6).expand(1, n_stations, n), between(-0.3, 0.3, n, 7).expand(1, n_stations, n)
    sizes = [(7.4, 2.0), (1.8, 0.7), (4.5, 1.8)]
    length, width = (torch.tensor([sizes[i % 3][axis] for i in range(n)]) for axis in (0, 1))
    together = roadside.excess(s, direction, d, d_prime, Size(length, width))
    for i, size in enumerate(sizes):
        alone = roadside.excess(s, direction, d, d_prime, Size(*size))
        torch.testing.assert_close(together[..., i::3], alone[..., i::3], atol=1e-5, rtol=0)
    assert float((together > 0).float().mean()) > 0.1


def long_and_short(planner: str) -> tuple[Game, World]:
    """Two worlds in which the oncoming vehicle waits for an ego that goes first: a bus and a car."""
    config = compose_config([f"planner={planner}", "policy=cnn_inf", *KINDS])
    game = build_game(config)
    world = meet(config, game, [[-8.0, -24.0]] * 2, [[5.0, 5.0]] * 2)
    length, width = torch.tensor([[4.5, 7.4], [4.5, 4.5]]), torch.tensor([[1.8, 2.0], [1.8, 1.8]])
    return game, replace(world, task=replace(world.task, length=length, width=width))


def test_a_long_vehicle_waits_with_its_front_at_the_same_place() -> None:
    game, world = long_and_short("consistent_stops")
    s = world.task.direction.new_tensor([-12.0, -12.0])
    direction, length = world.task.direction[:, 1], world.task.length[:, 1]
    passage = game.planner.give_way.passage  # type: ignore[union-attr]
    waiting = passage.waiting_s(s, direction, length) + length / 2
    leaving = passage.leaving_s(s, direction, length) - length / 2
    assert waiting[0] == waiting[1]
    assert leaving[0] == leaving[1]
    seen = passage.their_waiting_s(s, -direction, length) + length / 2
    torch.testing.assert_close(seen, waiting)
    worlds = drive(game, world, torch.tensor([[0.0, torch.inf]] * 2), 128)
    assert not worlds[-1].has_collided.any()
    assert worlds[-1].has_reached.all()
    at_rest = [w for w in worlds if (w.vehicles.speed[:, 1] < 0.05).all()]
    if at_rest:
        front = game.simulator.road.progress(at_rest[-1].vehicles.position, world.task.direction)[:, 1] + length / 2
        assert float(front.max()) < float(waiting.max()) + 0.1


def test_stops_before_the_mouth_are_places_of_the_front(game: Game) -> None:
    planner = game.planner
    x = draw_situations(planner.road, 2, 0)  # type: ignore[arg-type]
    route = x.route._replace(s=torch.tensor([-20.0, -20.0 - 1.45]), s_dot=torch.full((2,), 4.0))
    length = torch.tensor([4.5, 7.4])
    front = planner._as_ego(x._replace(route=route, size=Size(length, 0 * length)))
    assert front.s.tolist() == pytest.approx([-20.0, -20.0])


def test_a_bus_keeps_its_distance_when_it_reverses_and_when_another_is_behind() -> None:
    """Between a car and a bus behind it there is room of half the sum of their lengths less."""
    config = compose_config(["planner=reversing", "scenario.n_social=1", "scenario.n_followers=1", *KINDS])
    game = build_game(config)
    world = meet(config, game, [[3.0, 3.5, -18.6]] * 2, [[0.0, 0.0, 0.0]] * 2)
    length, width = torch.tensor([[4.5, 4.5, 1.8], [4.5, 4.5, 7.4]]), torch.full((2, 3), 1.8)
    world = replace(world, task=replace(world.task, length=length, width=width))
    motion = game.plan(game.perceive(world), torch.tensor([[6.0, 2.0, 2.0]] * 2))
    assert (motion.state.speed[:, EGO] < 0).tolist() == [True, False]


@pytest.mark.parametrize(
    "kind", ["bus", "cyclist", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("small_car", "van"))]
)
def test_two_planners_get_through_with_every_kind(kind: str) -> None:
    config = compose_config(["planner=reversing", "policy=cnn_inf", f"scenario/kind=[{kind}]"])
    game = build_game(config)
    task = draw_tasks(config, 12)
    worlds = drive(game, game.simulator.reset(task), torch.tensor([[6.0, 2.0]] * 12), config.scenario.episode_steps)
    assert not worlds[-1].has_collided.any()
    assert float(worlds[-1].has_reached.all(1).float().mean()) >= 0.9
