"""What the runtime does about messages that are late, lost, twice there or wrong, and about its own faults."""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from games import draw_tasks
from runtime_drives import Arrays, drive_with_runtime, messages, negotiator, parts, places, straight_on, street_for

from negopipe.deployment import EgoState, HostStreet, Negotiator, ObjectState, Trajectory
from negopipe.deployment.history import Before
from negopipe.errors import UserError
from negopipe.simulation.state import World

BEGIN_S, DT_S, SPEED = 1000.0, 0.2, 5.0


class Scene:
    """A runtime whose exported decision is a plan straight on, an ego at 5 m/s along the street, and one object."""

    def __init__(self) -> None:
        built, street, ego, (car,) = scene()
        self.arguments: list[Arrays] = []
        self.answer: Callable[[Arrays], Arrays] = straight_on
        self.runtime = Negotiator(built.settings, self._decide, lambda tables: {})
        self.street, self._ego, self._car = street, ego, car

    def _decide(self, arguments: Arrays) -> Arrays:
        self.arguments.append(arguments)
        return self.answer(arguments)

    def ego(self, time_s: float) -> EgoState:
        return self._moved(self._ego, time_s)

    def car(self, time_s: float) -> ObjectState:
        return self._moved(self._car, time_s)

    def decide(self, time_s: float, objects: Iterable[ObjectState] | None = (), **changed: float) -> Trajectory:
        return self.runtime.decide(self.ego(time_s)._replace(**changed), objects, self.street, time_s)

    def stop_of(self, time_s: float, **changed: float) -> str:
        return self.decide(time_s, **changed).diagnostics.stop

    @staticmethod
    def _moved(message: EgoState | ObjectState, time_s: float) -> EgoState | ObjectState:
        driven = SPEED * (time_s - BEGIN_S)
        x, y = message.x + driven * math.cos(message.yaw), message.y + driven * math.sin(message.yaw)
        return message._replace(time_s=time_s, x=x, y=y, speed=SPEED)


@cache
def scene() -> tuple[Negotiator, HostStreet, EgoState, list[ObjectState]]:
    runtime, (config, game, _) = negotiator(), parts()
    world = game.simulator.reset(draw_tasks(config, 1, seed=0))
    street = street_for(runtime, game, world)
    return runtime, street, *messages(world, street, BEGIN_S)


def assert_stops(trajectory: Trajectory, reason: str) -> None:
    """It begins at its speed and ends at rest, within the distance of full braking."""
    assert trajectory.diagnostics.stop == reason
    states = trajectory.states
    assert np.isfinite(states).all()
    assert states[-1, 3] == 0
    braking_m = states[0, 3] ** 2 / (2 * 8.0)
    assert np.linalg.norm(states[-1, :2] - states[0, :2]) == pytest.approx(braking_m, abs=1e-6)


def test_messages_are_counted_by_what_is_done_about_them() -> None:
    drive = Scene()
    wrong = drive.car(BEGIN_S)._replace(x=math.nan)
    sizeless = drive.car(BEGIN_S)._replace(width=0.0)
    early, old = drive.car(BEGIN_S + 1.0), drive.car(BEGIN_S - 9.0)
    sent = [drive.car(BEGIN_S), drive.car(BEGIN_S), drive.car(BEGIN_S - 0.2), wrong, sizeless, early, old]
    said = drive.decide(BEGIN_S, sent).diagnostics
    assert said.messages == Counter(new=1, duplicate=1, late=1, invalid=2, future=1, old=1)
    drive.decide(BEGIN_S + 0.2, [drive.car(BEGIN_S + 0.2)])
    elsewhere = drive.car(BEGIN_S + 0.4)._replace(x=drive.car(BEGIN_S).x + 20.0)
    assert drive.decide(BEGIN_S + 0.4, [elsewhere]).diagnostics.messages == Counter(jumped=1)
    past = drive.arguments[-1]["others_history"][:, 0]  # its own, not the other's
    np.testing.assert_allclose(np.linalg.norm(np.diff(past[:, :2], axis=0), axis=1), SPEED * DT_S, atol=1e-3)


def test_a_lost_object_is_carried_on_and_then_not_seen() -> None:
    drive = Scene()
    drive.decide(BEGIN_S, [drive.car(BEGIN_S)])
    for step in range(1, 5):
        time_s = BEGIN_S + step * DT_S
        said = drive.decide(time_s, []).diagnostics
        assert said.carried_on == (("car 1",) if 1 < step <= 3 else ())
        assert said.lost == (("car 1",) if step > 3 else ())
        x, y = drive.street.to_street(np.array(drive.car(time_s)[2:5]))[:2]
        expected = [x, y] if step <= 3 else [0.0, 0.0]
        np.testing.assert_allclose(drive.arguments[-1]["others"][0, :2], expected, atol=1e-3)


@pytest.mark.parametrize(("before", "n_seen", "step_m"), [("driven", 16.0, SPEED * DT_S), ("unknown", 1.0, 0.0)])
def test_the_past_of_who_is_there_at_first_and_of_who_comes_later(before: Before, n_seen: float, step_m: float) -> None:
    drive = Scene()
    drive.runtime.settings = drive.runtime._tracks._settings = replace(drive.runtime.settings, before=before)
    drive.decide(BEGIN_S, [drive.car(BEGIN_S)])
    assert drive.arguments[-1]["is_seen"].sum(0).tolist() == [16.0] + [0.0] * 7
    assert np.ptp(drive.arguments[-1]["others_history"][:, 0], axis=0).max() == 0
    drive.decide(BEGIN_S + DT_S, [drive.car(BEGIN_S + DT_S)._replace(id="unknown")])
    assert drive.arguments[-1]["is_seen"].sum(0).tolist() == [16.0, n_seen] + [0.0] * 6
    later = drive.arguments[-1]["others_history"][2:, 1, :2]
    np.testing.assert_allclose(np.linalg.norm(np.diff(later, axis=0), axis=1), step_m, atol=1e-3)


def test_of_too_many_objects_the_nearest_count() -> None:
    drive = Scene()
    ego = drive.ego(BEGIN_S)
    sent = [drive.car(BEGIN_S)._replace(id=n, x=ego.x + 5.0 * n, y=ego.y) for n in range(12, 0, -1)]
    assert set(drive.decide(BEGIN_S, sent).diagnostics.left_out) == {9, 10, 11, 12}


@pytest.mark.parametrize("field", ["x", "yaw", "speed", "accel", "desired_speed"])
def test_nan_in_the_state_of_the_ego_is_a_stop_along_the_last_plan(field: str) -> None:
    drive = Scene()
    drive.decide(BEGIN_S)
    stop = drive.decide(BEGIN_S + DT_S, **{field: math.nan})
    assert_stops(stop, "ego_state")
    ego = drive.ego(BEGIN_S + DT_S)
    np.testing.assert_allclose(stop.states[0, :2], [ego.x, ego.y], atol=1e-4)
    assert drive.stop_of(BEGIN_S + 2 * DT_S) == ""


def test_an_old_state_of_the_ego_is_carried_on_for_a_while() -> None:
    drive = Scene()
    drive.decide(BEGIN_S)
    late = drive.runtime.decide(drive.ego(BEGIN_S), (), drive.street, BEGIN_S + 0.3)
    np.testing.assert_allclose(late.states[0, :2], drive.ego(BEGIN_S + 0.3)[1:3], atol=1e-4)
    assert_stops(drive.runtime.decide(drive.ego(BEGIN_S), (), drive.street, BEGIN_S + 0.8), "ego_state")
    assert_stops(drive.runtime.decide(None, (), drive.street, BEGIN_S + 1.0), "ego_state")


def test_without_any_state_there_is_nothing_to_stop() -> None:
    with pytest.raises(UserError, match="ego must be a finite state"):
        Scene().decide(BEGIN_S, x=math.nan)


def test_silence_about_the_others_is_a_stop() -> None:
    drive = Scene()
    said = [drive.decide(BEGIN_S + step * DT_S, None).diagnostics.stop for step in range(6)]
    assert said == ["", "", "", "", "objects", "objects"]


def test_a_clock_that_goes_backwards_is_a_stop() -> None:
    drive = Scene()
    for step in range(4):
        drive.decide(BEGIN_S + step * DT_S, [drive.car(BEGIN_S + step * DT_S)])
    assert_stops(drive.decide(BEGIN_S - 1.0), "clock")
    after = drive.decide(BEGIN_S - 1.0 + DT_S)
    assert after.diagnostics.stop == ""
    assert drive.arguments[-1]["is_seen"].sum() == 0


def test_a_jump_of_the_clock_ahead_drops_the_plan() -> None:
    drive = Scene()
    drive.decide(BEGIN_S)
    assert drive.decide(BEGIN_S + 0.2).diagnostics.start == "plan"
    said = drive.decide(BEGIN_S + 5.0).diagnostics
    assert (said.start, said.is_restarted, said.stop) == ("measured", True, "")
    with pytest.raises(UserError, match="time_s must be a finite number"):
        drive.decide(math.nan)


def test_an_ego_that_jumps_or_leaves_its_plan_plans_anew() -> None:
    drive = Scene()
    drive.decide(BEGIN_S)
    aside = drive.ego(BEGIN_S + 0.2).x + 1.5
    said = drive.decide(BEGIN_S + 0.2, x=aside)
    assert (said.diagnostics.start, said.diagnostics.is_restarted) == ("measured", False)
    assert said.states[0, 0] == pytest.approx(aside)
    jumped = drive.decide(BEGIN_S + 0.4, x=drive.ego(BEGIN_S + 0.4).x + 6.0).diagnostics
    assert (jumped.start, jumped.is_restarted) == ("measured", True)
    past = drive.arguments[-1]["own_history"]
    np.testing.assert_array_equal(past, np.tile(past[0], (16, 1)))


def test_an_ego_off_the_street_stops() -> None:
    drive = Scene()
    assert_stops(drive.decide(BEGIN_S, x=drive.ego(BEGIN_S).x + 900.0), "off_street")


def test_nan_in_a_decision_is_a_stop() -> None:
    drive = Scene()
    drive.decide(BEGIN_S)
    drive.answer = lambda arguments: {**straight_on(arguments), "trajectory": np.full((30, 6), np.nan)}
    assert_stops(drive.decide(BEGIN_S + DT_S), "decision")


@pytest.mark.parametrize("rate_hz", [2, 3, 10, 20])
def test_odd_rates_give_the_same_past(rate_hz: int) -> None:
    drive = Scene()
    for step in range(4 * rate_hz):
        time_s = BEGIN_S - 2.0 + step / rate_hz
        assert drive.decide(time_s, [drive.car(time_s)]).diagnostics.stop == ""
    past = drive.arguments[-1]["own_history"]
    steps = np.linalg.norm(np.diff(past[:6, :2], axis=0), axis=1)
    np.testing.assert_allclose(steps, SPEED * DT_S, atol=1e-3)
    np.testing.assert_allclose(drive.arguments[-1]["others"][0, 3:5], [SPEED, 0.0], atol=1e-3)


def test_a_drive_with_lossy_messages_arrives() -> None:
    """All but the first message: a third lost, the rest up to 0.4 s late, out of order and some twice."""
    rng = np.random.default_rng(3)
    waiting: list[tuple[float, ObjectState]] = []

    def lossy(time_s: float, sent: list[ObjectState]) -> list[ObjectState]:
        if time_s == BEGIN_S:
            return sent
        for message in sent:
            copies = rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])
            waiting.extend((time_s + rng.choice([0.0, 0.2, 0.4]), message) for _ in range(copies))
        due = [message for at, message in waiting if at <= time_s + 1e-6]
        waiting[:] = [(at, message) for at, message in waiting if at > time_s + 1e-6]
        rng.shuffle(due)  # type: ignore[arg-type]
        return due

    worlds, said = drive_with_runtime(negotiator(), 30, seed=0, lossy=lossy)
    words = sum((Counter(each.diagnostics.messages) for each in said), Counter())
    assert set(words) == {"new", "late", "duplicate"}
    assert not collided(worlds)
    assert np.linalg.norm(places(worlds)[-1, 0] - places(worlds)[0, 0]) > 5.0


def collided(worlds: list[World]) -> bool:
    return bool(worlds[-1].has_collided.any())
