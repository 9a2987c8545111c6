"""The parts around the car: controller, hand-over at walking pace, channel, sensors; none needs another package."""

import math
from dataclasses import replace

import numpy as np
import pytest
from composed import compose_config

from negopipe.deployment.messages import Diagnostics, Trajectory
from negopipe.deployment.vehicle.actuators import Command
from negopipe.deployment.vehicle.body import (
    Body,
    CarState,
    Geometry,
    body_at,
    car_state,
    middle_curvature,
    steer_of,
)
from negopipe.deployment.vehicle.cars import RealCar, tracked
from negopipe.deployment.vehicle.channel import Channel
from negopipe.deployment.vehicle.controller import Controller
from negopipe.deployment.vehicle.kinematic import rolled
from negopipe.deployment.vehicle.options import ObjectsConfig, VehicleConfig
from negopipe.deployment.vehicle.path import Path
from negopipe.deployment.vehicle.plant import Plant
from negopipe.deployment.vehicle.sensors import Localisation, ObjectSensor, Others

GEOMETRY = Geometry(2.6, 0.6, 0.4)
STEP_S = 0.01
"""Of the car's model here, ten times as long as in the drives."""


class Rolling:
    """A driving model that rolls without slip; like the multi-body model it never starts again once it stands."""

    geometry = GEOMETRY

    def start(self, body: Body) -> None:
        assert body.speed > 0
        self.body = body

    def step(self, steer_rate: float, accel: float, step_s: float) -> None:
        still = self.body._replace(speed=0.0)
        self.body = still if self.body.speed <= 0 else rolled(self.body, steer_rate, accel, 1.0, GEOMETRY, step_s)


def vehicle_config() -> VehicleConfig:
    """As it comes, without errors of the localisation, and in longer steps."""
    config = compose_config().vehicle
    exact = replace(config.localisation, position_std_m=0.0, yaw_std_rad=0.0, speed_std_mps=0.0)
    return replace(config, plant_s=STEP_S, decision_delay_s=0.0, localisation=exact)


def plan_of(curvature: float, speed: float, accel: float = 0.0, seconds: float = 8.0) -> Trajectory:
    """A plan on a circle from the origin along x; it ends in standstill where it is braked."""
    times_s = np.arange(0.0, seconds, 0.2)
    speeds = speed + accel * times_s
    is_still = speeds * speed <= 0
    until_s = np.where(is_still, -speed / accel if accel else 0.0, times_s)
    along = speed * until_s + accel * until_s**2 / 2
    yaw = curvature * along
    x, y = along * np.sinc(yaw / np.pi), along * np.sinc(yaw / 2 / np.pi) * np.sin(yaw / 2)
    columns = [x, y, yaw, np.where(is_still, 0.0, speeds), np.where(is_still, 0.0, accel), np.full_like(x, curvature)]
    return Trajectory(times_s, np.stack(columns, -1), 6.0, False, Diagnostics())


def drive(plan: Trajectory, start: CarState, seconds: float = 6.0) -> RealCar:
    config = vehicle_config()
    known = Localisation(config.localisation, 6.0, np.random.default_rng(0))
    car = RealCar(Rolling(), start, config, known)
    for step in range(round(seconds / 0.2)):
        car.drive(plan, 0.2 * step, 0.2 * (step + 1))
    return car


@pytest.mark.parametrize("curvature", [0.0, 0.08, -0.08], ids=["straight", "left", "right"])
def test_a_car_beside_its_plan_gets_onto_it_and_stays(curvature: float) -> None:
    car = drive(plan_of(curvature, 5.0), CarState(0.5, 0.4, 0.1, 4.0, 0.0, curvature))
    ahead, left, turned = np.abs(tracked(car.samples)).T
    assert left[0] > 0.3
    assert left[-200:].max() < 0.03
    assert ahead[-200:].max() < 0.1
    slip = abs(curvature) * GEOMETRY.wheelbase_m / 2
    np.testing.assert_allclose(turned[-200:], slip, atol=0.02)


def test_a_car_backs_along_a_bend() -> None:
    car = drive(plan_of(0.05, -1.5), CarState(0.0, 0.2, 0.0, 0.0, 0.0, 0.0))
    ahead, left, _ = np.abs(tracked(car.samples)[-100:]).T
    assert car.state.speed == pytest.approx(-1.5, abs=0.1)
    assert left.max() < 0.08
    assert ahead.max() < 0.15


def test_a_car_stops_where_its_plan_stops_and_stands() -> None:
    car = drive(plan_of(0.0, 5.0, -3.0), CarState(0.0, 0.0, 0.0, 5.0, 0.0, 0.0))
    places = [sample.car.x for sample in car.samples[-100:]]
    assert car.state.speed == 0.0
    assert places[0] == places[-1] == pytest.approx(25 / 6, abs=0.3)


def test_the_wheels_turn_no_faster_than_the_car_s_can() -> None:
    car = drive(plan_of(0.15, 4.0), CarState(0.0, 0.0, 0.0, 4.0, 0.0, 0.0), seconds=1.0)
    steer = np.array([math.atan(GEOMETRY.wheelbase_m * sample.car.curvature) for sample in car.samples])
    rates = np.diff(steer) / 0.01
    assert rates.max() == pytest.approx(GEOMETRY.steer_rate_max_radps, rel=0.1)


def test_it_starts_again_from_standstill_by_the_kinematic_model() -> None:
    plant = Plant(Rolling(), Body(0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0), 1.0, STEP_S)
    seen = []
    for accel in (-2.0, 2.0):
        for _ in range(200):
            plant.step(0.0, accel, 1.0)
            seen.append((plant.is_driving, plant.body.speed))
    assert seen[199] == (False, 0.0)
    assert {is_driving for is_driving, speed in seen if speed < 0.98} == {False}
    assert {is_driving for is_driving, speed in seen if speed > 1.22} == {True}
    assert plant.body.speed == pytest.approx(4.0, abs=0.05)


def test_brakes_do_not_push_back() -> None:
    body = Body(0.0, 0.0, 0.0, 0.015, 0.0, 0.0, 0.0)
    for _ in range(3):
        body = rolled(body, 0.0, -2.0, 1.0, GEOMETRY, STEP_S)
    assert body.speed == 0.0
    assert rolled(body, 0.0, -2.0, -1.0, GEOMETRY, STEP_S).speed < 0


@pytest.mark.parametrize("curvature", [-0.2, 0.0, 0.1])
def test_body_and_middle_of_the_footprint_tell_the_same(curvature: float) -> None:
    state = CarState(3.0, -2.0, 0.7, 4.0, 0.0, curvature)
    back = car_state(body_at(state, GEOMETRY), 0.0, GEOMETRY)
    np.testing.assert_allclose(back, state, atol=1e-9)
    assert middle_curvature(steer_of(curvature, 2.6), 2.6) == pytest.approx(curvature)


def test_messages_arrive_when_their_latency_is_over_and_may_overtake() -> None:
    channel: Channel[str] = Channel()
    channel.send("first", 0.3)
    channel.send("second", 0.2)
    channel.send("third", 0.4)
    assert channel.receive(0.1) == []
    assert channel.receive(0.2) == ["second"]
    assert channel.receive(0.3) == ["first"]
    assert channel.receive(1.0) == ["third"]


def test_frames_have_the_age_the_gaps_and_the_errors_that_were_asked_for() -> None:
    config = compose_config().vehicle.objects
    sensor = ObjectSensor(config, np.random.default_rng(0))
    heard = []
    for step in range(2000):
        now_s = 0.2 * step
        row = [5.0 * now_s, 1.0, 0.0, 5.0, 4.5, 1.8]
        heard += [(now_s, message) for message in sensor.hear(Others(now_s, np.array([row]))) or []]
    ages = np.array([now_s - message.time_s for now_s, message in heard])
    assert ages.min() > config.latency_s[0] - 1e-6
    assert ages.max() < config.latency_s[1] + 0.2 + 1e-6  # it waits for the next decision
    expected = 4000 * (1 - config.lost_frames) * (1 - config.lost_objects)
    assert len(heard) == pytest.approx(expected, rel=0.02)
    errors = np.array([[m.x - 5.0 * m.time_s, m.y - 1.0, m.yaw, m.speed - 5.0] for _, m in heard])
    deviations = (config.position_std_m, config.position_std_m, config.yaw_std_rad, config.speed_std_mps)
    np.testing.assert_allclose(errors.std(0), deviations, rtol=0.06)


def exact_objects(**changes: float) -> ObjectsConfig:
    return replace(
        compose_config().vehicle.objects, position_std_m=0.0, yaw_std_rad=0.0, speed_std_mps=0.0, lost_frames=0.0,
        lost_objects=0.0, latency_s=(0.0, 0.0), **changes,
    )  # fmt: skip


@pytest.mark.parametrize(("before_s", "x"), [(0.5, [2.0, 1.6, 1.2, 0.8, 0.4, 0.0]), (0.0, [0.0])])
def test_the_others_have_come_for_a_while_when_a_drive_begins(before_s: float, x: list[float]) -> None:
    sensor = ObjectSensor(exact_objects(seen_before_s=before_s), np.random.default_rng(0))
    heard = sensor.hear(Others(0.0, np.array([[0.0, 0.0, math.pi, 4.0, 4.5, 1.8]])))
    assert heard is not None
    np.testing.assert_allclose([message.x for message in heard], x, atol=1e-9)
    np.testing.assert_allclose([message.time_s for message in heard], [-each / 4 for each in x], atol=1e-9)


def test_the_others_are_seen_between_two_decisions() -> None:
    sensor = ObjectSensor(exact_objects(), np.random.default_rng(0))
    sensor.hear(Others(0.0, np.array([[0.0, 0.0, math.pi - 0.1, 4.0, 4.5, 1.8]])))
    messages = sensor.hear(Others(0.2, np.array([[-0.8, 0.0, 0.1 - math.pi, 4.0, 4.5, 1.8]])))
    assert messages is not None
    between = next(message for message in messages if message.time_s == pytest.approx(0.1))
    assert between.x == pytest.approx(-0.4)
    assert abs(between.yaw) == pytest.approx(math.pi)


def test_the_controller_holds_a_car_where_its_plan_is_at_rest() -> None:
    config = vehicle_config().controller
    plan = plan_of(0.0, 1.0, -2.0)
    command = Controller(config, GEOMETRY).command(Path(plan), 5.0, CarState(0.3, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert isinstance(command, Command)
    assert command.accel < 0
    assert command.gear == 1.0
