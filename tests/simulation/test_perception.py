"""What is seen of others: exact, late, with errors that stay what they were, or not at all."""

from dataclasses import replace

import pytest
import torch
from games import draw_tasks, place

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.build_road import build_road
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.perception import PerceptionConfig, Sensor
from negopipe.simulation.state import EGO, VehicleState, World
from negopipe.tensors.tree import map_tensors

PERFECT = PerceptionConfig(0.0, 0.0, 0.0, 0.0, None, 0.0, 0.4, None, False)
NOISY = PerceptionConfig(0.1, 0.02, 0.2, 0.1, 60.0, 0.4, 0.4, None, False)


def seen_by(config: RunConfig, perception: PerceptionConfig) -> Game:
    return build_game(replace(config, perception=perception))


def drive(game: Game, world: World, n_steps: int) -> list[World]:
    """Everyone drives with 6 s of prediction; the worlds from the start on."""
    worlds = [world]
    for _ in range(n_steps):
        motion = game.plan(game.perceive(worlds[-1]), torch.full_like(world.task.direction, 6.0))
        worlds.append(game.simulator.step(worlds[-1], motion.state)[0])
    return worlds


def test_perfect_is_the_truth(config: RunConfig, game: Game) -> None:
    world = drive(game, game.simulator.reset(draw_tasks(config, 3)), 8)[-1]
    seen = game.perceive(world)
    assert seen.is_seen.all()
    assert seen.is_seen_history.all()
    torch.testing.assert_close(seen.other.position[:, 0, 0], world.vehicles.position[:, 1], atol=0, rtol=0)
    torch.testing.assert_close(seen.other.speed[:, 1, 0], world.vehicles.speed[:, 0], atol=0, rtol=0)
    torch.testing.assert_close(seen.other_history[:, :, 0, 0], world.pose_history[:, :, 1], atol=0, rtol=0)
    assert not seen.other.curvature.any()


@pytest.mark.parametrize(("window_s", "steps"), [(0.2, 1), (0.4, 2), (1.0, 5)])
def test_acceleration_is_a_difference_of_speeds(config: RunConfig, window_s: float, steps: int) -> None:
    game = seen_by(config, replace(PERFECT, accel_window_s=window_s))
    worlds = drive(game, game.simulator.reset(draw_tasks(config, 2)), 9)
    gained = worlds[-1].vehicles.speed - worlds[-1 - steps].vehicles.speed
    accel = game.perceive(worlds[-1]).other.accel[..., 0]
    torch.testing.assert_close(accel, gained.flip(1) / window_s, atol=1e-5, rtol=1e-4)


def test_delay_shows_the_past(config: RunConfig) -> None:
    game = seen_by(config, replace(PERFECT, delay_s=0.6))
    worlds = drive(game, game.simulator.reset(draw_tasks(config, 2)), 20)
    seen = game.perceive(worlds[-1])
    then = worlds[-4]
    torch.testing.assert_close(seen.other.position[:, 0, 0], then.vehicles.position[:, 1])
    torch.testing.assert_close(seen.other.speed[:, 0, 0], then.vehicles.speed[:, 1])
    torch.testing.assert_close(seen.own.position, worlds[-1].vehicles.position)
    torch.testing.assert_close(seen.own_history[:, 0], worlds[-1].pose_history[:, 0])
    for ago in (0, 5, 15):
        torch.testing.assert_close(seen.other_history[:, ago, 0, 0], worlds[-4 - ago].pose_history[:, 0, 1])
    first = game.perceive(worlds[0])
    torch.testing.assert_close(first.other.position[:, 0, 0], worlds[0].vehicles.position[:, 1])


def test_a_sighting_stays_what_it_was(config: RunConfig) -> None:
    game = seen_by(config, NOISY)
    worlds = drive(game, game.simulator.reset(draw_tasks(config, 16)), 20)
    for late, ago in ((20, 5), (20, 15), (7, 3), (3, 3)):
        now, then = game.perceive(worlds[late]), game.perceive(worlds[late - ago])
        assert torch.equal(now.other_history[:, ago], then.other_history[:, 0])
        assert torch.equal(now.is_seen_history[:, ago], then.is_seen)
        assert torch.equal(now.other_history[:, 0, ..., :2], now.other.position)  # list and grids alike


def test_a_batch_equals_single_worlds(three_social_config: RunConfig) -> None:
    game = seen_by(three_social_config, NOISY)
    world = drive(game, game.simulator.reset(draw_tasks(three_social_config, 3)), 5)[-1]
    together = game.perceive(world)
    for e in range(3):
        alone = game.perceive(map_tensors(lambda field, e=e: field[e : e + 1], world))
        assert torch.equal(alone.other_history[0], together.other_history[e])
        assert torch.equal(alone.is_seen_history[0], together.is_seen_history[e])
        assert torch.equal(alone.other.speed[0], together.other.speed[e])


def standing(config: RunConfig, game: Game, n: int) -> World:
    """Many worlds in the same state that differ in their noise seeds only, everyone at 4 m/s."""
    return game.simulator.reset(map_tensors(lambda f: f.expand(n, *f.shape[1:]), draw_tasks(config, 1)))


def with_seeds(world: World) -> World:
    n = len(world.task)
    seeds = torch.randint(2**31, (n,), generator=torch.Generator().manual_seed(0))
    return replace(world, task=replace(world.task, noise_seed=seeds))


def errors(config: RunConfig, perception: PerceptionConfig, n: int = 4000) -> tuple[torch.Tensor, VehicleState]:
    """Errors [n, V, 4] of x, y, yaw, speed, and what was seen."""
    game = seen_by(config, perception)
    world = with_seeds(standing(config, game, n))
    other = game.perceive(world).other
    true = map_tensors(lambda field: field.flip(1), world.vehicles)
    yaw = wrap_angle(other.yaw[..., 0] - true.yaw)
    position = other.position[:, :, 0] - true.position
    return torch.stack([*position.unbind(-1), yaw, other.speed[..., 0] - true.speed], -1), other


@pytest.mark.parametrize(
    ("key", "channels"), [("position_std_m", [0, 1]), ("yaw_std_rad", [2]), ("speed_std_mps", [3])]
)
def test_errors_have_their_spread(config: RunConfig, key: str, channels: list[int]) -> None:
    error, _ = errors(config, replace(PERFECT, **{key: 0.3}))
    for channel in range(4):
        values = error[..., channel].flatten()
        if channel not in channels:
            assert float(values.abs().max()) < 1e-5
            continue
        assert abs(float(values.mean())) < 0.015
        assert abs(float(values.std()) - 0.3) < 0.01
        assert abs(float((values.abs() < 0.3).float().mean()) - 0.683) < 0.02  # as a normal distribution has it
        assert abs(float((values.abs() > 0.6).float().mean()) - 0.0455) < 0.01


def test_errors_are_independent(config: RunConfig) -> None:
    error, _ = errors(config, replace(PERFECT, position_std_m=0.1, yaw_std_rad=0.1, speed_std_mps=0.1))
    columns = error.flatten(1).T  # of both viewers
    off_diagonal = torch.corrcoef(columns) - torch.eye(8)
    assert float(off_diagonal.abs().max()) < 0.06
    game = seen_by(config, replace(PERFECT, position_std_m=0.1))
    world = with_seeds(standing(config, game, 4000))
    history = game.perceive(replace(world, step=torch.full((4000,), 40))).other_history[:, :, 0, 0, 0]
    assert float((torch.corrcoef(history.T) - torch.eye(history.shape[1])).abs().max()) < 0.08


def test_speeds_are_never_negative(config: RunConfig) -> None:
    _, other = errors(config, replace(PERFECT, speed_std_mps=4.0))
    assert float(other.speed.min()) == 0.0


def test_dropped_sightings(config: RunConfig) -> None:
    game = seen_by(config, replace(PERFECT, dropout_probability=0.3))
    world = replace(with_seeds(standing(config, game, 1000)), step=torch.full((1000,), 40))
    seen = game.perceive(world)
    assert abs(float(seen.is_seen_history.float().mean()) - 0.7) < 0.01
    assert not seen.other_history[~seen.is_seen_history].any()
    assert not seen.other.position[~seen.is_seen].any()
    everything = seen_by(config, replace(PERFECT, dropout_probability=1.0)).perceive(world)
    assert not everything.is_seen_history.any()


@pytest.mark.parametrize(("range_m", "sees"), [(39.0, False), (41.0, True)])
def test_range_is_between_centres(config: RunConfig, game: Game, range_m: float, sees: bool) -> None:
    world = game.simulator.reset(draw_tasks(config, 1))
    apart = replace(world.vehicles, position=torch.tensor([[[-20.0, -1.75], [20.0, -1.75]]]))
    seen = seen_by(config, replace(PERFECT, range_m=range_m)).perceive(place(world, apart))
    assert (seen.is_seen == sees).all()
    assert (seen.is_seen_history == sees).all()


def face_to_face(config: RunConfig, game: Game) -> World:
    """The ego drives at 3 m/s towards a vehicle that stands 3.5 m before it in the corridor."""
    world = game.simulator.reset(draw_tasks(config, 1))
    position = torch.tensor([[[-5.5, 0.0], [2.5, 0.0]]])
    return place(world, replace(world.vehicles, position=position, speed=torch.tensor([[3.0, 0.0]])))


def test_the_planner_ignores_whom_it_does_not_see(config: RunConfig, game: Game) -> None:
    world, six = face_to_face(config, game), torch.full((1, 2), 6.0)
    blind = game.plan(game.perceive(world), six * 0).state.accel[0, EGO]
    seeing = game.plan(game.perceive(world), six).state.accel[0, EGO]
    assert float(seeing) < -0.5 < float(blind)
    seen = game.perceive(world)
    not_seen = replace(seen, is_seen=torch.zeros_like(seen.is_seen))
    assert torch.equal(game.plan(not_seen, six).state.accel[0, EGO], blind)
    short = seen_by(config, replace(PERFECT, range_m=7.0))
    assert torch.equal(short.plan(short.perceive(world), six).state.accel[0, EGO], blind)


def test_the_grid_does_not_show_who_is_not_seen(config: RunConfig, game: Game) -> None:
    world = face_to_face(config, game)
    gone = replace(world.vehicles, position=torch.tensor([[[-5.5, 0.0], [900.0, 0.0]]]))
    empty = game.draw(game.perceive(place(world, gone)).of(EGO))
    seen = game.perceive(world).of(EGO)
    assert (game.draw(seen) != empty).flatten(2).any(-1).all()
    is_seen = seen.is_seen_history.clone()
    is_seen[:, 5] = False  # one second ago
    grids = game.draw(replace(seen, is_seen_history=is_seen))
    assert (grids != empty).flatten(2).any(-1).tolist() == [[True, False, True, True]]
    short = seen_by(config, replace(PERFECT, range_m=7.0))
    assert torch.equal(short.draw(short.perceive(world).of(EGO)), empty)


def test_grids_and_list_err_alike(config: RunConfig) -> None:
    game = seen_by(config, replace(PERFECT, position_std_m=1.0))
    world = face_to_face(config, game)
    seen = game.perceive(world)
    there = replace(
        world.vehicles, position=torch.stack([world.vehicles.position[:, 0], seen.other.position[:, 0, 0]], 1)
    )
    exact = seen_by(config, PERFECT)
    assert torch.equal(game.draw(seen.of(EGO))[:, 0], exact.draw(exact.perceive(place(world, there)).of(EGO))[:, 0])


@pytest.mark.slow
def test_compiled_sees_the_same(config: RunConfig) -> None:
    sensor = Sensor(NOISY, build_road(config.scenario), config.scenario.dt_s, history_steps=15)
    game = seen_by(config, NOISY)
    world = drive(game, game.simulator.reset(draw_tasks(config, 8)), 5)[-1]
    a, b = sensor.perceive(world), torch.compile(sensor.perceive, dynamic=False)(world)
    assert torch.equal(a.is_seen_history, b.is_seen_history)
    torch.testing.assert_close(a.other_history, b.other_history, atol=1e-5, rtol=0)
    torch.testing.assert_close(a.other.accel, b.other.accel, atol=1e-4, rtol=0)
