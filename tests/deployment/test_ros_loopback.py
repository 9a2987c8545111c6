"""Closed loops through messages of ROS 2: in one process, and with the node in a process of its own over DDS."""

import time
from pathlib import Path

import numpy as np
import pytest
import ros_packages  # noqa: F401
from ros_drives import (
    BEGIN_NS,
    STEP_NS,
    VEHICLE,
    Drive,
    Losses,
    NodeProcess,
    drive,
    in_process,
    on_own_street,
    sensed,
)
from runtime_drives import GENERALIST, drive_in_simulator, negotiator, places

from negopipe.deployment.middleware import again
from negopipe.deployment.middleware.codec import decode
from negopipe.deployment.middleware.incoming import NS, stamp_ns
from negopipe.deployment.middleware.interface import DEBUG, TRAJECTORY
from negopipe.deployment.middleware.planning_node import PlanningNode
from negopipe.simulation.state import EGO

N_STEPS = 72
SILENCE_S = 5.0


def drive_here(n_steps: int, seed: int, losses: Losses | None = None) -> Drive:
    return drive(in_process(PlanningNode(on_own_street(), VEHICLE, 0.2)), n_steps, seed=seed, losses=losses)


def said_words(done: Drive) -> set[str]:
    """Keys of the debug topic that had a value other than none at some time."""
    return {key for each in done.debug for key, value in each.items() if value not in ("", "0", "false", "none")}


def test_messages_drive_as_the_simulator_does() -> None:
    done, expected = drive_here(15, seed=0), drive_in_simulator(15, seed=0)
    assert len(done.worlds) == len(expected) == 16
    np.testing.assert_allclose(places(done.worlds), places(expected), atol=1e-3)
    assert {each["start"] for each in done.debug[1:]} == {"plan"}


@pytest.mark.slow
def test_a_node_over_dds_drives_as_in_process_and_as_the_simulator(tmp_path: Path) -> None:
    seed = 1
    with NodeProcess(record=tmp_path / "drive.mcap") as node:
        done = drive(node.exchange, N_STEPS, seed=seed)
    assert node.exitcode == 0
    here, expected = drive_here(N_STEPS, seed), drive_in_simulator(N_STEPS, seed=seed)
    assert done.trajectories == here.trajectories
    assert len(done.trajectories) > 50
    np.testing.assert_array_equal(places(done.worlds), places(here.worlds))
    np.testing.assert_allclose(places(done.worlds), places(expected), atol=1e-3)
    replayed = again.replay(tmp_path / "drive.mcap", on_own_street())
    assert replayed.n_equal == replayed.n_decisions == len(done.trajectories)


@pytest.mark.slow
def test_lost_late_and_reordered_messages_over_dds(tmp_path: Path) -> None:
    """Every odometry that comes in its turn gets its trajectory, and both vehicles arrive."""
    seed = 2
    with NodeProcess(record=tmp_path / "drive.mcap") as node:
        done = drive(node.exchange, N_STEPS, seed=seed, losses=Losses(seed))
    here = drive_here(N_STEPS, seed, Losses(seed))
    assert done.trajectories == here.trajectories
    np.testing.assert_array_equal(places(done.worlds), places(here.worlds))
    assert len(done.trajectories) == sum(bool(each) for each in done.said) < len(done.said)
    assert said_words(done) >= {"objects_late", "objects_duplicate", "left_out_old", "objects_age_s", "carried_on"}
    assert done.worlds[-1].has_reached.all()
    replayed = again.replay(tmp_path / "drive.mcap", on_own_street())
    assert replayed.n_equal == replayed.n_decisions == len(done.trajectories)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_a_policy_of_many_streets_drives_between_kerbs(seed: int) -> None:
    node = PlanningNode(negotiator(*GENERALIST), VEHICLE, 0.2)
    done = drive(in_process(node), N_STEPS, *GENERALIST, seed=seed)
    assert {each["street"] for each in done.debug} == {"known"}
    assert done.worlds[-1].has_reached[0, EGO]
    assert not done.worlds[-1].has_collided.any()


@pytest.mark.slow
def test_a_node_whose_odometry_falls_silent_stops_and_drives_on_behind_it() -> None:
    with NodeProcess(silence_s=SILENCE_S) as node:
        before = drive(node.exchange, 10, seed=1)
        time.sleep(SILENCE_S + 2.0)
        taken = [(topic, decode(data, topic.type_name)) for topic, data in node.bus.take()]
        stops = [message for topic, message in taken if topic is TRAJECTORY]
        texts = {message.status[0].message for topic, message in taken if topic is DEBUG}
        assert node.bus.is_matched(TRAJECTORY)
        later = node.exchange(sensed(before.worlds[-1], BEGIN_NS + 60 * NS), BEGIN_NS + 60 * NS)
    assert texts == {"stop: ego_state"}
    assert stops[-1].points[-1].longitudinal_velocity_mps == 0.0
    assert stamp_ns(stops[-1]) >= BEGIN_NS + 9 * STEP_NS + round(SILENCE_S * NS)
    assert later[TRAJECTORY].points[-1].longitudinal_velocity_mps > 0.0
