"""Streets measured from maps: passable, driven through by `cautious`, as far from the map as they say."""

import math
import re
from functools import partial

import numpy as np
import pytest
import torch
from composed import compose_config
from drawn_maps import published
from scripts import load_script

from negopipe import CONF
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.trace import OUTCOMES
from negopipe.game.game import Game, build_game
from negopipe.maps import MapStreet
from negopipe.maps.line import integrate
from negopipe.simulation.build_road import build_road, draw_streets
from negopipe.simulation.drawn_street import drawn_street
from negopipe.simulation.drivable import is_drivable
from negopipe.simulation.knot_tables import BEYOND_M
from negopipe.simulation.reference_line import Bend, Course
from negopipe.simulation.road_width import WidthChange, width_at
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.streets import Streets

MAPS = {
    "karlsruhe": ["scenario=lanelet2", "karlsruhe/mapping_example.osm"],
    "starnberg": ["scenario=commonroad", "starnberg/DEU_Starnberg-1_1_T-1.xml"],
    "zam_over": ["scenario=commonroad", "over/ZAM_Over-1_1.xml", "scenario.map.rows=[]"],
}


@pytest.fixture(params=MAPS)
def name(request: pytest.FixtureRequest) -> str:
    found: str = request.param
    return found


def on_street(name: str) -> tuple[RunConfig, Game]:
    config = compose_config([f"scenario={name}", "evaluation/baseline=[cautious]", "report.side_by_side=[]"])
    return config, build_game(config)


def test_a_default_car_can_drive_on_both_routes(name: str) -> None:
    scenario = compose_config([f"scenario={name}"]).scenario
    (street,), rules = draw_streets(scenario), scenario.streets
    road = Streets([drawn_street(street, street.reach_m + BEYOND_M)])
    assert is_drivable(road, scenario.vehicle, rules.clearance_m, rules.curvature_max_1pm).tolist() == [True]


@pytest.mark.slow
def test_cautious_drives_through(name: str) -> None:
    config, game = on_street(name)
    cautious = config.evaluation.baselines["cautious"]
    families = {"yield": config.scenario.families["yield"]}
    task = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(3)
    paid, names = config.evaluation.reward, ("cautious", "yield")
    trace = drive_episodes(game, partial(cautious.driver, game), task, 3, paid, names, cautious.is_lockstep)
    assert [OUTCOMES[outcome] for outcome in trace.outcome] == ["success"] * 3


def test_the_street_lies_where_its_map_lies(name: str) -> None:
    scenario, file, *overrides = MAPS[name]
    path, job = published(file), load_script("fit_street")
    said = re.sub(r"\n# ", " ", (CONF / "scenario" / f"{name}.yaml").read_text())
    stated = re.search(r"deviation from the map: line (\S+) m, kerbs (\S+) m", said)
    assert stated is not None
    part = job.part_of(compose_config([scenario, f"scenario.map.file={path}", *overrides]).scenario)
    found = job.deviations(build_road(compose_config([f"scenario={name}"]).scenario), part)
    assert [round(each, 2) for each in found] == pytest.approx([float(each) for each in stated.groups()], abs=0.011)


def test_the_bays_of_karlsruhe_are_the_maps_parking_areas() -> None:
    """Thirteen areas, of which the cars stand beside the road."""
    config = compose_config(["scenario=karlsruhe"])
    (street,) = draw_streets(config.scenario)
    assert len(street.bays) == 13
    road = build_road(config.scenario)
    assert len(road.parked_on_line[0]) == street.n_parked_per_side == 5
    assert road.parked_boxes().x.shape == (5 + sum(bay.n_parked for bay in street.bays),)


def test_a_drawn_street_is_fitted() -> None:
    job = load_script("fit_street")
    sigma = np.arange(-90, 90.5, 0.5)
    changes = [WidthChange(-60.0, 12.0, 6.0), WidthChange(30.0, 20.0, 7.5)]
    width_m = width_at(torch.from_numpy(sigma), 8.0, changes).numpy()
    bends = [Bend(-50.0, 80.0, 20.0)]
    curvature = Course(bends).curvature(torch.from_numpy(sigma))[0].numpy()
    line = integrate(np.array([3.0, -5.0, 0.4]), curvature)
    nobody = np.zeros((0, 5))
    half = width_m / 2
    street = MapStreet(line.points, line.heading, curvature, half, half, nobody, "drawn", "", "")
    part = job.Part(street, sigma, (-6.0, 6.0))
    first_m, found = job.fit_width(part)
    deviation = width_at(torch.from_numpy(sigma), first_m, found).numpy() - width_m
    assert np.abs(deviation).max() < job.WIDTH_M + 0.05  # and a step of the widths
    fitted, drawn = (Course(bends).heading(torch.from_numpy(sigma)) for bends in (job.fit_bends(part, 3), bends))
    assert float((fitted - fitted[0] - (drawn - drawn[0])).abs().max()) < math.radians(0.5)
