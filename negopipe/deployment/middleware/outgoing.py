"""What the runtime says as messages of ROS 2: the trajectory, and the debug topic."""

import math
from collections.abc import Mapping

from negopipe.deployment.messages import Diagnostics, Trajectory
from negopipe.deployment.middleware.codec import Message, make
from negopipe.deployment.middleware.incoming import NS
from negopipe.deployment.middleware.interface import DEBUG, FRAME, TRAJECTORY
from negopipe.deployment.middleware.vehicle import Vehicle

OK, WARN, ERROR = 0, 1, 2
"""`diagnostic_msgs/DiagnosticStatus.level`."""

NAME = "negopipe: decision"
"""Name of the status on the debug topic."""


def header(stamp: int) -> Message:
    """stamp: ns"""
    time = make("builtin_interfaces/msg/Time", sec=stamp // NS, nanosec=stamp % NS)
    return make("std_msgs/msg/Header", stamp=time, frame_id=FRAME)


def pose(x: float, y: float, z: float, yaw: float) -> Message:
    """x, y, z: m; yaw: rad"""
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=make("geometry_msgs/msg/Quaternion", z=math.sin(yaw / 2), w=math.cos(yaw / 2)),
    )


def trajectory_message(plan: Trajectory, stamp: int, z: float, vehicle: Vehicle) -> Message:
    """A plan as poses of the rear axle; stamp: of the decision, ns; z: height of all points, m."""
    after_ns = [round((time_s - plan.times_s[0]) * NS) for time_s in plan.times_s.tolist()]
    points = [_point(state, each, z, vehicle) for state, each in zip(plan.states.tolist(), after_ns, strict=True)]
    return make(TRAJECTORY.type_name, header=header(stamp), points=points)


def _point(state: list[float], after_ns: int, z: float, vehicle: Vehicle) -> Message:
    x, y, yaw, speed, accel, curvature = state
    back_m = vehicle.base_to_middle_m
    return make(
        "autoware_planning_msgs/msg/TrajectoryPoint",
        time_from_start=make("builtin_interfaces/msg/Duration", sec=after_ns // NS, nanosec=after_ns % NS),
        pose=pose(x - back_m * math.cos(yaw), y - back_m * math.sin(yaw), z, yaw),
        longitudinal_velocity_mps=speed,
        acceleration_mps2=-accel if speed < 0 else accel,  # of the absolute speed
        heading_rate_rps=speed * curvature,
        front_wheel_angle_rad=math.atan(vehicle.wheel_base_m * curvature),
    )


def debug_message(stamp: int, level: int, text: str, values: Mapping[str, object]) -> Message:
    """What is known of one decision; stamp: ns."""
    pairs = [make("diagnostic_msgs/msg/KeyValue", key=key, value=_text(value)) for key, value in values.items()]
    status = make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=NAME,
        message=text,
        hardware_id="negopipe",
        values=pairs,
    )
    return make(DEBUG.type_name, header=header(stamp), status=[status])


def verdict(plan: Trajectory) -> tuple[int, str]:
    """Level and text of a decision: a stop is an error; what is driven or seen otherwise than planned a warning."""
    said = plan.diagnostics
    if said.stop:
        return ERROR, f"stop: {said.stop}"
    if plan.is_full_braking:
        return WARN, "full braking: no plan is feasible"
    if said.intervention != "none":
        return WARN, f"safety layer: {said.intervention}"
    if said.carried_on or said.lost:
        return WARN, "messages of objects are missing"
    return OK, "driving the plan"


def diagnostic_values(plan: Trajectory) -> dict[str, object]:
    """Values of the debug topic that come from the runtime."""
    said = plan.diagnostics
    return {
        "horizon_s": plan.horizon_s,
        "draw": f"{said.draw:.9g}",
        **{f"probability_{horizon_s:g}s": share for horizon_s, share in said.probabilities.items()},
        "is_full_braking": plan.is_full_braking,
        **_told(said),
    }


def _told(said: Diagnostics) -> dict[str, object]:
    return {
        "intervention": said.intervention,
        "stop": said.stop,
        "start": said.start,
        "is_restarted": said.is_restarted,
        "carried_on": " ".join(map(str, said.carried_on)),
        "lost": " ".join(map(str, said.lost)),
        "left_out": " ".join(map(str, said.left_out)),
        **{f"objects_{word}": number for word, number in sorted(said.messages.items())},
    }


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)
