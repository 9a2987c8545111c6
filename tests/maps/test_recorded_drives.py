"""Drives written as CommonRoad scenarios: read again equal, and accepted by commonroad-io where it is at hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commonroad_io import read_by_commonroad_io
from drawn_maps import PARKING, commonroad_map, written
from map_measures import assert_is_sound

from negopipe.errors import UserError
from negopipe.maps import (
    KerbsideRow,
    MapStreet,
    Side,
    Trajectory,
    read_commonroad,
    read_trajectories,
    write_commonroad,
)
from negopipe.maps.boxes import corners_of_parked
from negopipe.maps.street import to_plane

NAME = "ZAM_Drawn-1_1_T-1"


@pytest.fixture
def street(tmp_path: Path) -> MapStreet:
    rows = (KerbsideRow(Side.LEFT, 20.0, 50.0, 0.2), KerbsideRow(Side.RIGHT, 60.0, 90.0, 0.2))
    return read_commonroad(written(commonroad_map(), tmp_path / "drawn.xml"), ids=(), parking=PARKING, rows=rows)


def drives(street: MapStreet) -> list[Trajectory]:
    """Three vehicles: one ahead, one against it, later, one that reverses."""
    found = []
    for kind, first, sigma, d in (
        ("car", 0, np.linspace(5, 80, 41), -1.0),
        ("bus", 7, np.linspace(100, 20, 33), 1.2),
        ("bicycle", 3, np.linspace(60, 55, 11), -0.3),
    ):
        position, heading = to_plane(street, sigma, np.full_like(sigma, d))
        heading = heading + (np.pi if kind == "bus" else 0.0)
        speed = np.gradient(sigma, 0.2) * (-1 if kind == "bus" else 1)
        found.append(Trajectory(kind, 4.5, 1.8, first, position, heading, speed))
    return found


def write(path: Path, street: MapStreet, trajectories: list[Trajectory], name: str = NAME) -> Path:
    write_commonroad(path, street, trajectories, dt_s=0.2, benchmark_id=name, author="negopipe")
    return path


def test_trajectories_are_read_again_as_they_were(tmp_path: Path, street: MapStreet) -> None:
    before = drives(street)
    dt_s, after = read_trajectories(write(tmp_path / "drive.xml", street, before))
    assert dt_s == 0.2
    assert len(after) == 3
    for one, other in zip(before, after, strict=True):
        same = (one.kind, one.length_m, one.width_m, one.first_step)
        assert same == (other.kind, other.length_m, other.width_m, other.first_step)
        assert np.abs(one.position - other.position).max() < 1e-5
        assert np.abs(one.speed - other.speed).max() < 1e-5
        turn = one.heading - other.heading
        assert np.abs(np.arctan2(np.sin(turn), np.cos(turn))).max() < 1e-5


def test_the_street_is_read_again_within_a_centimetre(tmp_path: Path, street: MapStreet) -> None:
    again = read_commonroad(write(tmp_path / "drive.xml", street, drives(street)), ids=(1,), parking=PARKING, rows=())
    assert_is_sound(again)
    assert abs(again.length_m - street.length_m) <= 0.5
    count = min(len(again.points), len(street.points))
    assert np.abs(again.left_m[:count] - street.left_m[:count]).max() < 0.01
    assert np.abs(again.points[:count] - street.points[:count]).max() < 0.01
    assert len(again.parked) == len(street.parked)
    assert np.abs(corners_of_parked(again) - corners_of_parked(street)).max() < 0.01


def test_a_name_that_commonroad_does_not_know(tmp_path: Path, street: MapStreet) -> None:
    with pytest.raises(UserError, match="benchmark_id is 'my drive'; a name like ZAM_Street-1_1_T-1 is allowed"):
        write(tmp_path / "drive.xml", street, [], name="my drive")


def test_a_kind_of_vehicle_that_commonroad_does_not_know(tmp_path: Path, street: MapStreet) -> None:
    with pytest.raises(UserError, match="kind of a vehicle is 'tank'; car, truck, bus,"):
        write(tmp_path / "drive.xml", street, [replace(drives(street)[0], kind="tank")])


@pytest.mark.parametrize("length", [1, 5])
def test_a_trajectory_of_one_time_or_of_unequal_lengths(tmp_path: Path, street: MapStreet, length: int) -> None:
    drive = drives(street)[0]
    with pytest.raises(ValueError, match="two and more equal times"):
        write(tmp_path / "drive.xml", street, [replace(drive, position=drive.position[:length], speed=drive.speed[:1])])


@pytest.mark.parametrize(
    ("before", "after", "line"),
    [
        ("<exact>3</exact>", "<exact>4</exact>", "the times of vehicle"),
        ("<exact>3</exact>", "<exact>3.5</exact>", "the time of vehicle"),
        ("<length>4.500000</length>", "<length>?</length>", "the length of vehicle"),
        ('timeStepSize="0.200000"', 'timeStepSize=""', "timeStepSize is missing; a finite number is allowed"),
    ],
)
def test_a_recording_that_is_broken(tmp_path: Path, street: MapStreet, before: str, after: str, line: str) -> None:
    path = write(tmp_path / "drive.xml", street, drives(street)[:1])
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(UserError, match=line) as caught:
        read_trajectories(path)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_commonroad_io_accepts_the_recording(tmp_path: Path, street: MapStreet) -> None:
    before = [replace(drive, first_step=0) for drive in drives(street)]
    path = write(tmp_path / "drive.xml", street, before)
    seen = read_by_commonroad_io(path)
    assert seen["schema_errors"] == []
    assert np.abs(np.array(seen["ego"]) - before[0].position[[0, -1]]).max() < 0.01
    assert (seen["name"], seen["dt_s"], seen["lanelets"]) == (NAME, 0.2, [1, 2])
    assert seen["opposing"] == [True, True]
    assert len(seen["static"]) == len(street.parked)
    middles = corners_of_parked(street).mean(1)
    assert np.abs(np.array(seen["static"]) - middles).max() < 0.01
    for one, other in zip(before, seen["dynamic"], strict=True):
        assert other["kind"] == one.kind
        assert other["steps"] == list(range(one.first_step, one.first_step + len(one.position)))
        assert np.abs(np.array(other["position"]) - one.position).max() < 0.01
        assert np.abs(np.array(other["speed"]) - one.speed).max() < 0.01
