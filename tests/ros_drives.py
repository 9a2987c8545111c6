"""The node in the simulator: a vehicle's messages of ROS 2 made of worlds, closed loops in one process and over DDS."""

import math
import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import count
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import pytest
import ros_packages  # noqa: F401
import torch
from games import draw_tasks
from runtime_drives import HEADING, ORIGIN, messages, negotiator, parts, wanted_by

from negopipe.deployment import EgoState, HostStreet, Negotiator, ObjectState
from negopipe.deployment.decision_file import street_of
from negopipe.deployment.middleware.codec import Message, decode, encode, make
from negopipe.deployment.middleware.dds import Bus
from negopipe.deployment.middleware.incoming import NS, stamp_ns, yaw_of
from negopipe.deployment.middleware.interface import (
    ACCELERATION,
    DEBUG,
    INPUTS,
    OBJECTS,
    ODOMETRY,
    OUTPUTS,
    PARKED,
    STREET,
    TRAJECTORY,
    Topic,
)
from negopipe.deployment.middleware.outgoing import header, pose
from negopipe.deployment.middleware.planning_node import PlanningNode
from negopipe.deployment.middleware.recording import Recording
from negopipe.deployment.middleware.serve import Served, Silence
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.simulation.state import VehicleState, World

VEHICLE = Vehicle(wheel_base_m=2.7, front_overhang_m=0.9, rear_overhang_m=0.9)
BEGIN_NS, STEP_NS = 1_700_000_000 * NS, NS // 5
"""Stamp of the first message, as by the clock of a real vehicle, and the control step."""
Z_M = 30.0
"""Height of the map."""
KERB_M = 3.5
FRAME = HostStreet({}, 1.0, ORIGIN, HEADING)
"""Where the simulator's world lies on the host's map."""
LOOPBACK = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>"
    "<NetworkInterface name='lo' multicast='false'/></Interfaces></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
PATIENCE_S = 60.0
COUNTER = count()
"""Each node has a DDS domain of its own: the last one's topics are remembered for some seconds."""

Sent = list[tuple[Topic, Message]]
Exchange = Callable[[Sent, int | None], dict[Topic, Message]]
"""Messages of a step in their order, and the stamp of its odometry where that comes -> what the node says of it."""


def odometry(ego: EgoState, stamp: int) -> Message:
    """The ego's state as its localisation says it, of the rear axle."""
    back_m = VEHICLE.base_to_middle_m
    x, y = ego.x - back_m * math.cos(ego.yaw), ego.y - back_m * math.sin(ego.yaw)
    twist = make(
        "geometry_msgs/msg/Twist",
        linear=make("geometry_msgs/msg/Vector3", x=ego.speed),
        angular=make("geometry_msgs/msg/Vector3", z=ego.speed * ego.curvature),
    )
    return make(
        ODOMETRY.type_name,
        header=header(stamp),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(x, y, Z_M, ego.yaw)),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist),
    )


def acceleration(accel_mps2: float, stamp: int) -> Message:
    accel = make("geometry_msgs/msg/Accel", linear=make("geometry_msgs/msg/Vector3", x=accel_mps2))
    head = header(stamp)
    head.frame_id = "base_link"
    return make(ACCELERATION.type_name, header=head, accel=make("geometry_msgs/msg/AccelWithCovariance", accel=accel))


def predicted_object(number: int, state: ObjectState) -> Message:
    """number: of its UUID"""
    kinematics = make(
        "autoware_perception_msgs/msg/PredictedObjectKinematics",
        initial_pose_with_covariance=make(
            "geometry_msgs/msg/PoseWithCovariance", pose=pose(state.x, state.y, Z_M, state.yaw)
        ),
        initial_twist_with_covariance=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make("geometry_msgs/msg/Twist", linear=make("geometry_msgs/msg/Vector3", x=state.speed)),
        ),
    )
    size = make("geometry_msgs/msg/Vector3", x=state.length, y=state.width, z=1.5)
    return make(
        "autoware_perception_msgs/msg/PredictedObject",
        object_id=make("unique_identifier_msgs/msg/UUID", uuid=np.full(16, number, dtype=np.uint8)),
        existence_probability=1.0,
        kinematics=kinematics,
        shape=make("autoware_perception_msgs/msg/Shape", dimensions=size),
    )


def objects(states: list[ObjectState], stamp: int) -> Message:
    found = [predicted_object(number, state) for number, state in enumerate(states, start=1)]
    return make(OBJECTS.type_name, header=header(stamp), objects=found)


def street(places: np.ndarray, speed: float) -> Message:
    """A street with kerbs at `places` [2, N, 2], m, left and right, and one speed."""
    left, right = ([make("geometry_msgs/msg/Point", x=x, y=y, z=Z_M) for x, y in kerb.tolist()] for kerb in places)
    middle = places.mean(0).tolist()
    points = [
        make("autoware_planning_msgs/msg/PathPoint", pose=pose(x, y, Z_M, HEADING), longitudinal_velocity_mps=speed)
        for x, y in middle[::10]
    ]
    return make(STREET.type_name, header=header(BEGIN_NS), points=points, left_bound=left, right_bound=right)


def street_messages(cars: np.ndarray, speed: float) -> Sent:
    """Kerbs of a straight street of 7 m and parked cars [P, 4] (x, y, length, width), on the host's map."""
    x = np.linspace(-60.0, 60.0, 121)
    kerbs = np.stack([np.stack([x, np.full_like(x, y), 0 * x], -1) for y in (KERB_M, -KERB_M)])
    boxes = FRAME.to_host(np.column_stack([cars[:, :2], np.zeros(len(cars))]))
    parked = [
        ObjectState(n, 0.0, *box, 0.0, *size) for n, (box, size) in enumerate(zip(boxes, cars[:, 2:], strict=True))
    ]
    return [
        (STREET, street(FRAME.to_host(kerbs)[..., :2], speed)),
        (PARKED, objects(parked, BEGIN_NS)),
    ]


def sensed(world: World, stamp: int) -> Sent:
    """What the ego's sensors say of a world."""
    ego, others = messages(world, FRAME, stamp / NS)
    return [
        (OBJECTS, objects(others, stamp)),
        (ACCELERATION, acceleration(ego.accel, stamp)),
        (ODOMETRY, odometry(ego, stamp)),
    ]


@dataclass
class Losses:
    """Which messages of a vehicle reach the node, and when; the same for the same seed.

    Objects and accelerations are lost, late by one or two steps, or come twice; an odometry is lost, or comes after the
    next one. The first three steps are whole.
    """

    seed: int
    lost: float = 0.15
    late: float = 0.2
    waiting: list[tuple[int, Topic, Message]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def __call__(self, step: int, sent: Sent) -> Sent:
        """What comes in a step: what was late is behind an odometry, if there is one."""
        now: Sent = []
        for topic, message in sent:
            chance = self._rng.random() if step >= 3 and topic in (OBJECTS, ACCELERATION, ODOMETRY) else 1.0
            if chance >= self.lost + self.late:
                now.append((topic, message))
                if chance > 0.95 and topic is OBJECTS:
                    now.append((topic, message))
            elif chance >= self.lost:
                n_steps = 1 if topic is ODOMETRY else int(self._rng.integers(1, 3))
                self.waiting.append((step + n_steps, topic, message))
        due = [(topic, message) for at, topic, message in self.waiting if at <= step]
        self.waiting = [each for each in self.waiting if each[0] > step]
        has_odometry = any(topic is ODOMETRY for topic, _ in now)
        early = [each for each in due if each[0] is not ODOMETRY]
        behind = [each for each in due if each[0] is ODOMETRY] if has_odometry else []
        return [*early, *now, *behind]


@dataclass
class Drive:
    """One closed loop.

    worlds: of every step; said: what the node said in a step, nothing where no odometry came
    """

    worlds: list[World]
    said: list[dict[Topic, Message]]

    @property
    def trajectories(self) -> list[bytes]:
        return [encode(each[TRAJECTORY]) for each in self.said if TRAJECTORY in each]

    @property
    def debug(self) -> list[dict[str, str]]:
        """Values of the debug topic of every decision."""
        return [{pair.key: pair.value for pair in each[DEBUG].status[0].values} for each in self.said if DEBUG in each]


def drive(exchange: Exchange, n_steps: int, *overrides: str, seed: int, losses: Losses | None = None) -> Drive:
    """A closed loop of one task through messages of ROS 2; without a new trajectory the last one is driven on."""
    config, game, _ = parts(*overrides)
    world = game.simulator.reset(draw_tasks(config, 1, seed))
    cars, speed = street_of(game.simulator.road, 1).parked, float(world.task.desired_speed[0, 0])
    exchange(street_messages(cars, speed), None)
    done, newest = Drive([world], []), None
    for step in range(n_steps):
        stamp = BEGIN_NS + step * STEP_NS
        sent = sensed(world, stamp)
        come = sent if losses is None else losses(step, sent)
        is_asked = any(message is sent[-1][1] for _, message in come)
        done.said.append(exchange(come, stamp if is_asked else None))
        newest = done.said[-1].get(TRAJECTORY, newest)
        driven = state_at(newest, stamp + STEP_NS)
        wanted = wanted_by(game, world, driven, torch.tensor([torch.nan]))
        world, events = game.simulator.step(world, wanted)
        done.worlds.append(world)
        if bool((events.is_terminated | events.is_truncated)[0]):
            break
    return done


def state_at(trajectory: Message, stamp: int) -> VehicleState:
    """The ego as it is at a time that is one of the trajectory's points, [1], in the simulator's frame."""
    after = {p.time_from_start.sec * NS + p.time_from_start.nanosec: p for p in trajectory.points}
    point = after[stamp - stamp_ns(trajectory)]
    yaw, speed = yaw_of(point.pose.orientation), point.longitudinal_velocity_mps
    ahead_m, position = VEHICLE.base_to_middle_m, point.pose.position
    x, y = position.x + ahead_m * math.cos(yaw), position.y + ahead_m * math.sin(yaw)
    accel = -point.acceleration_mps2 if speed < 0 else point.acceleration_mps2
    curvature = math.tan(point.front_wheel_angle_rad) / VEHICLE.wheel_base_m
    x, y, *rest = FRAME.to_street(np.array([x, y, yaw, speed, accel, curvature])).tolist()
    return VehicleState(torch.tensor([[x, y]]), *torch.tensor(rest)[:, None])


def on_own_street(*overrides: str) -> Negotiator:
    """The runtime on the street that its policy learnt, in the place of the one between the kerbs.

    Routes that are laid between kerbs begin 2.75 m earlier than those of the default street.
    """
    runtime, game = negotiator(*overrides), parts(*overrides)[1]
    known = runtime.street(street_of(game.simulator.road, 1), 1.0, ORIGIN, HEADING)
    runtime.street_between = lambda left, right, parked: known  # type: ignore[method-assign]
    return runtime


def in_process(node: PlanningNode, recording: Recording | None = None) -> Exchange:
    """The node in this process; its messages are bytes on their way, and recorded in the order of `serve`."""

    def exchange(sent: Sent, stamp: int | None) -> dict[Topic, Message]:
        said: dict[Topic, Message] = {}
        for topic, message in sent:
            data = record(topic, message)
            node.take(topic, decode(data, topic.type_name))
            due = node.due()
            if due is not None:
                said |= {topic: decode(record(topic, each), topic.type_name) for topic, each in node.decide(due)}
        return said

    def record(topic: Topic, message: Message) -> bytes:
        data = encode(message)
        if recording is not None:
            recording.add(topic, data)
        return data

    return exchange


class NodeProcess:
    """The node in a process of its own, on the loopback, and the other side of its topics."""

    def __init__(self, silence_s: float = 600.0, record: Path | None = None) -> None:
        self._patch = pytest.MonkeyPatch()
        context = get_context("spawn")
        self._domain, self._is_over = 100 + (os.getpid() + next(COUNTER)) % 100, context.Event()
        given = (self._domain, silence_s, record, self._is_over)
        self._process = context.Process(target=node_process, args=given, daemon=True)

    def __enter__(self) -> "NodeProcess":
        self._patch.setenv("CYCLONEDDS_URI", LOOPBACK)
        self._process.start()
        self.bus = Bus(self._domain, OUTPUTS, INPUTS)
        end_s = time.monotonic() + PATIENCE_S
        while not all(self.bus.is_matched(topic) for topic in (*INPUTS, *OUTPUTS)):
            assert time.monotonic() < end_s, "the node does not come"
            time.sleep(0.05)
        return self

    def __exit__(self, *_: object) -> None:
        self._patch.undo()
        self._is_over.set()
        self._process.join(PATIENCE_S)
        self.exitcode = self._process.exitcode
        if self._process.is_alive():
            self._process.kill()

    def exchange(self, sent: Sent, stamp: int | None) -> dict[Topic, Message]:
        """Publish in order, each when those before have arrived; wait for the decision of the stamp."""
        said: dict[Topic, Message] = {}
        for topic, message in sent:
            self.bus.publish(topic, encode(message))
            assert self.bus.wait_for_acks(topic, PATIENCE_S)
            if topic is ODOMETRY and stamp is not None and not said:
                said = self.decision(stamp)
        return said

    def decision(self, stamp: int) -> dict[Topic, Message]:
        """What the node says for a stamp; stops of a silence may come before."""
        said: dict[Topic, Message] = {}
        end_s = time.monotonic() + PATIENCE_S
        while not (TRAJECTORY in said and DEBUG in said):
            assert time.monotonic() < end_s, "the node does not answer"
            self.bus.wait(0.5)
            for topic, data in self.bus.take():
                message = decode(data, topic.type_name)
                if topic in (TRAJECTORY, DEBUG) and stamp_ns(message) == stamp:
                    said[topic] = message
        return said


def node_process(domain: int, silence_s: float, record: Path | None, is_over: Event) -> None:
    """What runs in the node's process."""
    torch.set_num_threads(1)
    node, bus = PlanningNode(on_own_street(), VEHICLE, 0.2), Bus(domain, INPUTS, OUTPUTS)
    with Recording(record, VEHICLE.as_texts()) if record else nullcontext() as file:
        Served(node, bus, Silence(silence_s, 0.2), file).run(is_over.is_set)
