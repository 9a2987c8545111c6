"""Streets of maps: narrow places found, routes with room, frames that agree with the map, no contact unseen.

The maps are drawn by the tests; those of real places are read where they are at hand.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import compose_config
from drawn_maps import commonroad_map, published, two_way_map, written

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.trace import OUTCOMES
from negopipe.game.game import Game, build_game
from negopipe.maps import MapStreet
from negopipe.maps.line import integrate
from negopipe.maps.street import to_line, to_plane
from negopipe.simulation.build_road import build_road, draw_streets
from negopipe.simulation.drivable import check_routes
from negopipe.simulation.geometry import boxes_from_pose, overlap_depth, rim
from negopipe.simulation.map_config import read_map
from negopipe.simulation.map_road import drivable_part, map_rules
from negopipe.simulation.map_street import MapRules, cut, narrow_places, street_of_map
from negopipe.simulation.road import RouteState
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import VehicleState
from negopipe.simulation.streets import Streets

PUBLISHED = {
    "karlsruhe": ("lanelet2", "karlsruhe/mapping_example.osm", []),
    "starnberg": ("commonroad", "starnberg/DEU_Starnberg-1_1_T-1.xml", []),
    "over": ("commonroad", "over/ZAM_Over-1_1.xml", ["scenario.map.rows=[]"]),
}
NOWHERE = Path("drawn.osm")


def rows(*places: tuple[str, float, float]) -> str:
    """Override that parks vehicles at (side, from_m, to_m)."""
    each = [f"{{side:{side},from_m:{start},to_m:{end},kerb_gap_m:0.2}}" for side, start, end in places]
    return f"scenario.map.rows=[{','.join(each)}]"


ONE_ROW = rows(("left", 90.0, 110.0))


def on_map(path: Path, *overrides: str, scenario: str = "lanelet2") -> RunConfig:
    return compose_config([f"scenario={scenario}", f"scenario.map.file={path}", *overrides])


@pytest.fixture(scope="module")
def osm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gently bent street, 200 m long and 6 m wide."""
    return two_way_map(200.0)[0].write(tmp_path_factory.mktemp("maps") / "drawn.osm")


@pytest.fixture(scope="module")
def drawn(osm: Path) -> tuple[RunConfig, Game]:
    config = on_map(osm, ONE_ROW)
    return config, build_game(config)


@pytest.fixture(scope="module", params=["drawn", *PUBLISHED])
def real(request: pytest.FixtureRequest) -> tuple[RunConfig, Game]:
    if request.param == "drawn":
        found: tuple[RunConfig, Game] = request.getfixturevalue("drawn")
        return found
    scenario, name, overrides = PUBLISHED[request.param]
    config = on_map(published(name), *overrides, scenario=scenario)
    return config, build_game(config)


@pytest.fixture(scope="module")
def rules(drawn: tuple[RunConfig, Game]) -> MapRules:
    return map_rules(drawn[0].scenario)


def straight(length_m: int = 160, bend: float = 0.0, bend_from_m: float = 1e3) -> MapStreet:
    """A street 7 m wide with a gap of 3 m from 70 to 90 m, and a bend to its end."""
    sigma = 0.5 * np.arange(2 * length_m + 1)
    line = integrate(np.array([5.0, -3.0, 0.7]), np.where(sigma > bend_from_m, bend, 0.0))
    half = np.full(len(sigma), 3.5)
    parked = np.array([[at, d, 0.0, 10.0, 2.0] for at in (75.0, 85.0) for d in (-2.5, 2.5)])
    return MapStreet(line.points, line.heading, line.curvature, half, half.copy(), parked, "drawn", "", "")


def driven_part(config: RunConfig) -> tuple[MapStreet, float]:
    """The street of a config's map as far as it is driven on, and the arc length at which sigma is 0."""
    assert config.scenario.map is not None
    rules = map_rules(config.scenario)
    street = drivable_part(read_map(config.scenario.map), rules, NOWHERE)
    narrow = narrow_places(street, rules, NOWHERE)
    return street, float(narrow[0, 0] + narrow[-1, 1]) / 2


def in_map(street: MapStreet, middle: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Arc lengths and offsets on the map of points [N, 2] in the world."""
    (origin,), (heading,) = to_plane(street, np.array([middle]), np.zeros(1))
    turned = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    return to_line(street, origin + points @ turned.T)


def test_a_row_makes_a_narrow_place(drawn: tuple[RunConfig, Game]) -> None:
    street, middle = driven_part(drawn[0])
    at, d, _, length, _ = street.parked.T
    road = drawn[1].simulator.road
    half_m = float(road.narrow_places[0, 0, 1]) / 2
    assert road.narrow_places.shape == (2, 1, 2)
    assert middle - half_m == pytest.approx((at - length / 2)[d > 0].min(), abs=0.5)
    assert middle + half_m == pytest.approx((at + length / 2)[d > 0].max(), abs=0.5)


def test_rows_far_apart_are_two_places_and_near_ones_are_one(osm: Path) -> None:
    def places(second_m: float) -> list[list[float]]:
        config = on_map(osm, rows(("left", 70.0, 85.0), ("right", second_m, second_m + 15.0)))
        narrow: list[list[float]] = build_road(config.scenario).narrow_places[0].tolist()
        return narrow

    (first, last), (again, end) = places(125.0)
    assert first == 0
    assert again - last > 36
    assert end < 72
    assert len(places(105.0)) == 1


def test_a_wide_vehicle_and_more_clearance_make_more_places_narrow(rules: MapRules) -> None:
    street = replace(straight(), left_m=np.full(321, 2.3), right_m=np.full(321, 2.3), parked=np.zeros((0, 5)))
    with pytest.raises(UserError, match=r"has no narrow place, the free width is 4.60 to 4.60 m; less than 4.50 m"):
        narrow_places(street, rules, NOWHERE)
    assert narrow_places(street, replace(rules, clearance_m=0.4), NOWHERE).tolist() == [[0.0, 160.0]]
    wide = replace(rules, vehicle=replace(rules.vehicle, width_m=2.0))
    assert narrow_places(street, wide, NOWHERE).tolist() == [[0.0, 160.0]]


def test_a_bend_needs_more_width(rules: MapRules) -> None:
    street = replace(straight(160, 0.02, 100.0), left_m=np.full(321, 2.27), right_m=np.full(321, 2.27))
    (first, last), *_ = narrow_places(replace(street, parked=np.zeros((0, 5))), rules, NOWHERE)
    assert (first, last) == (100.5, 160.0)


def test_routes_keep_right_and_take_the_middle_of_a_narrow_place(rules: MapRules) -> None:
    street = replace(straight(), right_m=np.full(321, 4.0))  # 7.5 m wide; the gap's middle is on the line
    road = Streets([street_of_map(street, rules, NOWHERE)])
    s = torch.tensor([-30.0, -24.0, 0.0, 10.0, 20.0, 45.0])
    d, d_prime, _ = road.route_offset(s, torch.ones(6))
    assert d.tolist() == pytest.approx([-2.25, -2.25, 0.0, 0.0, 0.0, -2.25], abs=1e-5)
    assert float(d_prime.abs().max()) < 1e-5
    d, _, _ = road.route_offset(s, -torch.ones(6))
    assert d.tolist() == pytest.approx([-1.75, -1.75, 0.0, 0.0, 0.0, -1.75], abs=1e-5)
    farther = Streets([street_of_map(street, replace(rules, lane_m=1.5), NOWHERE)])
    assert float(farther.route_offset(s, torch.ones(6))[0][0]) == pytest.approx(-2.5, abs=1e-5)
    shorter = Streets([street_of_map(street, replace(rules, swerve_m=10.0), NOWHERE)])
    assert float(shorter.route_offset(torch.tensor([-14.0]), torch.ones(1))[0]) == pytest.approx(-2.25, abs=1e-5)
    assert float(road.target_s(torch.ones(()))) == 20 + rules.target_m


def test_routes_keep_their_clearance_and_their_bends(real: tuple[RunConfig, Game]) -> None:
    """On the whole map, at half the spacing of the check that the road has passed."""
    config, game = real
    road, streets = game.simulator.road, config.scenario.streets
    assert isinstance(road, Streets)
    routes = check_routes(road, config.scenario.vehicle, streets.clearance_m - 0.01)
    street, middle = driven_part(config)
    is_on_map = (routes.sigma + middle >= 0) & (routes.sigma + middle <= street.length_m)
    assert not routes.touches[is_on_map].any()
    assert float(routes.curvature[is_on_map].abs().max()) <= streets.curvature_max_1pm


def test_the_line_and_the_kerbs_are_those_of_the_map(real: tuple[RunConfig, Game]) -> None:
    config, game = real
    road, (street, middle) = game.simulator.road, driven_part(config)
    sigma = torch.from_numpy(street.sigma[4:-4] - middle).float()
    x, y, _ = road.line(torch.ones_like(sigma)).pose(sigma)
    along, d = in_map(street, middle, torch.stack([x, y], -1).double().numpy())
    assert np.abs(along - street.sigma[4:-4]).max() < 0.01
    assert np.abs(d).max() < 0.01
    right, left = road.kerb_lines(sigma, torch.tensor(1.0)).double().numpy()
    assert np.abs(in_map(street, middle, left)[1] - street.left_m[4:-4]).max() < 0.02
    assert np.abs(in_map(street, middle, right)[1] + street.right_m[4:-4]).max() < 0.02


def test_frenet_round_trips_are_within_a_millimetre(real: tuple[RunConfig, Game]) -> None:
    config, game = real
    road, (street, middle) = game.simulator.road, driven_part(config)
    half_m = float(road.corridor_m(torch.ones(()))) / 2
    s, d, d_prime, d_pprime, speed, accel, sign = torch.rand(7, 4000, generator=torch.Generator().manual_seed(0))
    s = street.length_m * s - middle + half_m
    route = RouteState(s, 6 * speed, 4 * accel - 2, 5 * d - 2.5, d_prime - 0.5, 0.2 * d_pprime - 0.1)
    direction = torch.sign(sign - 0.5)
    back = road.to_route(road.to_world(route, direction), direction)
    torch.testing.assert_close(back.s, route.s, atol=1e-3, rtol=0)
    torch.testing.assert_close(back.d, route.d, atol=1e-3, rtol=0)
    torch.testing.assert_close(back.d_prime, route.d_prime, atol=1e-3, rtol=0)


def contacts(config: RunConfig, game: Game, vehicles: VehicleState, part: tuple[MapStreet, float]) -> torch.Tensor:
    """[E] bool: footprints overlap one another, a parked car, or the map's kerbs by more than 3 cm."""
    size, road = config.scenario.vehicle, game.simulator.road
    x, y = vehicles.position.unbind(-1)
    boxes = boxes_from_pose(x, y, vehicles.yaw, size.length_m, size.width_m)
    each = boxes_from_pose(x[..., None], y[..., None], vehicles.yaw[..., None], size.length_m, size.width_m)
    ego, social = (boxes_from_pose(x[:, i], y[:, i], vehicles.yaw[:, i], size.length_m, size.width_m) for i in (0, 1))
    (street, middle), outline = part, torch.stack(rim(boxes), -1)
    along, d = in_map(street, middle, outline.double().reshape(-1, 2).numpy())
    beyond = np.maximum(
        d - np.interp(along, street.sigma, street.left_m), -d - np.interp(along, street.sigma, street.right_m)
    )
    is_beyond = (beyond > 0.03) & (along > 0) & (along < street.length_m)
    is_over_kerb = torch.from_numpy(is_beyond).reshape(outline.shape[:-1]).any(0).any(-1)
    is_in_car = (overlap_depth(each, road.parked_boxes()) > 1e-3).flatten(1).any(1)
    return is_over_kerb | is_in_car | (overlap_depth(ego, social) > 1e-3)


def test_random_drives_have_no_unseen_contact(real: tuple[RunConfig, Game]) -> None:
    """Everybody draws a new horizon every second; who touches anything is recorded as collided."""
    config, game = real
    part, random = driven_part(config), torch.Generator().manual_seed(1)
    families = {"mixture": config.scenario.families["mixture"]}
    world = game.simulator.reset(TaskSampler(config.scenario, families, random).draw(16))
    first = game.simulator.road.progress(world.vehicles.position, world.task.direction)
    for step in range(36):
        if step % 5 == 0:
            horizon = 2.0 * torch.randint(4, (16, 2), generator=random)
        world, _ = game.simulator.step(world, game.plan(game.perceive(world), horizon).state)
        assert torch.isfinite(world.vehicles.position).all()
        assert not (contacts(config, game, world.vehicles, part) & ~world.has_collided.any(1)).any()
    driven_m = game.simulator.road.progress(world.vehicles.position, world.task.direction) - first
    assert float(driven_m.mean()) > 12
    assert float(driven_m.max()) > 25


@pytest.mark.slow
def test_a_cautious_driver_gets_through(drawn: tuple[RunConfig, Game]) -> None:
    config, game = drawn
    choice = ["evaluation/baseline=[cautious]", "report.side_by_side=[]"]
    cautious = compose_config(choice).evaluation.baselines["cautious"]
    families = {"yield": config.scenario.families["yield"]}
    task = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(6)
    paid, names = config.evaluation.reward, ("baseline", "cautious")
    trace = drive_episodes(game, partial(cautious.driver, game), task, 6, paid, names, cautious.is_lockstep)
    assert int((trace.outcome == OUTCOMES.index("success")).sum()) == 6


def test_commonroad_gives_the_same_street_as_lanelet2(drawn: tuple[RunConfig, Game], tmp_path: Path) -> None:
    path = written(commonroad_map(200.0), tmp_path / "drawn.xml")
    road = build_road(on_map(path, ONE_ROW, scenario="commonroad").scenario)
    torch.testing.assert_close(road.narrow_places, drawn[1].simulator.road.narrow_places, atol=0.5, rtol=0)
    sigma = torch.linspace(-80, 80, 100)
    for a, b in zip(
        road.line(sigma.sign()).pose(sigma), drawn[1].simulator.road.line(sigma.sign()).pose(sigma), strict=True
    ):
        torch.testing.assert_close(a, b, atol=0.3, rtol=0)


def test_cars_beside_the_road_are_seen_but_not_planned_around(rules: MapRules) -> None:
    beside = np.array([[20.0, 5.6, np.pi / 2, 4.0, 1.8], [30.0, -4.4, 0.0, 4.0, 1.8]])
    street = replace(straight(), parked=np.concatenate([straight().parked, beside]))
    road = Streets([street_of_map(street, rules, NOWHERE)])
    assert len(road.parked_on_line[0]) == 4
    boxes = road.parked_boxes()
    assert boxes.x.shape == (6,)
    assert boxes.x[4].item() == pytest.approx(20.0 - 80.0)
    assert (2 * torch.as_tensor(boxes.half_length)[4]).item() == pytest.approx(1.8)  # across the street
    assert (2 * torch.as_tensor(boxes.half_width)[4]).item() == pytest.approx(4.0)


def test_plans_heed_a_kerb_that_a_footprint_reaches(rules: MapRules) -> None:
    left = np.where(straight().sigma < 40, 6.0, 3.5)
    road = Streets([street_of_map(replace(straight(), left_m=left), rules, NOWHERE)])
    s = torch.tensor([40.0 - 70 - 6, 40.0 - 70 - 1.5])  # s = 0 at 70 m
    excess = road.kerb_excess(s, torch.ones(2), torch.full((2,), 3.0), torch.full((2,), 0.9), 0.0)
    assert excess.tolist() == pytest.approx([-2.1, 0.4], abs=1e-4)


def test_a_street_is_cut_where_nobody_could_drive_on(rules: MapRules) -> None:
    street = straight(200, 0.2, 170.0)
    part = drivable_part(street, rules, NOWHERE)
    assert 130 < part.length_m < 170
    assert part.points[0].tolist() == street.points[0].tolist()
    assert drivable_part(straight(200), rules, NOWHERE).length_m == 200
    assert len(cut(street, 78.2, 100.0).parked) == 2
    assert cut(street, 78.2, 100.0).parked[0, 0] == pytest.approx(85.0 - 78.5)
    road = Streets([street_of_map(part, rules, NOWHERE)])
    far = torch.tensor([300.0])
    (kappa, kappa_prime), (heading, turned) = (
        road.line(far.sign()).curvature(far),
        (road.line(far.sign()).heading(torch.tensor([100.0 + extra])) for extra in (0.0, 200.0)),
    )
    assert kappa.item() == kappa_prime.item() == 0
    assert heading.item() == turned.item()


def test_a_map_has_one_street_whatever_the_road_says(osm: Path) -> None:
    scenario = on_map(osm, ONE_ROW, "scenario.road.width_m=[1.0,2.0]").scenario
    assert scenario.training_streets == scenario.held_out_streets == range(1, 2)
    assert draw_streets(scenario) == ()
    assert build_road(scenario).n_streets == 1
    assert scenario.most_parked == 3


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["scenario.map.rows=[]"], "drawn.osm: its street has no narrow place, the free width is 6.00 to 6.0"),
        ([rows(("left", 90.0, 110.0), ("right", 90.0, 110.0))], "m along the street a free width of 2.06"),
        (
            [rows(("left", 20.0, 40.0))],
            "m long before its first narrow place; start distances and scenario.road.target",
        ),
        (
            [rows(("left", 160.0, 180.0))],
            "m long behind its last narrow place; start distances and scenario.road.target",
        ),
        (
            [ONE_ROW, "scenario.road.swerve_length_m=6.0"],
            "m along the street a route has less than scenario.streets.clearance_m = 0.3 beside a vehicle",
        ),
        (
            [ONE_ROW, "scenario.streets.curvature_max_1pm=0.02"],
            "1/m; scenario.streets.curvature_max_1pm = 0.02 is allowed (a longer scenario.road.swerve_length_m)",
        ),
        ([ONE_ROW, "scenario.road.swerve_length_m=[12.0,18.0]"], "scenario.road.swerve_length_m must be a number wher"),
        ([ONE_ROW, "scenario.map.format=opendrive"], "scenario.map.format"),
        ([ONE_ROW, "scenario.map.format=commonroad"], "drawn.osm: its root is <osm>"),
        ([ONE_ROW, "scenario.map.file=nowhere.osm"], "nowhere.osm: cannot be read (No such file or directory)"),
        ([ONE_ROW, "scenario.map.ids=[7]"], "drawn.osm: lanelet 7 is not one that both directions use"),
        ([rows(("up", 90.0, 110.0))], "scenario.map.rows.0.side"),
        (
            [ONE_ROW, "scenario.map.parking.fill=2.0"],
            "scenario.map.parking.fill must be less than or equal to 1, got 2",
        ),
        ([ONE_ROW, "scenario.n_social=6"], "behind its last narrow place; start distances and"),
    ],
)
def test_what_cannot_be_driven_on_is_refused_in_one_line(osm: Path, overrides: list[str], line: str) -> None:
    with pytest.raises(UserError) as raised:
        on_map(osm, *overrides)
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_scenario_without_its_file_is_refused() -> None:
    with pytest.raises(UserError, match=r"^scenario\.map\.file is missing$"):
        compose_config(["scenario=lanelet2"])
