"""Figures of a map's street in the sizes of `scenario.road`: python jobs/fit_street.py [--bends 6] <scenario of a map>

The scenario is that of the config, such as scenario=lanelet2 scenario.map.file=mapping_example.osm. Prints YAML and the
largest deviations. Bends are fitted to the map's line by least squares. The width takes a node where it deviates most
from the smooth steps between the nodes so far. Corridor and bays are where the map's scenario parks.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares

from negopipe import load_config
from negopipe.maps import MapStreet, free_sides
from negopipe.maps.line import integrate
from negopipe.maps.street import to_line
from negopipe.simulation.bays import Bay, BaySide
from negopipe.simulation.build_road import build_road
from negopipe.simulation.map_config import read_map
from negopipe.simulation.map_road import drivable_part, map_rules
from negopipe.simulation.map_street import narrow_places
from negopipe.simulation.reference_line import REACH_M, Bend, Course
from negopipe.simulation.road import Road
from negopipe.simulation.road_config import BayConfig, BendConfig, RoadConfig, WidthChangeConfig
from negopipe.simulation.road_width import WidthChange, width_at
from negopipe.simulation.scenario import ScenarioConfig

Array = np.ndarray
BEND_M = (12.0, 100.0)
"""Interval of a bend's length."""
BEYOND_M = 40.0
"""Farthest that the middle of a bend lies beyond the ends of the map's line."""
MOST_STEPS = 60
"""Upper bound on the steps of the fit of the bends."""
NODE_M, WIDTH_M = 4.0, 0.1
"""Least distance of two nodes of the width, and its largest deviation where they may be as near as they need."""
ROW_GAP_M = 3.0
"""Gap between two parked cars from which on they are in different bays."""
ON_ROAD_M = 0.2
"""Depth over the kerb from which on a parked car stands on the road."""
ITEMS = {"bends": BendConfig, "width_changes": WidthChangeConfig, "bays": BayConfig}


@dataclass(frozen=True)
class Part:
    """The part of a map's street that is driven on, and its only narrow place, first and last sigma, m.

    sigma: [K], of the line's points
    """

    street: MapStreet
    sigma: Array
    narrow: tuple[float, float]


def part_of(scenario: ScenarioConfig) -> Part:
    """The street of a scenario of a map, along which sigma is 0 in the middle of its parked cars."""
    assert scenario.map is not None
    rules, path = map_rules(scenario), Path(scenario.map.file)
    street = drivable_part(read_map(scenario.map), rules, path)
    ((first, last),) = narrow_places(street, rules, path)
    at, length = street.parked[:, 0], street.parked[:, 3]
    inside = is_on_road(street) & (at > first - 1) & (at < last + 1)
    begin, end = (at - length / 2)[inside].min(), (at + length / 2)[inside].max()
    return Part(street, street.sigma - (begin + end) / 2, (-(end - begin) / 2, (end - begin) / 2))


def is_on_road(street: MapStreet) -> Array:
    """[P] bool: parked cars that reach over the kerb."""
    at, d, yaw, length, width = street.parked.T
    across = (length * np.abs(np.sin(yaw)) + width * np.abs(np.cos(yaw))) / 2
    kerb = np.where(d > 0, *(np.interp(at, street.sigma, side) for side in (street.left_m, street.right_m)))
    return np.asarray(np.abs(d) - across < kerb - ON_ROAD_M)


def fit_bends(part: Part, n: int) -> list[Bend]:
    """Bends by which the line passes the map's with the least squares of the distances of its points."""
    street, sigma = part.street, part.sigma
    length_m, middles = street.length_m / n, np.linspace(sigma[0], sigma[-1], n)
    turned = np.degrees(length_m * np.interp(middles, sigma, street.curvature))
    bends = np.stack([middles, np.full(n, np.clip(2 * length_m, *BEND_M)), turned], axis=-1)
    start = np.concatenate([[*street.points[0], street.heading[0]], bends.ravel()])
    least = [-np.inf, -np.inf, -np.inf, *[max(sigma[0] - BEYOND_M, BEND_M[1] / 2 - REACH_M), BEND_M[0], -90] * n]
    most = [np.inf, np.inf, np.inf, *[min(sigma[-1] + BEYOND_M, REACH_M - BEND_M[1] / 2), BEND_M[1], 90] * n]

    def distances(values: Array) -> Array:
        course = Course(bends_of(values[3:]))
        curvature = course.curvature(torch.from_numpy(sigma))[0].numpy()
        return (integrate(values[:3], curvature).points - street.points).ravel()

    bounds, margin = np.array([least, most]), np.array([[1e-6], [-1e-6]])
    start = np.clip(start, *(bounds + margin))
    found = least_squares(distances, start, bounds=bounds, x_scale="jac", max_nfev=MOST_STEPS)
    rounded = [
        Bend(*np.round([bend.start_m, bend.length_m, bend.angle_deg], 2).tolist()) for bend in bends_of(found.x[3:])
    ]
    return sorted(rounded, key=lambda bend: bend.start_m)


def bends_of(values: Array) -> list[Bend]:
    """Bends of middles, lengths (m) and angles (degrees) one behind the other, [3 n]."""
    each = values.reshape(-1, 3).tolist()
    return [Bend(middle - length / 2, length, angle) for middle, length, angle in each]


def fit_width(part: Part) -> tuple[float, list[WidthChange]]:
    """Width before its changes, and the changes."""
    sigma, width = part.sigma, part.street.left_m + part.street.right_m
    inside = (sigma >= part.narrow[0]) & (sigma <= part.narrow[1])
    corridor_m = float(width[inside].mean())
    nodes = {sigma[0]: width[0], part.narrow[0]: corridor_m, part.narrow[1]: corridor_m, sigma[-1]: width[-1]}
    while True:
        first_m, changes = steps_between(nodes)
        deviation = np.abs(width_at(torch.from_numpy(sigma), first_m, changes).numpy() - width)
        near = np.abs(sigma[:, None] - np.array(list(nodes))).min(1) < NODE_M
        deviation[near | inside] = 0
        worst = int(deviation.argmax())
        if deviation[worst] < WIDTH_M:
            return first_m, changes
        nodes[sigma[worst]] = width[worst]


def steps_between(nodes: dict[float, float]) -> tuple[float, list[WidthChange]]:
    """A change between every two neighbours of nodes (sigma: width) whose widths differ, in steps of 5 cm."""
    at = sorted((round(float(sigma), 2), round(20 * float(width_m)) / 20) for sigma, width_m in nodes.items())
    changes = [
        WidthChange(a, round(b - a - 0.01, 2), width_m)
        for (a, before_m), (b, width_m) in pairwise(at)
        if before_m != width_m
    ]
    return at[0][1], changes


def fit_corridor(part: Part) -> dict[str, Any]:
    """Sizes of the corridor: its length and gap, sides, number and size of the parked cars."""
    street, (first, last) = part.street, part.narrow
    at, d, _, length, width = street.parked.T
    cars = is_on_road(street) & (np.abs(at + part.sigma[0]) <= last)
    sides = sorted({"left" if offset > 0 else "right" for offset in d[cars]})
    inside = np.abs(part.sigma) <= last
    free_left_m, free_right_m = free_sides(street)
    gap_m, kerbs_m = (free_left_m + free_right_m)[inside], (street.left_m + street.right_m)[inside]
    room_m = (kerbs_m.mean() - gap_m.min()) / len(sides)
    sizes = {
        "corridor_length_m": last - first,
        "corridor_gap_m": gap_m.min(),
        "parked_car_length_m": length[cars].mean(),
        "parked_car_width_m": min(width[cars].mean(), room_m),
    }
    floored = {name: float(np.floor(100 * value) / 100) for name, value in sizes.items()}
    return floored | {
        "parked_sides": sides[0] if len(sides) == 1 else "both",
        "n_parked_per_side": int(cars.sum()) // len(sides),
    }


def fit_bays(part: Part, car: tuple[float, float]) -> list[Bay]:
    """Rows of the cars that are parked beside the road, as cars of one length and width."""
    street = part.street
    beside = street.parked[~is_on_road(street)]
    bays = []
    sides: tuple[tuple[int, BaySide], ...] = ((1, "left"), (-1, "right"))
    for sign, side in sides:
        at, d, yaw, length, width = beside[beside[:, 1] * sign > 0].T
        across = np.abs(np.sin(yaw)) > 0.5
        half, deep = np.where(across, width, length) / 2, np.where(across, length, width) / 2
        begin, end = at - half + part.sigma[0], at + half + part.sigma[0]
        new = np.flatnonzero((begin[1:] - end[:-1] > ROW_GAP_M) | (across[1:] != across[:-1])) + 1
        for row in np.split(np.arange(len(at)), new) if len(at) else []:
            first, last, needs = begin[row[0]], end[row[-1]], len(row) * car[int(across[row[0]])]
            length_m, middle = max(last - first, needs) + 0.01, (first + last) / 2
            is_beside = (part.sigma >= first) & (part.sigma <= last)
            kerb = (street.left_m if sign > 0 else street.right_m)[is_beside].max()
            gap_m = max(float((sign * d - deep)[row].mean() - kerb), 0.0)
            start_m, length_m, gap_m = (round(float(size), 2) for size in (middle - length_m / 2, length_m, gap_m))
            bays.append(Bay(side, start_m, length_m, gap_m, bool(across[row[0]]), len(row)))
    return sorted(bays, key=lambda bay: bay.start_m)


def deviations(road: Road, part: Part) -> tuple[float, float]:
    """Largest distance of the road's line, and of its kerbs, from the map's, m, where both lie on each other best."""
    street, inside = part.street, torch.from_numpy(part.sigma[2:-2])
    ways = torch.ones_like(inside, dtype=torch.float32)
    x, y, _ = road.line(ways).pose(inside.float())
    line = torch.stack([x, y], -1).double().numpy()
    right, left = road.kerb_lines(inside.float(), torch.tensor(1.0)).double().numpy()
    onto = street.points[2:-2]
    u, _, v = np.linalg.svd((line - line.mean(0)).T @ (onto - onto.mean(0)))
    turn = u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v

    def placed(points: Array) -> tuple[Array, Array]:
        along, d = to_line(street, (points - line.mean(0)) @ turn + onto.mean(0))
        is_beside = (along >= 0) & (along <= street.length_m)
        return along[is_beside], d[is_beside]

    kerbs = [
        np.abs(d - sign * np.interp(along, street.sigma, kerb)).max()
        for points, sign, kerb in ((left, 1, street.left_m), (right, -1, street.right_m))
        for along, d in [placed(points)]
    ]
    return float(np.abs(placed(line)[1]).max()), float(max(kerbs))


def fitted(scenario: ScenarioConfig, part: Part, n_bends: int) -> RoadConfig:
    """The road of a scenario of a map in sizes; a lane's middle is a quarter of the mean width from the line."""
    corridor, (width_m, changes) = fit_corridor(part), fit_width(part)
    car = (corridor["parked_car_length_m"], corridor["parked_car_width_m"])
    lists: dict[str, Sequence[Any]] = {
        "bends": fit_bends(part, n_bends),
        "width_changes": changes,
        "bays": fit_bays(part, car),
    }
    items: dict[str, Any] = {name: tuple(ITEMS[name](**vars(each)) for each in items) for name, items in lists.items()}
    lane_m = round(float((part.street.left_m + part.street.right_m).mean()) / 4, 2)
    return replace(scenario.road, **items, **corridor, width_m=width_m, lane_offset_m=lane_m)


def yaml_of(road: RoadConfig, usual: RoadConfig) -> str:
    """The sizes that differ from the usual road's."""
    lines = ["road:"]
    for field in fields(road):
        value = getattr(road, field.name)
        if value != getattr(usual, field.name) and field.name in ITEMS:
            rows = [", ".join(f"{key}: {size}" for key, size in vars(each).items() if key[0] != "_") for each in value]
            lines += [f"  {field.name}:", *(f"    - {{{row}}}" for row in rows)]
        elif value != getattr(usual, field.name):
            lines.append(f"  {field.name}: {value}")
    return "\n".join(lines).replace("True", "true").replace("False", "false")


def main(n_bends: int, overrides: Sequence[str]) -> None:
    scenario = load_config("+experiment=yield", "device=cpu", *overrides).scenario
    part, usual = part_of(scenario), load_config("+experiment=yield", "device=cpu").scenario
    road = fitted(scenario, part, n_bends)
    line_m, kerb_m = deviations(build_road(replace(scenario, map=None, road=road)), part)
    print(yaml_of(road, usual.road))
    print(f"# {part.street.length_m:.1f} m; largest deviation of the line {line_m:.2f} m, of the kerbs {kerb_m:.2f} m")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--bends", type=int, choices=range(2, 21), default=6, metavar="N", help="number of bends, 2 to 20"
    )
    parser.add_argument("overrides", nargs="+", help="of the config: the scenario of a map")
    args = parser.parse_args()
    torch.set_num_threads(1)
    main(args.bends, args.overrides)
