"""Many streets in one batch: tables agree with the closed form, worlds do not mix, what is held out stays out."""

import math
from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import drive
from pydantic import ValidationError
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.game.game import Game, build_game
from negopipe.simulation.build_road import build_road, draw_streets
from negopipe.simulation.drawn_street import drawn_street
from negopipe.simulation.geometry import overlap_depth
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.road_config import RoadConfig, StreetConfig
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, Task
from negopipe.simulation.streets import Streets
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.tree import map_tensors

FEW = (
    "scenario=random_streets",
    "curriculum=streets",
    "scenario.streets.n_training=4",
    "scenario.streets.n_held_out=4",
)


@pytest.fixture(scope="module")
def few() -> tuple[RunConfig, Game]:
    config = compose_config(list(FEW))
    return config, build_game(config)


def draw(config: RunConfig, n: int, streets: range | None = None) -> Task:
    families = {"mixture": config.scenario.families["mixture"]}
    return TaskSampler(config.scenario, families, torch.Generator().manual_seed(3), None, streets).draw(n)


def by_table(*streets: StreetConfig) -> Streets:
    return Streets([drawn_street(street, 110.0) for street in streets])


def anywhere(n: int, way: float) -> tuple[RouteState, Tensor]:
    """Vehicles beside their routes at any speed, and their direction, `way` with either sign."""
    generator = torch.Generator().manual_seed(0)
    s, d, d_prime, d_pprime, speed, accel, sign = torch.rand(7, n, generator=generator)
    route = RouteState(90 * s - 40, 6 * speed, 4 * accel - 2, 4 * d - 2, d_prime - 0.5, 0.2 * d_pprime - 0.1)
    return route, way * torch.sign(sign - 0.5)


@pytest.mark.parametrize("scenario", ["narrow_lane", "one_sided", "bent_street", "s_curve"])
def test_tables_agree_with_the_closed_form(scenario: str) -> None:
    """The second street of two is looked up, the first is another one."""
    street = compose_config([f"scenario={scenario}"]).scenario.road.street
    one, two = OneStreet(street), by_table(replace(street, corridor_length_m=15.0), street)
    route, direction = anywhere(4000, 1.0)
    for a, b in zip(one.route_offset(route.s, direction), two.route_offset(route.s, 2 * direction), strict=True):
        torch.testing.assert_close(a, b, atol=2e-6, rtol=0)
    there, here = one.to_world(route, direction), two.to_world(route, 2 * direction)
    torch.testing.assert_close(there.position, here.position, atol=2e-5, rtol=0)
    torch.testing.assert_close(there.yaw, here.yaw, atol=2e-6, rtol=0)
    torch.testing.assert_close(there.speed, here.speed, atol=1e-5, rtol=0)
    torch.testing.assert_close(there.accel, here.accel, atol=1e-3, rtol=0)
    back = two.to_route(here, 2 * direction)
    torch.testing.assert_close(back.s, route.s, atol=2e-5, rtol=0)
    torch.testing.assert_close(back.d, route.d, atol=1e-5, rtol=0)
    for a, b in zip(one.parked_boxes(), two.parked_boxes(torch.tensor(2.0)), strict=True):
        torch.testing.assert_close(torch.as_tensor(a), torch.as_tensor(b), atol=1e-5, rtol=0)


def test_frenet_round_trips_are_within_a_millimetre(few: tuple[RunConfig, Game]) -> None:
    road = few[1].simulator.road
    for street in range(1, 1 + road.n_streets):
        route, direction = anywhere(500, float(street))
        back = road.to_route(road.to_world(route, direction), direction)
        torch.testing.assert_close(back.s, route.s, atol=1e-3, rtol=0)
        torch.testing.assert_close(back.d, route.d, atol=1e-3, rtol=0)


@pytest.mark.parametrize("scenario", ["narrow_lane", pytest.param("bent_street", marks=pytest.mark.slow)])
def test_todays_street_in_a_table_gives_todays_outcomes(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions within 1 mm as long as nobody decides otherwise by a rounding, which one drive in 32 may."""
    config = compose_config([f"scenario={scenario}"])
    task, horizon = draw(config, 32), torch.tensor([[2.0, 6.0]]).expand(32, 2)
    one = build_game(config)
    table = by_table(config.scenario.road.street)
    monkeypatch.setattr("negopipe.simulation.simulator.build_road", lambda scenario, device: table)
    many = build_game(config)
    ours, theirs = (drive(game, game.simulator.reset(task), horizon, 30)[-1] for game in (one, many))
    is_same = (ours.vehicles.position - theirs.vehicles.position).norm(dim=-1).amax(-1) < 1e-3
    assert int((~is_same).sum()) <= 1
    assert int((ours.has_collided != theirs.has_collided).any(-1).sum()) <= 1


def test_a_mixed_batch_is_every_street_alone(few: tuple[RunConfig, Game]) -> None:
    config, game = few
    task = draw(config, 6, range(1, 9))
    assert len(task.direction.abs().unique()) > 3
    horizon = torch.tensor([[2.0, 6.0]])
    together = drive(game, game.simulator.reset(task), horizon.expand(6, 2), 15)[-1]
    for e in range(6):
        own = map_tensors(lambda field, i=e: field[i : i + 1], task)
        alone = drive(game, game.simulator.reset(own), horizon, 15)[-1]
        torch.testing.assert_close(alone.vehicles.position[0], together.vehicles.position[e], atol=1e-4, rtol=0)
        grids = (game.see(alone)[0], game.see(map_tensors(lambda field, i=e: field[i : i + 1], together))[0])
        assert (grids[0] != grids[1]).float().mean() < 1e-4


def test_a_street_turned_by_half_a_turn_is_driven_the_other_way() -> None:
    street = compose_config(["scenario=s_curve"]).scenario.road.street
    road = by_table(street)
    route, along = anywhere(200, 1.0)
    turned = by_table(
        replace(
            street,
            bends=tuple(replace(b, start_m=-b.start_m - b.length_m, angle_deg=-b.angle_deg) for b in street.bends),
        )
    )
    there = road.to_world(route, along)
    here = turned.to_world(route, -along)
    torch.testing.assert_close(there.position, -here.position, atol=1e-4, rtol=0)


def test_training_and_evaluation_share_no_street(few: tuple[RunConfig, Game]) -> None:
    config, _ = few
    scenario = config.scenario
    assert not set(scenario.training_streets) & set(scenario.held_out_streets)
    streets = draw_streets(scenario)
    assert len(set(streets)) == len(streets) == 8
    assert set(draw(config, 200).direction.abs().unique().tolist()) == {5.0, 6.0, 7.0, 8.0}
    training = draw(config, 200, scenario.training_streets)
    assert set(training.direction.abs().unique().tolist()) == {1.0, 2.0, 3.0, 4.0}
    assert torch.equal(training.direction[:, EGO], -training.direction[:, 1])


def test_streets_depend_on_their_seed_alone(few: tuple[RunConfig, Game]) -> None:
    again = compose_config([*FEW, "seed=7", "evaluation.task_seed=9"]).scenario
    other = compose_config([*FEW, "scenario.streets.seed=1"]).scenario
    assert draw_streets(again) == draw_streets(few[0].scenario)
    assert not set(draw_streets(other)) & set(draw_streets(again))


def test_more_streets_begin_with_the_same(few: tuple[RunConfig, Game]) -> None:
    more = replace(few[0].scenario.streets, n_held_out=6)
    streets = draw_streets(replace(few[0].scenario, streets=more))
    assert streets[4:8] == draw_streets(few[0].scenario)[4:8]


def test_every_size_is_drawn_from_its_interval(few: tuple[RunConfig, Game]) -> None:
    road, streets = few[0].scenario.road, draw_streets(few[0].scenario)
    for name in ("width_m", "corridor_length_m", "corridor_gap_m", "parked_irregularity", "swerve_length_m"):
        low, high = getattr(road, name)  # type: ignore[misc]
        drawn = [getattr(street, name) for street in streets]
        assert low <= min(drawn) < max(drawn) <= high
    assert {street.n_parked_per_side for street in streets} <= set(range(1, 6))
    for bend, drawn_bend in zip(road.bends, streets[0].bends, strict=True):
        low, high = bend.angle_deg  # type: ignore[misc]
        assert low <= drawn_bend.angle_deg <= high


def test_irregular_cars_keep_to_their_places() -> None:
    regular = compose_config(["scenario.road.n_parked_per_side=3", "scenario.road.width_m=9.0"]).scenario.road.street
    even = torch.tensor(by_table(regular).parked_on_line[0])
    odd = torch.tensor(by_table(replace(regular, parked_irregularity=1.0, parked_seed=4)).parked_on_line[0])
    assert len(odd) == len(even) == 6
    assert (odd[:, 1].abs() >= even[:, 1].abs() - 1e-6).all()  # never farther into the corridor
    assert (odd[:, 1].abs() + odd[:, 3] / 2 <= 4.5 + 1e-6).all()  # nor over the kerb
    assert int((odd - even).abs().amax(-1).gt(1e-3).sum()) == 2  # the cars in the middle of both rows
    empty = by_table(replace(regular, parked_empty_share=1.0)).parked_on_line[0]
    assert sorted(sigma for sigma, *_ in empty) == pytest.approx([-4.2, -4.2, 4.2, 4.2])


@pytest.fixture(scope="module")
def chicane() -> tuple[RunConfig, Game]:
    """Two corridors one behind the other, cars on the left in the first and on the right in the second."""
    overrides = ["n_corridors=2", "parked_sides=alternating", "swerve_length_m=16.0", "between_corridors_m=40.0"]
    config = compose_config([*(f"scenario.road.{each}" for each in overrides), "scenario.episode_steps=200"])
    return config, build_game(config)


def test_routes_pass_every_row(chicane: tuple[RunConfig, Game]) -> None:
    road = chicane[1].simulator.road
    s = torch.tensor([-20.0, 6.0, 32.0, 58.0, 90.0])  # lane, first corridor, lane between, second, lane
    d, d_prime, _ = road.route_offset(s, torch.ones(5))
    assert d.tolist() == pytest.approx([-1.75, -1.9, -1.75, 1.9, -1.75], abs=1e-5)
    assert float(d_prime.abs().max()) < 1e-5
    d, _, _ = road.route_offset(s, -torch.ones(5))
    assert d.tolist() == pytest.approx([-1.75, -1.9, -1.75, 1.9, -1.75], abs=1e-5)  # it meets the second one first


def test_everyone_heeds_the_next_narrow_place(chicane: tuple[RunConfig, Game]) -> None:
    road = chicane[1].simulator.road
    s = torch.tensor([-9.0, 11.0, 13.0, 70.0])
    first, last = road.narrow_place(s, torch.ones(4))
    assert first.tolist() == [0.0, 0.0, 52.0, 52.0]
    assert last.tolist() == [12.0, 12.0, 64.0, 64.0]
    assert road.corridor_m(torch.ones(1)).item() == 64.0


def test_the_oncoming_vehicle_meets_the_same_places_the_other_way_round(chicane: tuple[RunConfig, Game]) -> None:
    passage = Passage.of(chicane[1].simulator.collisions, chicane[1].simulator.sizes)
    for way, oncoming in ((0, 1), (1, 0)):
        assert torch.equal(passage.their_waiting[way], passage.waiting[oncoming].flip(0))
        assert torch.equal(passage.their_leaving[way], passage.leaving[oncoming].flip(0))
        assert (
            passage.waiting[way, 0]
            < 0
            < passage.leaving[way, 0]
            < passage.waiting[way, 1]
            < 52
            < passage.leaving[way, 1]
        )
    s, along = torch.tensor([6.0, 30.0, 58.0]), torch.ones(3)  # in the first, on the way to the second, in it
    assert passage.their_waiting_s(s, along, 4.5).tolist() == passage.waiting[1, [1, 0, 0]].tolist()


def test_both_get_through_both(chicane: tuple[RunConfig, Game]) -> None:
    config, game = chicane
    world = game.simulator.reset(draw(config, 8))
    last = drive(game, world, torch.tensor([[2.0, 6.0]]).expand(8, 2), 200)[-1]
    assert last.has_reached.all()
    assert not last.has_collided.any()


def test_near_corridors_are_one_place() -> None:
    near = compose_config(["scenario.road.n_corridors=2", "scenario.road.between_corridors_m=14.0"])
    road = build_road(near.scenario)
    assert road.narrow_places.tolist() == [[[0.0, 38.0]]] * 2


def test_grids_show_what_lies_beyond_the_kerbs(few: tuple[RunConfig, Game]) -> None:
    """A cell is occupied if its centre is beyond a kerb, or in a parked car; 4 cm are a strip's sagitta."""
    config, game = few
    road, o, n = game.simulator.road, config.observation, 24
    world = game.simulator.reset(draw(config, n, range(1, 9)))
    grid = game.see(world)[:, 0].bool()
    rows, columns = torch.meshgrid(torch.arange(o.n_cells), torch.arange(o.n_cells), indexing="ij")
    u = (o.n_cells - rows - 0.5) * o.cell_along_m - o.behind_m
    v = (o.n_cells / 2 - columns - 0.5) * o.cell_across_m
    yaw, position = world.vehicles.yaw[:, EGO, None, None], world.vehicles.position[:, EGO, None, None]
    x = position[..., 0] + u * torch.cos(yaw) - v * torch.sin(yaw)
    y = position[..., 1] + u * torch.sin(yaw) + v * torch.cos(yaw)
    direction = world.task.direction[:, EGO, None, None].expand_as(x)
    sigma, d = road.line(direction).project(x, y)
    right, left = road.kerbs_at(sigma, direction)
    beyond = torch.maximum(d - left, -d - right)
    point = [field[..., None] for field in (x, y, torch.ones_like(x), torch.zeros_like(x))]
    depth = overlap_depth(road.parked_boxes(direction)._replace(), _points(*point)).amax(-1)
    is_clear_of_edges = (beyond.abs() > 0.04) & (depth.abs() > 1e-3) & (_to_vehicles(world, x, y) > 0.1)
    expected = (beyond > 0) | (depth > 0)
    assert torch.equal(grid[is_clear_of_edges], expected[is_clear_of_edges])
    assert 0.2 < float(expected.float().mean()) < 0.9


def _points(x: Tensor, y: Tensor, cos: Tensor, sin: Tensor):  # type: ignore[no-untyped-def]
    from negopipe.simulation.geometry import Boxes

    return Boxes(x, y, cos, sin, 0.0, 0.0)


def _to_vehicles(world, x: Tensor, y: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
    """[E, H, W] m: distance to the nearest vehicle's circumference."""
    away = [
        torch.hypot(x - world.vehicles.position[:, i, 0, None, None], y - world.vehicles.position[:, i, 1, None, None])
        for i in range(2)
    ]
    return torch.minimum(*away) - math.hypot(4.5, 1.8) / 2


def test_a_street_compiles_once_for_all(few: tuple[RunConfig, Game]) -> None:
    """No graph break, and another street is no other shape."""
    road: Road = few[1].simulator.road
    n_compiled = 0

    def count(graph, example):  # type: ignore[no-untyped-def]
        nonlocal n_compiled
        n_compiled += 1
        return graph.forward

    def there_and_back(route: RouteState, direction: Tensor) -> Tensor:
        return road.to_route(road.to_world(route, direction), direction).s

    compiled = torch.compile(there_and_back, backend=count, fullgraph=True, dynamic=False)
    for street in (1.0, 5.0, 8.0):
        route, direction = anywhere(16, street)
        torch.testing.assert_close(compiled(route, direction), route.s, atol=1e-3, rtol=0)
    assert n_compiled == 1


@pytest.mark.parametrize(
    ("override", "line"),
    [
        (
            "scenario.road.corridor_length_m=[24.0,6.0]",
            "scenario.road.corridor_length_m must be [low, high] with low <= ",
        ),
        ("scenario.road.corridor_length_m=[6.0]", "scenario.road.corridor_length_m must have at least 2 items"),
        ("scenario.road.corridor_length_m=long", "scenario.road.corridor_length_m must be a valid number, got long"),
        ("scenario.road.corridor_gap_m=[-1.0,3.0]", "scenario.road.corridor_gap_m.0 must be greater than 0, got -1"),
        ("scenario.road.corridor_gap_m=[1.0,1.2]", "scenario.road must leave streets with streets.clearance_m = 0.3"),
        ("scenario.road.width_m=[4.0,4.2]", "scenario.road must leave streets that fit, none of 1000 does: corr"),
        ("scenario.road.parked_sides=[both,up]", "scenario.road.parked_sides"),
        ("scenario.streets.n_training=0", "scenario.streets.n_training must be greater than or equal to 1, got 0"),
    ],
)
def test_streets_that_cannot_be_are_refused_in_one_line(override: str, line: str) -> None:
    with pytest.raises(UserError) as raised:
        compose_config([*FEW, override])
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_single_street_that_does_not_fit_is_refused(few: tuple[RunConfig, Game]) -> None:
    values = {name: getattr(compose_config([]).scenario.road, name) for name in RoadConfig.__dataclass_fields__}
    with pytest.raises(ValidationError, match="between_corridors_m must be at least swerve_length_m"):
        RoadConfig(**(values | {"n_corridors": 2, "between_corridors_m": 3.0}))
