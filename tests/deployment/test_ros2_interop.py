"""A node of ROS 2 itself, rclpy with Fast DDS, hears the topics of `Bus` and is heard; skipped without rclpy."""

import time
from multiprocessing import get_context
from typing import Any

import pytest
import ros_packages  # noqa: F401

from negopipe.deployment.middleware.codec import decode, encode
from negopipe.deployment.middleware.dds import Bus
from negopipe.deployment.middleware.interface import DEBUG, INPUTS, ODOMETRY, OUTPUTS
from negopipe.deployment.middleware.outgoing import WARN, debug_message

for name in ("rclpy", "nav_msgs", "diagnostic_msgs"):
    pytest.importorskip(name)

pytestmark = pytest.mark.slow

DOMAIN, N_ANSWERS, PATIENCE_S = 99, 5, 60.0


def ros_node(answers: Any) -> None:
    """Publishes odometries, each later than the last, until debug messages have come; these are the answers."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from nav_msgs.msg import Odometry

    rclpy.init(domain_id=DOMAIN)
    node, heard = rclpy.create_node("vehicle"), []
    publisher = node.create_publisher(Odometry, ODOMETRY.name, 1)
    node.create_subscription(DiagnosticArray, DEBUG.name, heard.append, 10)
    end_s, n_sent = time.monotonic() + PATIENCE_S, 0
    while len(heard) < N_ANSWERS and time.monotonic() < end_s:
        rclpy.spin_once(node, timeout_sec=0.1)
        message = Odometry(child_frame_id="base_link")
        message.header.stamp.sec, message.header.frame_id = n_sent, "map"
        message.pose.pose.position.x, message.twist.twist.linear.x = 0.5 * n_sent, 4.25
        message.pose.covariance[35] = 7.0
        publisher.publish(message)
        n_sent += 1
    answers.put([(each.header.stamp.sec, each.status[0].message, each.status[0].values[0].value) for each in heard])
    rclpy.shutdown()


def test_a_node_of_ros_2_hears_and_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    context = get_context("spawn")
    answers = context.Queue()
    bus = Bus(DOMAIN, INPUTS, OUTPUTS)
    process = context.Process(target=ros_node, args=(answers,), daemon=True)
    process.start()
    end_s = time.monotonic() + PATIENCE_S
    while answers.empty() and time.monotonic() < end_s:
        bus.wait(0.1)
        for topic, data in bus.take():
            message = decode(data, topic.type_name)
            assert topic is ODOMETRY
            assert message.pose.pose.position.x == 0.5 * message.header.stamp.sec
            assert (message.twist.twist.linear.x, message.pose.covariance[35]) == (4.25, 7.0)
            stamp = message.header.stamp.sec * 1_000_000_000
            bus.publish(DEBUG, encode(debug_message(stamp, WARN, "words", {"number": stamp})))
    found = answers.get(timeout=1.0)
    process.join(PATIENCE_S)
    assert len(found) >= N_ANSWERS
    assert {(text, int(value) // 1_000_000_000 == second) for second, text, value in found} == {("words", True)}
