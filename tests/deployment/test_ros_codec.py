"""Messages of ROS 2 as bytes: types as Autoware publishes them, the same messages read as written."""

import numpy as np
import pytest
import ros_packages  # noqa: F401

from negopipe.deployment.middleware.codec import decode, definition, encode, make, type_hash
from negopipe.deployment.middleware.interface import TOPICS, Topic
from negopipe.errors import UserError

PUBLISHED = {
    "autoware_perception_msgs/msg/PredictedObjects": "b63151309c3323bb6e3f09c54b3358aa53a8e66937a1cde15c5d5ede1ef80a08",
    "autoware_planning_msgs/msg/Trajectory": "8259168af0abd0d3fa8297048f83aae4dad0955bd2d4e0904bcdc4f6f99a61b2",
    "geometry_msgs/msg/AccelWithCovarianceStamped": "61c9ad8928e71dd95ce791b2f02809ee2a0bbcc42cd0e4047fd00a822a08e444",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
}
"""Hashes in autoware_core's `interface_type_hashes.jazzy.lock` of August 2026."""


@pytest.mark.parametrize("type_name", list(PUBLISHED))
def test_types_are_those_that_autoware_publishes(type_name: str) -> None:
    assert type_hash(type_name) == f"RIHS01_{PUBLISHED[type_name]}"


@pytest.mark.parametrize("topic", TOPICS.values(), ids=TOPICS)
def test_a_message_of_each_topic_is_read_as_written(topic: Topic) -> None:
    data = encode(make(topic.type_name))
    assert data[:4] == b"\x00\x01\x00\x00"
    assert encode(decode(data, topic.type_name)) == data
    assert encode(decode(data + b"\x00\x00\x00", topic.type_name)) == data  # DDS pads to four bytes


def test_bytes_are_those_of_cdr() -> None:
    """Little endian, numbers aligned to their size, strings with their length and a closing zero."""
    stamp = make("builtin_interfaces/msg/Time", sec=258, nanosec=3)
    message = make("std_msgs/msg/Header", stamp=stamp, frame_id="map")
    assert encode(message) == bytes.fromhex("00010000 02010000 03000000 04000000 6d617000".replace(" ", ""))


def test_fields_that_are_not_given_have_default_values() -> None:
    message = make("nav_msgs/msg/Odometry", child_frame_id="base_link")
    assert (message.child_frame_id, message.header.frame_id, message.pose.pose.position.x) == ("base_link", "", 0.0)
    np.testing.assert_array_equal(message.pose.covariance, np.zeros(36))
    assert make("unique_identifier_msgs/msg/UUID").uuid.dtype == np.uint8
    with pytest.raises(TypeError, match="has no field speed"):
        make("nav_msgs/msg/Odometry", speed=1.0)


@pytest.mark.parametrize("data", [b"", b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00" + b"\xff" * 40, b"what is this?"])
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(UserError, match="must be CDR of this type"):
        decode(data, "autoware_planning_msgs/msg/Trajectory")


def test_a_definition_holds_all_that_it_is_made_of() -> None:
    text = definition("autoware_planning_msgs/msg/Trajectory")
    assert text.startswith("std_msgs/Header header\nautoware_planning_msgs/TrajectoryPoint[] points\n")
    assert "MSG: autoware_planning_msgs/TrajectoryPoint\n" in text
    assert "MSG: geometry_msgs/Quaternion\n" in text
