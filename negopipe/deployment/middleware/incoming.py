"""Messages of ROS 2 as the runtime takes them: odometry, objects, kerbs; NumPy alone."""

import math

import numpy as np

from negopipe.deployment.messages import Array, EgoState, ObjectState
from negopipe.deployment.middleware.codec import Message
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.errors import UserError

NS = 1_000_000_000
"""Nanoseconds of a second."""

STEERED_MPS = 0.5
"""Speed from which on a curvature is read off the yaw rate."""

BOX, CYLINDER, POLYGON = 0, 1, 2
"""`autoware_perception_msgs/Shape.type`."""


def stamp_ns(message: Message) -> int:
    """Time of a message with a header, ns."""
    return int(message.header.stamp.sec) * NS + int(message.header.stamp.nanosec)


def time_s(message: Message, origin_ns: int) -> float:
    """Time of a message for the runtime: s since the origin, because float64 has 0.2 us steps at today's stamps."""
    return (stamp_ns(message) - origin_ns) / NS


def yaw_of(orientation: Message) -> float:
    """Heading of a quaternion, rad."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def ego_state(odometry: Message, accel_mps2: float, desired_speed: float, vehicle: Vehicle, origin_ns: int) -> EgoState:
    """The ego at the time of its odometry; accel_mps2: along the path, NaN where it is not known."""
    pose, twist = odometry.pose.pose, odometry.twist.twist
    yaw, speed = yaw_of(pose.orientation), twist.linear.x
    ahead_m = vehicle.base_to_middle_m
    return EgoState(
        time_s=time_s(odometry, origin_ns),
        x=pose.position.x + ahead_m * math.cos(yaw),
        y=pose.position.y + ahead_m * math.sin(yaw),
        yaw=yaw,
        speed=speed,
        accel=accel_mps2,
        curvature=twist.angular.z / speed if abs(speed) >= STEERED_MPS else 0.0,
        desired_speed=desired_speed,
    )


def object_states(objects: Message, origin_ns: int) -> list[ObjectState]:
    """The road users of a message, each by its UUID."""
    at_s, found = time_s(objects, origin_ns), []
    for each in objects.objects:
        pose = each.kinematics.initial_pose_with_covariance.pose
        speed = each.kinematics.initial_twist_with_covariance.twist.linear.x
        x, y, yaw, length, width = footprint(pose, each.shape)
        found.append(ObjectState(bytes(each.object_id.uuid).hex(), at_s, x, y, yaw, speed, length, width))
    return found


def footprint(pose: Message, shape: Message) -> tuple[float, float, float, float, float]:
    """x, y (m), yaw (rad), length, width (m) of the box around a shape, along its heading."""
    x, y, yaw = pose.position.x, pose.position.y, yaw_of(pose.orientation)
    if shape.type != POLYGON or not shape.footprint.points:
        return x, y, yaw, shape.dimensions.x, shape.dimensions.y
    corners = np.array([[point.x, point.y] for point in shape.footprint.points], dtype=np.float64)
    (ahead, aside), (length, width) = (corners.max(0) + corners.min(0)) / 2, np.ptp(corners, axis=0)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x + cos * ahead - sin * aside, y + sin * ahead + cos * aside, yaw, float(length), float(width)


def kerbs(street: Message) -> tuple[Array, Array]:
    """Left and right kerb, [N, 2] and [M, 2] m, of the bounds of a path."""
    left, right = (
        np.array([[point.x, point.y] for point in bound], dtype=np.float64).reshape(-1, 2)
        for bound in (street.left_bound, street.right_bound)
    )
    return left, right


def parked_boxes(parked: Message | None) -> Array:
    """[P, 5]: x, y (m), yaw (rad), length, width (m) of parked vehicles; None = there are none."""
    objects = () if parked is None else parked.objects
    boxes = [footprint(each.kinematics.initial_pose_with_covariance.pose, each.shape) for each in objects]
    return np.array(boxes, dtype=np.float64).reshape(-1, 5)


def speed_limits(street: Message) -> Array:
    """[P, 3]: x, y (m), speed (m/s) of the points of a path. UserError where it has none."""
    if not street.points:
        raise UserError("points of the street must say how fast to drive, got a path without points")
    rows = [(*_xy(point.pose.position), point.longitudinal_velocity_mps) for point in street.points]
    return np.array(rows, dtype=np.float64)


def speed_at(limits: Array, x: float, y: float) -> float:
    """Speed at the nearest of the points, m/s."""
    return float(limits[np.hypot(limits[:, 0] - x, limits[:, 1] - y).argmin(), 2])


def _xy(position: Message) -> tuple[float, float]:
    return position.x, position.y
