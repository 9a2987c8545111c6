"""What is said of failed episodes, of drives placed by hand."""

import numpy as np
import pytest
from hand_driven import drive

from negopipe.evaluation.failures import failures


@pytest.mark.parametrize(
    ("x", "speed", "yaw", "cause"),
    [
        ((0.0, 3.9), (2.0, 0.0), (0.0, np.pi), "the ego drove into an oncoming vehicle at rest"),
        ((0.0, 3.9), (0.0, 2.0), (0.0, np.pi), "an oncoming vehicle drove into the ego at rest"),
        ((0.0, 3.9), (2.0, 2.0), (0.0, np.pi), "the ego and an oncoming vehicle drove into each other"),
        ((0.0, 3.9), (-1.0, 2.0), (0.0, np.pi), "an oncoming vehicle drove into the ego as it drove back"),
        ((0.0, -3.9), (-1.0, 2.0), (0.0, 0.0), "the ego and a vehicle behind drove into each other"),
        ((0.0, 3.9), (0.0, 0.2), (0.0, np.pi), "the ego and an oncoming vehicle touched at rest"),
        ((0.0, -3.9), (0.0, 1.0), (0.0, 0.0), "a vehicle behind drove into the ego at rest"),
        ((0.0, 3.9), (1.0, 0.0), (0.0, 0.1), "the ego drove into a vehicle ahead at rest"),
        ((0.0, 3.9), (-1.0, 0.0), (np.pi, 0.1), "the ego drove into an oncoming vehicle at rest"),
        ((0.0, 9.0, -3.9), (1.0, 4.0, 0.0), (0.0, np.pi, 0.0), "the ego drove into a vehicle behind at rest"),
        ((0.0, 9.0), (1.0, 4.0), (0.0, np.pi), "touched a kerb or a parked car"),
    ],
)
def test_a_collision_is_told_by_whom_the_ego_touches_and_who_drove(
    x: tuple[float, ...], speed: tuple[float, ...], yaw: tuple[float, ...], cause: str
) -> None:
    assert failures(drive("collision", x, speed, yaw)) == [(0, "collision", cause)]


def test_other_failures_are_told_by_where_the_ego_is() -> None:
    here, there, ways = (0.0, 9.0, -8.0), (0.0, 0.0, 0.0), (0.0, np.pi, 0.0)
    followed = "nose to nose at rest, a vehicle close behind the ego"
    assert failures(drive("deadlock", here, there, ways)) == [(0, "deadlock", followed)]
    assert failures(drive("deadlock", here[:2], there[:2], ways[:2]))[0].cause == "nose to nose at rest"
    assert failures(drive("deadlock", (0.0, 9.0, -18.0), there, ways))[0].cause == "nose to nose at rest"
    for x, place in ((-3.0, "before"), (3.0, "in"), (13.0, "behind")):
        assert (
            failures(drive("timeout", (x, 30.0), (0.0, 0.0), (0.0, np.pi)))[0].cause
            == f"the ego stood {place} the corridor"
        )
    assert failures(drive("timeout", (-3.0, 30.0), (1.0, 0.0), (0.0, np.pi)))[0].cause.startswith(
        "the ego drove before"
    )
    arrived = drive("timeout", (30.0, -30.0), (5.0, 0.0), (0.0, np.pi), reached_step=np.array([[1, -1]]))
    assert failures(arrived)[0].cause == "the ego arrived, another vehicle did not"
    assert failures(drive("social_collision", here, there, ways))[0].cause == "two others collided"
    assert failures(drive("success", here, there, ways)) == []
