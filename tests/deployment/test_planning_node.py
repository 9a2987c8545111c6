"""The node without a transport: when it decides, and what it does about messages that are missing, old or wrong."""

import math
from functools import cache

import numpy as np
import pytest
import ros_packages  # noqa: F401
from games import tiny_config
from ros_drives import BEGIN_NS, FRAME, STEP_NS, VEHICLE, acceleration, objects, odometry, street_messages
from runtime_drives import HEADING, ORIGIN, straight_on

from negopipe.config.root import as_mapping
from negopipe.deployment import EgoState, Negotiator, ObjectState
from negopipe.deployment.middleware.codec import Message
from negopipe.deployment.middleware.incoming import NS
from negopipe.deployment.middleware.interface import (
    ACCELERATION,
    DEBUG,
    OBJECTS,
    ODOMETRY,
    PARKED,
    SCENE,
    STREET,
    TRAJECTORY,
    Topic,
)
from negopipe.deployment.middleware.outgoing import ERROR
from negopipe.deployment.middleware.planning_node import PlanningNode
from negopipe.deployment.settings import Settings

CARS = np.array([[at, y, 3.6, 1.9] for at in (-4.2, 0.0, 4.2) for y in (2.55, -2.55)])


@cache
def settings() -> Settings:
    return Settings.of(as_mapping(tiny_config("yield")))


class Scene:
    """A node whose runtime plans straight on, and an ego at 5 m/s on a street of 7 m."""

    def __init__(self, has_street: bool = True) -> None:
        self.node = PlanningNode(Negotiator(settings(), straight_on, lambda tables: {}), VEHICLE, 0.2)
        if has_street:
            for topic, message in street_messages(CARS, 6.0):
                self.node.take(topic, message)

    def ego(self, stamp: int, speed: float = 5.0) -> EgoState:
        x = -30.0 + 5.0 * (stamp - BEGIN_NS) / NS
        return EgoState(0.0, *FRAME.to_host(np.array([x, -1.75, 0.0, speed, 0.0, 0.0])), 6.0)

    def send(self, stamp: int, speed: float = 5.0, without: tuple[Topic, ...] = (), frame: str = "map") -> None:
        """Objects, acceleration and odometry of a time."""
        ego, car = self.ego(stamp, speed), ObjectState(0, 0.0, *ORIGIN, HEADING, 0.0, 4.5, 1.8)
        sent = {
            OBJECTS: objects([car], stamp),
            ACCELERATION: acceleration(0.0, stamp),
            ODOMETRY: odometry(ego, stamp),
        }
        for topic, message in sent.items():
            if topic is not ACCELERATION:
                message.header.frame_id = frame
            if topic not in without:
                self.node.take(topic, message)

    def decide(self) -> dict[Topic, Message]:
        stamp = self.node.due()
        assert stamp is not None
        return dict(self.node.decide(stamp))


def values(said: dict[Topic, Message]) -> dict[str, str]:
    return {pair.key: pair.value for pair in said[DEBUG].status[0].values}


def test_a_decision_is_due_once_per_period_of_the_stamps() -> None:
    scene, decided = Scene(), []
    for tick in range(51):  # 50 Hz
        scene.send(BEGIN_NS + tick * NS // 50)
        if scene.node.due() is not None:
            said = scene.decide()
            decided.append(tick)
            assert said[TRAJECTORY].header.stamp.nanosec == tick * NS // 50 % NS
    assert decided == [0, 10, 20, 30, 40, 50]


def test_a_decision_says_trajectory_debug_and_scene() -> None:
    scene = Scene()
    scene.send(BEGIN_NS)
    said = scene.decide()
    assert list(said) == [TRAJECTORY, DEBUG, SCENE]
    first, ego = said[TRAJECTORY].points[0].pose.position, odometry(scene.ego(BEGIN_NS), BEGIN_NS).pose.pose.position
    assert (first.x, first.y, first.z) == pytest.approx((ego.x, ego.y, ego.z))
    assert values(said)["objects_new"] == "1"
    assert values(said)["probability_4s"] == "0.6"
    assert values(said)["objects_age_s"] == "0"
    names = [marker.ns for marker in said[SCENE].markers]
    assert {name: names.count(name) for name in names} == {
        "": 1, "kerbs": 2, "parked": 6, "objects": 1, "ego": 1, "plan": 1, "horizon": 1
    }  # fmt: skip


def test_what_is_missing_is_said_and_no_trajectory_comes() -> None:
    scene = Scene(has_street=False)
    assert scene.node.due() is None
    scene.send(BEGIN_NS)
    said = scene.decide()
    assert list(said) == [DEBUG]
    assert said[DEBUG].status[0].level == ERROR
    assert "street must be known" in said[DEBUG].status[0].message
    scene = Scene()
    scene.send(BEGIN_NS, without=(ACCELERATION,))
    assert "acceleration must be known" in scene.decide()[DEBUG].status[0].message


def test_an_odometry_that_comes_behind_a_newer_one_is_left_out() -> None:
    scene = Scene()
    scene.send(BEGIN_NS + 2 * STEP_NS)
    scene.decide()
    scene.node.take(ODOMETRY, odometry(scene.ego(BEGIN_NS + STEP_NS), BEGIN_NS + STEP_NS))
    assert scene.node.due() is None
    scene.send(BEGIN_NS + 3 * STEP_NS)
    assert values(scene.decide())["left_out_old"] == "1"


def test_messages_of_another_frame_are_left_out() -> None:
    scene = Scene()
    scene.send(BEGIN_NS)
    scene.decide()
    scene.send(BEGIN_NS + STEP_NS, frame="odom")
    assert scene.node.due() is None
    scene.send(BEGIN_NS + 2 * STEP_NS)
    assert values(scene.decide())["left_out_frame"] == "2"


def test_old_objects_are_no_word_of_the_objects() -> None:
    """A perception that hangs, and repeats what it saw, ends in a stop."""
    scene, stops = Scene(), []
    for step in range(8):
        stamp = BEGIN_NS + step * STEP_NS
        scene.send(stamp, without=(OBJECTS,))
        scene.node.take(OBJECTS, objects([], BEGIN_NS))
        stops.append(values(scene.decide())["stop"])
    assert stops == ["", "", "", "", "", "", "", "objects"]


def test_an_acceleration_that_is_lost_for_long_is_a_stop() -> None:
    scene, stops = Scene(), []
    for step in range(6):
        scene.send(BEGIN_NS + step * STEP_NS, without=(ACCELERATION,) if step else ())
        stops.append(values(scene.decide())["stop"])
    assert stops == ["", "", "", "", "ego_state", "ego_state"]


def test_an_odometry_of_nan_is_a_stop_of_finite_numbers() -> None:
    scene = Scene()
    scene.send(BEGIN_NS)
    scene.decide()
    scene.send(BEGIN_NS + STEP_NS, without=(ODOMETRY,))
    broken = odometry(scene.ego(BEGIN_NS + STEP_NS), BEGIN_NS + STEP_NS)
    broken.pose.pose.position.x = broken.pose.pose.position.z = broken.twist.twist.linear.x = math.nan
    scene.node.take(ODOMETRY, broken)
    said = scene.decide()
    assert values(said)["stop"] == "ego_state"
    places = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in said[TRAJECTORY].points]
    assert np.isfinite(places).all()


def test_a_street_that_cannot_be_leaves_the_one_before() -> None:
    scene = Scene()
    scene.send(BEGIN_NS)
    scene.decide()
    for topic, message in street_messages(CARS, 6.0):
        if topic is STREET:
            message.left_bound = message.left_bound[:1]
        scene.node.take(topic, message)
    scene.send(BEGIN_NS + STEP_NS)
    said = scene.decide()
    assert "left must be a kerb of at least 2" in values(said)["street"]
    assert values(said)["stop"] == ""
    assert TRAJECTORY in said


def test_a_street_without_parked_cars_between_wide_kerbs_is_refused() -> None:
    scene = Scene(has_street=False)
    (topic, street), _ = street_messages(CARS, 6.0)
    scene.node.take(topic, street)
    scene.send(BEGIN_NS)
    assert "has no narrow place" in scene.decide()[DEBUG].status[0].message
    scene.node.take(PARKED, street_messages(CARS, 6.0)[1][1])
    scene.send(BEGIN_NS + STEP_NS)
    assert TRAJECTORY in scene.decide()


def test_a_clock_that_begins_anew_is_one_stop() -> None:
    scene = Scene()
    for step in range(3):
        scene.send(BEGIN_NS + 100 * NS + step * STEP_NS)
        if step == 0:
            scene.node.take(ODOMETRY, odometry(scene.ego(BEGIN_NS), BEGIN_NS + 100 * NS))
        scene.decide()
    stops = []
    for step in range(3):
        scene.send(BEGIN_NS + step * STEP_NS)
        stops.append(values(scene.decide())["stop"])
    assert stops == ["clock", "", ""]


def test_a_decision_behind_the_last_odometry_is_a_stop() -> None:
    """What `serve` asks for where the odometry has fallen silent; it may come back at once, or as if time had stood."""
    scene = Scene()
    scene.send(BEGIN_NS)
    scene.decide()
    said = dict(scene.node.decide(BEGIN_NS + 5 * NS))
    assert values(said)["stop"] == "ego_state"
    assert values(said)["odometry_age_s"] == "5"
    assert said[TRAJECTORY].points[-1].longitudinal_velocity_mps == 0.0
    assert scene.node.due() is None
    scene.send(BEGIN_NS + 5 * NS - STEP_NS)
    assert scene.node.due() is None
    scene.send(BEGIN_NS + 5 * NS + STEP_NS)
    assert values(scene.decide())["stop"] == ""
    dict(scene.node.decide(BEGIN_NS + 20 * NS))
    scene.send(BEGIN_NS + 6 * NS)
    assert values(scene.decide())["stop"] == "clock"
