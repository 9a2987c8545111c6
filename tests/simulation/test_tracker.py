"""The tracker: the textbook's filter, vehicles carried on while they are not seen, smaller errors than the sensor's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import compose_config
from games import MIXTURE, draw_tasks
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import Game, build_game
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.perception import PerceptionConfig
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Estimate, Sightings, Tracks, World
from negopipe.simulation.tracker import Tracker, TrackerConfig, predict, update
from negopipe.tensors.tree import map_tensors, tensors
from negopipe.tracking.checkpoint import load_checkpoint, save_checkpoint

TRACKER = TrackerConfig(1.0, 2.0, 0.05)
TRACKED = PerceptionConfig(0.1, 0.02, 0.2, 0.02, 60.0, 0.2, 0.4, TRACKER, False)
EXACT = PerceptionConfig(0.0, 0.0, 0.0, 0.0, None, 0.0, 0.4, TRACKER, False)
VARIANCES = (0.01, 0.0004, 0.04)
DT_S = 0.2


def with_perception(config: RunConfig, perception: PerceptionConfig) -> Game:
    return build_game(replace(config, perception=perception))


def drive(game: Game, world: World, n_steps: int) -> list[World]:
    """Everyone drives with 6 s of prediction; the worlds from the start on."""
    worlds = [world]
    for _ in range(n_steps):
        worlds.append(game.drive(worlds[-1], torch.full_like(world.task.direction, 6.0))[0])
    return worlds


def sightings(pose: Tensor, speed: Tensor, is_seen: Tensor) -> Sightings:
    """J = 1, V = 1, O = 1, of poses [E, 3]."""
    return Sightings(pose[:, None, None, None], speed[:, None, None, None], is_seen[:, None, None, None])


def track(tracker: Tracker, pose: Tensor, speed: Tensor, is_seen: Tensor) -> list[Tracks]:
    """Tracks after each of T sightings without delay, of poses [T, E, 3]."""
    no_age, is_new = torch.zeros_like(speed[0]), torch.ones_like(is_seen[0])
    tracks = [tracker.start(sightings(pose[0], speed[0], is_seen[0]), no_age, 4)]
    for step in range(1, len(pose)):
        latest = sightings(pose[step], speed[step], is_seen[step])
        tracks.append(tracker.follow(tracks[-1], latest, is_new, no_age))
    return tracks


class Textbook:
    """A Kalman filter in matrices, numpy float64: x = F x, P = F P F' + Q; K = P H' S^-1, x += K y, P = (I - K H) P."""

    def __init__(self, z: np.ndarray, noise: np.ndarray, transition: np.ndarray) -> None:
        self.x, self.p, self.noise, self.transition = z, noise, noise, transition

    def predict(self, process_noise: np.ndarray) -> None:
        self.x = self.transition @ self.x
        self.p = self.transition @ self.p @ self.transition.T + process_noise

    def update(self, z: np.ndarray) -> None:
        gain = self.p @ np.linalg.inv(self.p + self.noise)
        self.x = self.x + gain @ (z - self.x)
        self.p = (np.eye(len(z)) - gain) @ self.p


def of_motion(pose: np.ndarray, speed: float) -> np.ndarray:
    """x, velocity along x, y, velocity along y."""
    return np.array([pose[0], speed * np.cos(pose[2]), pose[1], speed * np.sin(pose[2])])


def test_the_filter_is_the_textbooks() -> None:
    random = np.random.default_rng(0)
    n_steps, n_worlds = 60, 8
    pose = random.normal(0, 0.5, (n_steps, n_worlds, 3)).cumsum(0)
    pose[..., 2] = random.normal(0, 0.3, (n_steps, n_worlds))
    speed, is_seen = random.uniform(-0.5, 8, (n_steps, n_worlds)), random.uniform(size=(n_steps, n_worlds)) > 0.2
    is_seen[0] = True
    tracker = Tracker(replace(TRACKER, forget_after_s=100.0), DT_S, VARIANCES)
    tracks = track(tracker, torch.tensor(pose), torch.tensor(speed), torch.tensor(is_seen))
    axis = np.array([[1, DT_S], [0, 1]])
    power = TRACKER.accel_std_mps2**2 * DT_S
    noise = power * np.array([[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]])
    for e in range(n_worlds):
        motion = Textbook(
            of_motion(pose[0, e], speed[0, e]), np.diag([0.01, 0.04, 0.01, 0.04]), np.kron(np.eye(2), axis)
        )
        heading = Textbook(pose[0, e, 2:], np.array([[0.0004]]), np.eye(1))
        for step in range(1, n_steps):
            driven = DT_S * np.hypot(motion.x[1], motion.x[3])
            heading.predict(np.array([[(TRACKER.curvature_std_1pm * driven) ** 2]]))
            motion.predict(np.kron(np.eye(2), noise))
            if is_seen[step, e]:
                heading.update(pose[step, e, 2:])
                motion.update(of_motion(pose[step, e], speed[step, e]))
            found = map_tensors(lambda field, e=e: field[e, 0, 0], tracks[step].estimate)
            np.testing.assert_allclose(found.position, motion.x[[0, 2]], rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.velocity, motion.x[[1, 3]], rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.yaw, heading.x[0], rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.yaw_variance, heading.p[0, 0], rtol=1e-9)
            for first in (0, 2):
                block = motion.p[first : first + 2, first : first + 2]
                np.testing.assert_allclose(found.covariance, block[[0, 0, 1], [0, 1, 1]], rtol=1e-9)
            assert np.abs(motion.p[:2, 2:]).max() == 0  # the axes are independent


def test_headings_are_averaged_across_the_turn() -> None:
    half = torch.tensor([0.5])
    here = Estimate(torch.zeros(1, 2), torch.zeros(1, 2), torch.tensor([[1.0, 0.0, 1.0]]), torch.tensor([3.1]), half)
    met = update(here, replace(here, yaw=torch.tensor([-3.1])))
    assert float(wrap_angle(met.yaw - torch.pi).abs()) < 1e-5
    assert float(met.yaw_variance) == 0.25


def test_a_sensor_without_errors_and_no_process_noise_stay_finite() -> None:
    exact = Tracker(replace(TRACKER, accel_std_mps2=1e-12, forget_after_s=1e30), DT_S, (0.0, 0.0, 0.0))
    pose, speed, is_seen = torch.zeros(5, 1, 3), torch.zeros(5, 1), torch.ones(5, 1, dtype=torch.bool)
    last = track(exact, pose, speed, is_seen)[-1]
    assert all(field.isfinite().all() for field in tensors(last.estimate))
    assert last.history.is_seen.all()


def test_only_a_vehicle_that_drives_turns() -> None:
    one = torch.tensor([0.0])
    still = Estimate(torch.zeros(1, 2), torch.zeros(1, 2), torch.zeros(1, 3), one, one)
    assert float(predict(still, DT_S, 2.0, 0.05).yaw_variance) == 0
    driving = replace(still, velocity=torch.tensor([[3.0, 4.0]]))
    assert float(predict(driving, DT_S, 2.0, 0.05).yaw_variance) == pytest.approx((0.05 * 5 * DT_S) ** 2)
    assert predict(driving, DT_S, 2.0, 0.05).position.tolist() == [[pytest.approx(0.6), pytest.approx(0.8)]]


@pytest.mark.parametrize("forget_after_s", [0.0, 0.4, 1.0])
def test_a_vehicle_is_carried_on_until_it_is_forgotten(forget_after_s: float) -> None:
    """It drives at 5 m/s along x, is seen for 2 s, then not for 3 s, then once, 100 m away."""
    n_seen, n_missed, n_carried = 10, 15, round(forget_after_s / DT_S)
    x = torch.arange(n_seen + n_missed + 1) * 5.0 * DT_S
    x[-1] += 100
    is_seen = (torch.arange(len(x)) < n_seen) | (torch.arange(len(x)) == len(x) - 1)
    pose = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], -1)[:, None]
    tracker = Tracker(replace(TRACKER, forget_after_s=forget_after_s), DT_S, VARIANCES)
    tracks = track(tracker, pose * is_seen[:, None, None], 5.0 * is_seen[:, None], is_seen[:, None])
    for step, now in enumerate(tracks):
        is_tracked = step < n_seen + n_carried or step == len(x) - 1
        assert bool(now.history.is_seen[0, 0, 0, 0]) == is_tracked
        expected = [float(x[step]), 0.0, 0.0] if is_tracked else [0.0, 0.0, 0.0]
        assert now.history.pose[0, 0, 0, 0].tolist() == pytest.approx(expected, abs=1e-4)
        assert float(now.history.speed[0, 0, 0, 0]) == pytest.approx(5.0 * is_tracked, abs=1e-4)
    assert tracks[-1].history.is_seen[0, 1:, 0, 0].any() == (forget_after_s > n_missed * DT_S)


def errors(game: Game, worlds: list[World]) -> Tensor:
    """[N, 4]: errors of x, y, yaw, speed in all worlds, of those that are seen."""
    rows = []
    for world in worlds:
        seen, true = game.perceive(world), map_tensors(lambda field: field.flip(1), world.vehicles)
        position = seen.other.position[:, :, 0] - true.position
        yaw, speed = wrap_angle(seen.other.yaw[..., 0] - true.yaw), seen.other.speed[..., 0] - true.speed
        rows.append(torch.stack([*position.unbind(-1), yaw, speed], -1)[seen.is_seen[..., 0]])
    return torch.cat(rows)


def rms(values: Tensor) -> list[float]:
    return values.square().mean(0).sqrt().tolist()


def test_errors_are_smaller_than_the_sensors(config: RunConfig) -> None:
    sharp = replace(TRACKED, delay_s=0.0)
    raw, tracked = (with_perception(config, perception) for perception in (replace(sharp, tracker=None), sharp))
    tasks = draw_tasks(config, 64)
    x, y, yaw, speed = rms(errors(tracked, drive(tracked, tracked.simulator.reset(tasks), 40)))
    raw_x, raw_y, raw_yaw, raw_speed = rms(errors(raw, drive(raw, raw.simulator.reset(tasks), 40)))
    assert x < 0.75 * raw_x
    assert y < 0.75 * raw_y
    assert yaw < raw_yaw
    assert speed < raw_speed


def test_the_delay_is_made_up_for(config: RunConfig) -> None:
    late = replace(TRACKED, delay_s=0.4)
    raw, tracked = (with_perception(config, perception) for perception in (replace(late, tracker=None), late))
    tasks = draw_tasks(config, 64)
    x, *_ = rms(errors(tracked, drive(tracked, tracked.simulator.reset(tasks), 40)))
    raw_x, *_ = rms(errors(raw, drive(raw, raw.simulator.reset(tasks), 40)))
    assert x < 0.25 * raw_x


@pytest.mark.parametrize("delay_s", [0.0, 0.2, 0.6])
def test_a_steady_vehicle_is_where_it_is_from_the_start(config: RunConfig, delay_s: float) -> None:
    game = with_perception(config, replace(EXACT, delay_s=delay_s))
    world = game.simulator.reset(draw_tasks(config, 4))
    for _ in range(12):
        vehicles = world.vehicles
        ahead = torch.stack([vehicles.speed * vehicles.yaw.cos(), vehicles.speed * vehicles.yaw.sin()], -1)
        seen = game.perceive(world)
        torch.testing.assert_close(seen.other.position[:, :, 0], vehicles.position.flip(1), atol=1e-4, rtol=0)
        torch.testing.assert_close(seen.other.speed[..., 0], vehicles.speed.flip(1), atol=1e-4, rtol=0)
        steady = replace(vehicles, position=vehicles.position + DT_S * ahead)
        world = game.simulator.step(world, steady)[0]


def test_without_errors_the_track_is_the_truth(config: RunConfig) -> None:
    game = with_perception(config, EXACT)
    for world in drive(game, game.simulator.reset(draw_tasks(config, 4)), 30):
        seen = game.perceive(world)
        torch.testing.assert_close(seen.other.position[:, :, 0], world.vehicles.position.flip(1), atol=1e-4, rtol=0)
        torch.testing.assert_close(seen.other.speed[..., 0], world.vehicles.speed.flip(1), atol=1e-4, rtol=0)
        off = wrap_angle(seen.other.yaw[..., 0] - world.vehicles.yaw.flip(1))
        assert float(off.abs().max()) < 1e-5


def test_a_standing_vehicle_neither_creeps_nor_spins() -> None:
    """It stands for 20 s, in 500 worlds, and is then not seen for 1 s."""
    random = torch.Generator().manual_seed(0)
    n_steps, n_missed, n_worlds = 100, 5, 500
    stds = torch.tensor(VARIANCES).sqrt()[[0, 0, 1]]
    pose = torch.randn(n_steps, n_worlds, 3, generator=random) * stds
    speed = torch.randn(n_steps, n_worlds, generator=random) * VARIANCES[2] ** 0.5
    is_seen = (torch.arange(n_steps) < n_steps - n_missed)[:, None].expand(-1, n_worlds)
    tracks = track(Tracker(TRACKER, DT_S, VARIANCES), pose, speed, is_seen)
    seen, missed = tracks[n_steps - n_missed - 1].history, tracks[-1].history
    x, y, yaw = seen.pose[:, 0, 0, 0].std(0).tolist()
    assert max(x, y) < 0.075  # of 0.1 m
    assert yaw < 0.005  # of 0.02 rad
    assert float(seen.speed[:, 0].mean()) < 0.08
    carried = missed.pose[:, 0, 0, 0] - seen.pose[:, 0, 0, 0]
    assert float(carried[:, :2].mean(0).norm()) < 0.02
    assert rms(carried)[0] < 0.2
    assert not carried[:, 2].any()


def test_a_quick_filter_follows_a_hard_braking_sooner() -> None:
    speed = torch.cat([torch.full((10,), 6.0), 6.0 - 0.8 * torch.arange(1, 6)])
    x = (speed * DT_S).cumsum(0)
    pose = torch.stack([x, 0 * x, 0 * x], -1)[:, None]
    is_seen = torch.ones(len(x), 1, dtype=torch.bool)
    trackers = (Tracker(replace(TRACKER, accel_std_mps2=std), DT_S, VARIANCES) for std in (0.3, 1.0, 3.0))
    seen = [float(track(tracker, pose, speed[:, None], is_seen)[-1].history.speed[0, 0, 0, 0]) for tracker in trackers]
    assert seen[0] > seen[1] > seen[2] > 2.0


def test_a_track_that_may_turn_follows_a_bend_sooner() -> None:
    yaw = torch.cat([torch.zeros(10), 0.05 * torch.arange(1, 6)])
    pose = torch.stack([0 * yaw, 0 * yaw, yaw], -1)[:, None]
    speed, is_seen = torch.full((len(yaw), 1), 5.0), torch.ones(len(yaw), 1, dtype=torch.bool)
    trackers = (Tracker(replace(TRACKER, curvature_std_1pm=std), DT_S, VARIANCES) for std in (0.01, 0.05, 0.2))
    lags = [0.25 - float(track(tracker, pose, speed, is_seen)[-1].history.pose[0, 0, 0, 0, 2]) for tracker in trackers]
    assert lags[0] > lags[1] > lags[2] > 0


def test_a_missed_sighting_makes_nobody_vanish(config: RunConfig) -> None:
    gaps = replace(TRACKED, dropout_probability=0.3, range_m=None)
    game = with_perception(config, replace(gaps, tracker=replace(TRACKER, forget_after_s=3.0)))
    worlds = drive(game, game.simulator.reset(draw_tasks(config, 64)), 30)
    is_seen = torch.stack([game.perceive(world).is_seen for world in worlds])
    assert bool((is_seen[0]).any())
    first = is_seen.long().argmax(0)
    is_after = torch.arange(len(worlds))[:, None, None, None] >= first
    assert is_seen[is_after].all()  # whoever has been seen once stays
    assert rms(errors(game, worlds[5:]))[0] < 0.3


def test_the_past_is_what_was_known_then(three_social_config: RunConfig) -> None:
    game = with_perception(three_social_config, replace(TRACKED, dropout_probability=0.2))
    worlds = drive(game, game.simulator.reset(draw_tasks(three_social_config, 8)), 20)
    for late, ago in ((20, 5), (20, 15), (7, 3), (3, 3)):
        now, then = game.perceive(worlds[late]), game.perceive(worlds[late - ago])
        assert torch.equal(now.other_history[:, ago], then.other_history[:, 0])
        assert torch.equal(now.is_seen_history[:, ago], then.is_seen)
        assert torch.equal(now.other_history[:, 0, ..., :2], now.other.position)  # list and grids alike
    gained = game.perceive(worlds[20]).other.speed - game.perceive(worlds[18]).other.speed
    is_seen = game.perceive(worlds[20]).is_seen & game.perceive(worlds[18]).is_seen
    accel = torch.where(is_seen, gained / 0.4, 0.0)
    torch.testing.assert_close(game.perceive(worlds[20]).other.accel, accel, atol=1e-5, rtol=0)


def test_a_batch_equals_single_worlds(three_social_config: RunConfig) -> None:
    game = with_perception(three_social_config, TRACKED)
    tasks = draw_tasks(three_social_config, 3)
    together = drive(game, game.simulator.reset(tasks), 12)[-1]
    for e in range(3):
        task = map_tensors(lambda field, e=e: field[e : e + 1], tasks)
        alone = drive(game, game.simulator.reset(task), 12)[-1]
        for one, many in zip(tensors(alone), tensors(together), strict=True):
            # float32 products of matrices of another size: their last digits differ on some processors
            torch.testing.assert_close(one[0], many[e], atol=1e-4, rtol=1e-4, equal_nan=True)


def test_without_a_tracker_a_world_holds_nothing_of_it(config: RunConfig, game: Game) -> None:
    world = drive(game, game.simulator.reset(draw_tasks(config, 2)), 2)[-1]
    assert all(field.numel() == 0 and len(field) == 2 for field in tensors(world.tracks))


def test_placed_vehicles_are_seen_where_they_are(config: RunConfig) -> None:
    game = with_perception(config, replace(TRACKED, dropout_probability=0.0))
    world = drive(game, game.simulator.reset(draw_tasks(config, 16)), 5)[-1]
    there = replace(world.vehicles, position=world.vehicles.position + 20.0, speed=0 * world.vehicles.speed)
    placed = game.simulator.place(world, there)
    assert torch.equal(placed.pose_history[:, 3, :, :2], there.position)
    assert float(errors(game, [placed])[:, :2].abs().max()) < 0.6


@pytest.mark.parametrize("tracker", [TRACKER, None])
def test_a_saved_environment_goes_on_the_same(config: RunConfig, tracker: TrackerConfig | None, tmp_path: Path) -> None:
    game = with_perception(config, replace(TRACKED, tracker=tracker))
    first, second = (
        NegotiationEnv(
            game,
            config.reward,
            (0.0, 6.0),
            TaskSampler(config.scenario, MIXTURE, torch.Generator().manual_seed(seed)),
            4,
        )
        for seed in (1, 2)
    )
    action = torch.tensor([0, 1, 0, 1])
    for _ in range(10):
        first.step(action)
    save_checkpoint(tmp_path / "env.safetensors", first.state_dict(), {})
    second.load_state_dict(load_checkpoint(tmp_path / "env.safetensors")[0])
    for _ in range(5):
        assert torch.equal(first.step(action).observation, second.step(action).observation)
    for one, other in zip(tensors(first.world), tensors(second.world), strict=True):
        assert torch.equal(one.nan_to_num(), other.nan_to_num())


@pytest.mark.slow
def test_compiled_tracks_the_same(config: RunConfig) -> None:
    tracked = replace(config, perception=TRACKED)
    eager, compiled = build_game(tracked), build_game(tracked, is_compiled=True)
    world = eager.simulator.reset(draw_tasks(config, 8))
    a, b = drive(eager, world, 10)[-1].tracks, drive(compiled, world, 10)[-1].tracks
    assert torch.equal(a.n_missed, b.n_missed)
    torch.testing.assert_close(a.history.pose, b.history.pose, atol=1e-3, rtol=0)
    torch.testing.assert_close(a.history.speed, b.history.speed, atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "perception.tracker.forget_after_s=0.5",
            "perception.tracker.forget_after_s must be a multiple of scenario.dt_s = 0.2, got 0.5",
        ),
        ("perception.tracker.forget_after_s=-1", "perception.tracker.forget_after_s"),
        ("perception.tracker.accel_std_mps2=0", "perception.tracker.accel_std_mps2"),
        ("perception.tracker.curvature_std_1pm=a", "perception.tracker.curvature_std_1pm"),
        ("perception.tracker=kalman", "perception.tracker"),
    ],
)
def test_wrong_values_are_named(override: str, message: str) -> None:
    with pytest.raises(UserError, match=r"perception\.tracker") as error:
        compose_config(["+experiment=mixture", "perception=noisy", override])
    assert message in str(error.value)
    assert "\n" not in str(error.value)
