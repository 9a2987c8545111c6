"""Messages of ROS 2 and what the runtime takes and says: points of the vehicle, shapes, signs, the debug topic."""

import math
from collections import Counter

import numpy as np
import pytest
import ros_packages  # noqa: F401
from ros_drives import BEGIN_NS, VEHICLE, objects, odometry, predicted_object

from negopipe.deployment import Diagnostics, EgoState, ObjectState, Trajectory
from negopipe.deployment.middleware.codec import decode, encode, make
from negopipe.deployment.middleware.incoming import BOX, CYLINDER, NS, POLYGON, ego_state, object_states, yaw_of
from negopipe.deployment.middleware.interface import DEBUG
from negopipe.deployment.middleware.outgoing import (
    ERROR,
    OK,
    WARN,
    debug_message,
    diagnostic_values,
    pose,
    trajectory_message,
    verdict,
)

EGO = EgoState(0.4, 12.0, -3.0, 2.5, 4.0, 0.7, 0.05, 6.0)
CAR = ObjectState("01" * 16, 0.4, 5.0, 6.0, -2.0, 3.0, 4.4, 1.7)


@pytest.mark.parametrize("yaw", [-3.1, -0.5, 0.0, 1.0, 3.1])
def test_a_heading_comes_back_from_its_quaternion(yaw: float) -> None:
    assert yaw_of(pose(1.0, 2.0, 3.0, yaw).orientation) == pytest.approx(yaw)


@pytest.mark.parametrize("speed", [4.0, -1.0])
def test_the_ego_comes_back_from_its_rear_axle(speed: float) -> None:
    ego = EGO._replace(speed=speed)
    found = ego_state(odometry(ego, BEGIN_NS + 2 * NS // 5), ego.accel, ego.desired_speed, VEHICLE, BEGIN_NS)
    np.testing.assert_allclose(found, ego, atol=1e-12)


def test_the_yaw_rate_says_nothing_of_the_curvature_at_rest() -> None:
    message = odometry(EGO._replace(speed=0.0), BEGIN_NS)
    message.twist.twist.angular.z = 0.01
    assert ego_state(message, 0.0, 6.0, VEHICLE, BEGIN_NS).curvature == 0.0


def test_objects_come_back_with_their_ids() -> None:
    sent = objects([CAR, CAR._replace(x=9.0)], BEGIN_NS + 2 * NS // 5)
    one, two = object_states(sent, BEGIN_NS)
    assert one.id == "01" * 16
    assert two.id == "02" * 16
    np.testing.assert_allclose(one[1:], CAR[1:], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "points", "expected"),
    [
        (BOX, [], (5.0, 6.0, 4.4, 1.7)),
        (CYLINDER, [], (5.0, 6.0, 4.4, 1.7)),
        (POLYGON, [(1.0, 0.5), (3.0, 0.5), (3.0, -0.5), (1.0, -0.5)], (7.0, 6.0, 2.0, 1.0)),
        (POLYGON, [], (5.0, 6.0, 4.4, 1.7)),
    ],
    ids=["box", "cylinder", "polygon", "empty polygon"],
)
def test_a_shape_is_the_box_around_it(
    kind: int, points: list[tuple[float, float]], expected: tuple[float, ...]
) -> None:
    each = predicted_object(1, CAR._replace(yaw=0.0))
    each.shape.type = kind
    each.shape.footprint.points = [make("geometry_msgs/msg/Point32", x=x, y=y) for x, y in points]
    message = objects([], BEGIN_NS)
    message.objects = [each]
    (found,) = object_states(message, BEGIN_NS)
    assert (found.x, found.y, found.length, found.width) == pytest.approx(expected)


def planned(**said: object) -> Trajectory:
    """Backwards at first, then at rest, then ahead."""
    speeds, accels = [-2.0, 0.0, 1.0], [1.0, 5.0, 0.5]
    states = np.array([[10.0, 5.0, math.pi / 2, v, a, 0.1] for v, a in zip(speeds, accels, strict=True)])
    is_full_braking = bool(said.pop("is_full_braking", False))
    diagnostics = Diagnostics(**said)  # type: ignore[arg-type]
    return Trajectory(100.0 + 0.2 * np.arange(3), states, 4.0, is_full_braking, diagnostics)


def test_a_trajectory_is_that_of_the_rear_axle() -> None:
    message = trajectory_message(planned(), BEGIN_NS + 7, 3.0, VEHICLE)
    assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == (
        "map",
        BEGIN_NS // NS,
        7,
    )
    assert [(p.time_from_start.sec, p.time_from_start.nanosec) for p in message.points] == [
        (0, 0),
        (0, 200_000_000),
        (0, 400_000_000),
    ]
    first = message.points[0]
    position = first.pose.position
    assert (position.x, position.y, position.z) == pytest.approx((10.0, 5.0 - VEHICLE.base_to_middle_m, 3.0))
    assert yaw_of(first.pose.orientation) == pytest.approx(math.pi / 2)
    assert first.heading_rate_rps == pytest.approx(-0.2)
    assert first.front_wheel_angle_rad == pytest.approx(math.atan(2.7 * 0.1))


def test_an_acceleration_of_autoware_is_that_of_the_absolute_speed() -> None:
    points = trajectory_message(planned(), BEGIN_NS, 0.0, VEHICLE).points
    assert [p.longitudinal_velocity_mps for p in points] == [-2.0, 0.0, 1.0]
    assert [p.acceleration_mps2 for p in points] == [-1.0, 5.0, 0.5]


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({}, (OK, "driving the plan")),
        ({"stop": "objects"}, (ERROR, "stop: objects")),
        ({"is_full_braking": True}, (WARN, "full braking: no plan is feasible")),
        ({"intervention": "last_plan"}, (WARN, "safety layer: last_plan")),
        ({"lost": ("a",)}, (WARN, "messages of objects are missing")),
    ],
    ids=["plan", "stop", "full braking", "intervention", "lost"],
)
def test_the_level_of_the_debug_topic(said: dict, expected: tuple[int, str]) -> None:
    assert verdict(planned(**said)) == expected


def test_the_debug_topic_says_what_the_runtime_did() -> None:
    plan = planned(messages=Counter(new=2, late=1), carried_on=("a", "b"), probabilities={0.0: 0.25, math.inf: 0.75})
    sent = debug_message(BEGIN_NS, WARN, "text", diagnostic_values(plan))
    (status,) = decode(encode(sent), DEBUG.type_name).status
    values = {pair.key: pair.value for pair in status.values}
    assert (status.level, status.message) == (WARN, "text")
    assert values["horizon_s"] == "4"
    assert (values["probability_0s"], values["probability_infs"]) == ("0.25", "0.75")
    assert (values["objects_new"], values["objects_late"], values["carried_on"]) == ("2", "1", "a b")
    assert values["is_full_braking"] == "false"
