"""The past at the exported rate, from messages that are late, lost, twice there or of an odd rate."""

from itertools import pairwise

import numpy as np
import pytest

from negopipe.deployment.history import History, Pose

GAP_S = 0.6
WANTED_S = 4.0 - 0.2 * np.arange(11)


def driving(time_s: float) -> Pose:
    """A vehicle at 5 m/s that turns through the jump of the heading at pi."""
    return Pose(5.0 * time_s, 0.0, (3.0 + 0.1 * time_s + np.pi) % (2 * np.pi) - np.pi, 5.0)


def filled(times_s: np.ndarray) -> History:
    history = History(keep_s=5.0, gap_s=GAP_S)
    for time_s in times_s:
        history.add(float(time_s), driving(float(time_s)))
    return history


@pytest.mark.parametrize("rate_hz", [2, 3, 5, 7, 10, 20])
def test_any_rate_gives_the_same_past(rate_hz: int) -> None:
    poses, known = filled(np.arange(0, 4.2, 1 / rate_hz)).at(WANTED_S, "unknown")
    assert known.all()
    np.testing.assert_allclose(poses[:, 0], 5.0 * WANTED_S, atol=1e-6)
    heading = np.array([driving(time_s).yaw for time_s in WANTED_S])
    np.testing.assert_allclose(np.cos(poses[:, 2] - heading), 1.0, atol=1e-3)


def test_order_and_twins_do_not_matter() -> None:
    times_s = np.arange(0, 4.2, 0.2)
    shuffled = np.random.default_rng(1).permutation(np.concatenate([times_s, times_s[3:9]]))
    np.testing.assert_array_equal(
        filled(shuffled).at(WANTED_S, "unknown")[0], filled(times_s).at(WANTED_S, "unknown")[0]
    )


def test_a_twin_is_not_new() -> None:
    history = filled(np.arange(3.0))
    assert not history.add(1.0, driving(1.0))
    assert history.add(1.5, driving(1.5))


def test_what_is_lost_for_long_is_unknown() -> None:
    times_s = np.array([*np.arange(0, 2.01, 0.2), *np.arange(3.0, 4.01, 0.2)])
    _, known = filled(times_s).at(WANTED_S, "unknown")
    assert known.tolist() == [not 2.01 < time_s < 2.99 for time_s in WANTED_S.tolist()]


def test_the_last_pose_is_carried_on_for_a_while_only() -> None:
    history = filled(np.arange(0, 2.01, 0.2))
    poses, known = history.at(np.array([2.0 + GAP_S, 2.1 + GAP_S]), "unknown")
    assert known.tolist() == [True, False]
    assert np.hypot(poses[0, 0] - 10.0, poses[0, 1]) == pytest.approx(5.0 * GAP_S)


def test_before_the_first_message_nothing_is_known_unless_it_is_assumed() -> None:
    history, before = filled(np.array([1.0, 1.2])), np.array([0.9])
    assert not history.at(before, "unknown")[1].any()
    np.testing.assert_allclose(history.at(before, "stood")[0][0], driving(1.0))
    first, poses = driving(1.0), history.at(before, "driven")[0]
    np.testing.assert_allclose(poses[0, :2], [first.x - 0.5 * np.cos(first.yaw), -0.5 * np.sin(first.yaw)])


def test_old_messages_are_forgotten() -> None:
    history = filled(np.arange(0, 100, 0.1))
    assert len(history) == pytest.approx((5.0 + GAP_S) / 0.1, abs=2)
    assert all(a < b for a, b in pairwise(history._times))
