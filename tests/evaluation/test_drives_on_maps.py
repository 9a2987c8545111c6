"""A drive on a map's street as a CommonRoad scenario: in the map's coordinates, on the map's street and lanelets."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from commonroad_io import read_by_commonroad_io
from composed import compose_config
from drawn_maps import PARKING, bidirectional_map, commonroad_map, published, two_way_map, written

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.recorded_drive import commonroad_scenario
from negopipe.evaluation.trace import Trace
from negopipe.game.game import Game, build_game
from negopipe.maps import MapStreet, read_commonroad, read_trajectories
from negopipe.maps.boxes import corners_of_parked
from negopipe.maps.street import to_line
from negopipe.simulation.map_config import MapConfig, read_map
from negopipe.simulation.scenario import TaskSampler

ROW = "scenario.map.rows=[{side:left,from_m:90.0,to_m:110.0,kerb_gap_m:0.2}]"
MAPS = {
    "osm": ("lanelet2", "drawn.osm", ROW),
    "pairs": ("commonroad", "pairs.xml", ROW),
    "both_ways": ("commonroad", "both_ways.xml", ROW),
    "karlsruhe": ("lanelet2", "karlsruhe/mapping_example.osm"),
    "starnberg": ("commonroad", "starnberg/DEU_Starnberg-1_1_T-1.xml"),
    "over": ("commonroad", "over/ZAM_Over-1_1.xml", "scenario.map.rows=[]"),
}
ENDS = 30
"""Points at a street's end that are not compared: Karlsruhe's last kerbs lie askew, and the line is fitted anew."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the maps that are drawn here, each of a bent street of 200 m."""
    folder = tmp_path_factory.mktemp("maps")
    two_way_map(200.0)[0].write(folder / "drawn.osm")
    written(commonroad_map(200.0), folder / "pairs.xml")
    written(bidirectional_map(200.0), folder / "both_ways.xml")
    return folder


@pytest.fixture(scope="module", params=MAPS)
def driven(request: pytest.FixtureRequest, drawn: Path) -> tuple[RunConfig, Game, Trace, Path]:
    """Config, game, a short drive of the mixture and its file."""
    scenario, name, *overrides = MAPS[request.param]
    path = published(name) if "/" in name else drawn / name
    config = compose_config(
        [f"scenario={scenario}", f"scenario.map.file={path}", *overrides, "scenario.episode_steps=40"]
    )
    game, names = build_game(config), ("fixed_4", "mixture")
    families = {"mixture": config.scenario.families["mixture"]}
    tasks = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(1)
    driver = by_horizon(game, fixed_horizon(4.0))
    trace = drive_episodes(game, driver, tasks, 1, config.evaluation.reward, names)
    file = drawn / f"{request.param}_drive.xml"
    file.write_bytes(commonroad_scenario(config.scenario, game.simulator.road, trace, 0))
    return config, game, trace, file


def map_of(config: RunConfig) -> MapConfig:
    assert config.scenario.map is not None
    return config.scenario.map


def street_again(config: RunConfig, file: Path) -> MapStreet:
    """The street of a written drive: a CommonRoad map's own lanelets, or else the street's lanelet 1."""
    chosen = map_of(config)
    return read_commonroad(file, chosen.ids if chosen.format == "commonroad" else (1,), PARKING, ())


def test_the_drive_lies_where_it_was_driven(driven: tuple[RunConfig, Game, Trace, Path]) -> None:
    """On the map's line as far along and beside as on the road's; headings likewise."""
    config, game, trace, file = driven
    street, line = read_map(map_of(config)), game.simulator.road.line(torch.ones(()))
    _, read = read_trajectories(file)
    n_states, ahead = int(trace.n_steps[0]) + 1, []
    assert len(read) == config.scenario.n_vehicles
    for vehicle, drive in enumerate(read):
        place = torch.from_numpy(trace.position_m[:n_states, 0, vehicle])
        sigma, d = line.project(place[:, 0], place[:, 1])
        along, beside = to_line(street, drive.position)
        assert np.abs(beside - d.numpy()).max() < 0.01
        ahead.append(along - sigma.double().numpy())
        turned = drive.heading - trace.yaw_rad[:n_states, 0, vehicle]
        expected = np.interp(along, street.sigma, street.heading) - line.heading(sigma).numpy()
        assert np.abs(np.sin(turned - expected)).max() < 0.01
        assert drive.speed == pytest.approx(trace.speed_mps[:n_states, 0, vehicle], abs=1e-5)
    assert np.ptp(np.concatenate(ahead)) < 0.01  # sigma = 0 is somewhere on the map, the same place for all


def test_the_street_is_read_again_within_a_centimetre(driven: tuple[RunConfig, Game, Trace, Path]) -> None:
    config, _, _, file = driven
    street, again = read_map(map_of(config)), street_again(config, file)
    assert abs(again.length_m - street.length_m) <= 2.0
    n = len(street.points) - ENDS
    assert np.abs(again.points[:n] - street.points[:n]).max() < 0.01
    assert np.abs(again.left_m[:n] - street.left_m[:n]).max() < 0.01
    assert np.abs(again.right_m[:n] - street.right_m[:n]).max() < 0.01
    assert len(again.parked) == len(street.parked) > 0
    assert np.abs(corners_of_parked(again) - corners_of_parked(street)).max() < 0.01


def test_a_commonroad_map_keeps_its_lanelets(driven: tuple[RunConfig, Game, Trace, Path]) -> None:
    config, _, _, file = driven
    drive, before = ElementTree.parse(file).getroot(), map_of(config)
    written_ids = [lanelet.get("id") for lanelet in drive.findall("lanelet")]
    ids = [element.get("id") for element in drive if element.get("id")]
    assert len(ids) == len(set(ids))
    if before.format == "lanelet2":
        assert written_ids == ["1", "2"]
    else:
        assert written_ids == [lane.get("id") for lane in ElementTree.parse(before.file).getroot().findall("lanelet")]


@pytest.mark.slow
def test_commonroad_io_accepts_the_drive(driven: tuple[RunConfig, Game, Trace, Path]) -> None:
    config, _, _, file = driven
    seen = read_by_commonroad_io(file)
    _, read = read_trajectories(file)
    assert seen["schema_errors"] == []
    assert len(seen["static"]) == len(read_map(map_of(config)).parked)
    for one, other in zip(read, seen["dynamic"], strict=True):
        assert np.abs(np.array(other["position"]) - one.position).max() < 0.01
