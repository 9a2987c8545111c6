"""An evaluated drive as a CommonRoad scenario: the same places, the same street, on every kind of street."""

from pathlib import Path

import numpy as np
import pytest
import torch
from composed import compose_config
from drawn_maps import PARKING
from games import draw_tasks

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.recorded_drive import BEYOND_M, commonroad_scenario, street_around, trajectories
from negopipe.game.game import build_game
from negopipe.maps import read_commonroad, read_trajectories
from negopipe.maps.street import to_line
from negopipe.simulation.geometry import Boxes

STREETS = {
    "narrow_lane": (), "bent_street": ("scenario/kind=[bus,cyclist]",), "one_sided": ("scenario.n_social=2",),
    "random_streets": ("scenario.streets.n_training=2", "scenario.streets.n_held_out=2"),
}  # fmt: skip


@pytest.mark.parametrize("name", STREETS)
def test_a_drive_is_read_again_as_it_was(name: str, tmp_path: Path) -> None:
    config = compose_config([f"scenario={name}", *STREETS[name], "scenario.episode_steps=30"])
    game, reward = build_game(config), config.evaluation.reward
    road, tasks = game.simulator.road, draw_tasks(config, 2)
    trace = drive_episodes(game, by_horizon(game, fixed_horizon(4.0)), tasks, 2, reward, ("fixed_4", "mixture"))
    for episode in range(2):
        path = tmp_path / f"{episode}.xml"
        path.write_bytes(commonroad_scenario(config.scenario, road, trace, episode))
        dt_s, read = read_trajectories(path)
        assert dt_s == config.scenario.dt_s
        assert len(read) == config.scenario.n_vehicles
        for vehicle, (one, other) in enumerate(zip(trajectories(trace, episode), read, strict=True)):
            assert len(other.position) == trace.n_steps[episode] + 1
            assert np.abs(one.position - other.position).max() < 1e-5
            assert np.abs(other.position[0] - trace.position_m[0, episode, vehicle]).max() < 1e-5
            assert np.abs(one.speed - other.speed).max() < 1e-5
            assert (other.length_m, other.width_m) == pytest.approx((one.length_m, one.width_m), abs=1e-5)
        street = street_around(road, int(trace.street[episode]), trace.position_m[:, episode].reshape(-1, 2))
        again = read_commonroad(path, ids=(1,), parking=PARKING, rows=())
        assert len(again.parked) == len(street.parked)
        assert again.length_m == pytest.approx(street.length_m, abs=1.0)


def test_the_stretch_has_the_streets_kerbs_and_parked_cars() -> None:
    config = compose_config(["scenario=bent_street"])
    game = build_game(config)
    road, world = game.simulator.road, game.simulator.reset(draw_tasks(config, 1))
    places = world.vehicles.position[0].numpy()
    street = street_around(road, 1, places)
    sigma, _ = to_line(street, places)
    assert sigma.min() == pytest.approx(BEYOND_M, abs=0.01)
    assert street.length_m - sigma.max() == pytest.approx(BEYOND_M, abs=1.0)
    half_m = config.scenario.road.street.width_m / 2
    assert street.left_m == pytest.approx(half_m)
    assert street.right_m == pytest.approx(half_m)
    parked: Boxes = road.parked_boxes(torch.ones(()))
    assert len(street.parked) == len(parked.x)
    x, y = parked.x.numpy(), parked.y.numpy()
    found = np.stack(to_line(street, np.stack([x, y], -1).astype(np.float64)), -1)
    for there, at in ((street.parked[:, :2], found), (found, street.parked[:, :2])):
        assert all(np.abs(at - place).max(1).min() < 0.01 for place in there)
    assert street.parked[:, 3] == pytest.approx(2 * np.asarray(parked.half_length).max(), abs=1e-5)
