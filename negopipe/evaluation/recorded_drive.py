"""An evaluated drive as a CommonRoad scenario: the street, on the map where it is of one, and all vehicles' motion."""

import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import torch

from negopipe.evaluation.trace import Trace
from negopipe.maps.recording import Trajectory, write_commonroad
from negopipe.maps.street import STEP_M, MapStreet
from negopipe.simulation.map_config import lanelets_of, read_map
from negopipe.simulation.map_road import MapFrame, map_frame, map_rules
from negopipe.simulation.road import Road
from negopipe.simulation.scenario import ScenarioConfig

BEYOND_M = 20.0
"""Length of street before the first and behind the last place of a vehicle, m."""

BICYCLE_M, BUS_M = 1.0, 6.0
"""Width below which a vehicle is written as a bicycle, and length from which on as a bus, m."""


def commonroad_scenario(scenario: ScenarioConfig, road: Road, trace: Trace, episode: int) -> bytes:
    """The XML of an episode of a trace on the road of a scenario.

    On a map all is in the map's coordinates: its street with all parked vehicles, a CommonRoad map with all its
    lanelets. Elsewhere positions are those of the trace, and the street is its stretch around the drive.
    """
    drives, lanelets, number = trajectories(trace, episode), [], int(trace.street[episode])
    if scenario.map is None:
        street = street_around(road, number, trace.position_m[:, episode].reshape(-1, 2))
    else:
        street, lanelets = read_map(scenario.map), lanelets_of(scenario.map)
        frame = map_frame(scenario.map, map_rules(scenario))
        drives = [on_map(drive, frame) for drive in drives]
    names = (re.sub("[^A-Za-z0-9]", "", each) for each in (trace.setting, trace.planner))
    benchmark_id = f"ZAM_{''.join(names)}-{number}_{episode + 1}_T-1"
    file = BytesIO()
    write_commonroad(file, street, drives, trace.dt_s, benchmark_id, "negopipe", lanelets)
    return file.getvalue()


def on_map(drive: Trajectory, frame: MapFrame) -> Trajectory:
    """A drive in the world as it is on the map."""
    return replace(drive, position=frame.on_map(drive.position), heading=drive.heading + frame.heading)


def trajectories(trace: Trace, episode: int) -> list[Trajectory]:
    """Motion of the vehicles of an episode until its end, the ego's first."""
    n_states = int(trace.n_steps[episode]) + 1
    sizes = zip(trace.length_m[episode].tolist(), trace.width_m[episode].tolist(), strict=True)
    return [
        Trajectory(
            kind="bicycle" if width < BICYCLE_M else "bus" if length >= BUS_M else "car",
            length_m=length,
            width_m=width,
            first_step=0,
            position=trace.position_m[:n_states, episode, vehicle].astype(np.float64),
            heading=trace.yaw_rad[:n_states, episode, vehicle].astype(np.float64),
            speed=trace.speed_mps[:n_states, episode, vehicle].astype(np.float64),
        )
        for vehicle, (length, width) in enumerate(sizes)
    ]


def street_around(road: Road, number: int, places: np.ndarray) -> MapStreet:
    """The stretch of a road's street from `BEYOND_M` before to `BEYOND_M` behind all `places` [N, 2] (m, world)."""
    direction = torch.tensor(float(number), device=road.device)
    line = road.line(direction)
    positions = torch.from_numpy(places).to(road.device)
    reached, _ = line.project(positions[:, 0], positions[:, 1])
    first_m, last_m = float(reached.min()) - BEYOND_M, float(reached.max()) + BEYOND_M
    sigma = torch.arange(first_m, last_m + STEP_M, STEP_M, device=road.device)
    x, y, heading = line.pose(sigma)
    right, left = road.kerbs_at(sigma, direction.expand_as(sigma))
    return MapStreet(
        points=_array(torch.stack([x, y], -1)),
        heading=np.unwrap(_array(heading.expand_as(sigma))),
        curvature=_array(line.curvature(sigma)[0].expand_as(sigma)),
        left_m=_array(left.expand_as(sigma)),
        right_m=_array(right.expand_as(sigma)),
        parked=_parked(road, direction, first_m, last_m),
        name=str(number),
        source="negopipe",
        licence="",
    )


def _parked(road: Road, direction: torch.Tensor, first_m: float, last_m: float) -> np.ndarray:
    """[P, 5]: the parked vehicles of the stretch, see `MapStreet.parked`."""
    line, boxes = road.line(direction), road.parked_boxes(direction)
    sigma, d = line.project(boxes.x, boxes.y)
    yaw = torch.atan2(boxes.sin, boxes.cos) - line.heading(sigma)
    size = (2 * torch.as_tensor(half).expand_as(sigma) for half in (boxes.half_length, boxes.half_width))
    rows = _array(torch.stack([sigma - first_m, d, torch.atan2(yaw.sin(), yaw.cos()), *size], -1))
    is_there = (rows[:, 3] > 0) & (rows[:, 0] >= 0) & (rows[:, 0] <= last_m - first_m)
    rows = rows[is_there]
    return rows[rows[:, 0].argsort()]


def _array(values: torch.Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
