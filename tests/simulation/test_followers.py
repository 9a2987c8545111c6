"""Vehicles behind the ego: where they start, what success and deadlock mean with them, whose collisions they are."""

from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks, drive, meet

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.safety import avoidable_by
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.game.game import Game, build_game
from negopipe.simulation.state import EGO
from negopipe.tensors.tree import map_tensors


def built(*overrides: str) -> tuple[RunConfig, Game]:
    config = compose_config(list(overrides))
    return config, build_game(config)


def test_followers_queue_behind_the_ego() -> None:
    config, game = built("scenario.n_social=2", "scenario.n_followers=2", "scenario.desired_speed_mps=[4.0,6.0]")
    task = draw_tasks(config, 64)
    assert task.direction.sign().unique(dim=0).tolist() == [[1.0, -1.0, -1.0, 1.0, 1.0]]
    ego, first, second = (task.start_distance[:, i] for i in (EGO, 3, 4))
    torch.testing.assert_close(first, ego + 12.0)
    torch.testing.assert_close(second, ego + 24.0)
    assert task.desired_speed[:, 3:].std() > 0.3
    assert not task.style_horizon[:, 3:].isnan().any()
    world = game.simulator.reset(task)
    assert world.vehicles.yaw[:, [EGO, 3, 4]].abs().max() == 0
    assert not game.simulator.touches(world).any()
    assert config.scenario.n_vehicles == 5


def test_a_queue_that_is_too_dense_is_refused() -> None:
    with pytest.raises(
        UserError, match=r"^scenario\.social_spacing_m must keep vehicles of scenario\.vehicle\.length_m"
    ):
        compose_config(["scenario.n_followers=1", "scenario.social_spacing_m=4.0"])
    with pytest.raises(
        UserError, match=r"^scenario\.social_spacing_m must keep vehicles of scenario\.kinds\.bus\.length"
    ):
        compose_config(["scenario.n_followers=1", "scenario.social_spacing_m=5.5", "scenario/kind=[car,bus]"])


def test_success_is_that_the_followers_have_arrived_too() -> None:
    config, game = built("scenario.n_followers=1", "planner=consistent_stops")
    world = meet(config, game, [[30.0, 30.0, 20.0]], [[5.0, 5.0, 5.0]])
    first, events = game.simulator.step(world, world.vehicles)
    assert first.has_reached.tolist() == [[True, True, False]]
    assert not events.is_success
    last = drive(game, world, torch.tensor([[0.0, 2.0, 2.0]]), 20)[-1]
    assert last.has_reached.all()
    _, events = game.simulator.step(last, last.vehicles)
    assert events.is_success


@pytest.mark.parametrize("planner", ["consistent_stops", pytest.param("reversing", marks=pytest.mark.slow)])
def test_followers_get_through_behind_an_ego_that_waits(planner: str) -> None:
    config, game = built("scenario.n_followers=2", f"planner={planner}")
    tasks = draw_tasks(config, 8)
    trace = drive_episodes(game, by_horizon(game, fixed_horizon(6.0)), tasks, 8, config.reward, ("fixed_6", "mixture"))
    assert (trace.outcome == OUTCOMES.index("success")).sum() >= 6
    assert not (trace.outcome == OUTCOMES.index("social_collision")).any()


def nose_to_nose(follower_m: float) -> Trace:
    config, game = built("scenario.n_followers=1", "scenario.episode_steps=48")
    task = draw_tasks(config, 1)
    start = torch.tensor([[-3.0, -3.5, follower_m]])
    task = replace(task, start_distance=start, start_speed=torch.zeros(1, 3), style_horizon=torch.full((1, 3), 6.0))
    return drive_episodes(game, by_horizon(game, fixed_horizon(6.0)), task, 1, config.reward, ("fixed_6", "mixture"))


def test_a_deadlock_is_one_with_a_follower_too() -> None:
    assert OUTCOMES[int(nose_to_nose(9.0).outcome[0])] == "deadlock"


def test_a_follower_that_stands_behind_makes_no_deadlock() -> None:
    """The ego stands at rest behind nobody, the oncoming vehicle has long passed: a timeout."""
    config, game = built("scenario.n_followers=1", "scenario.episode_steps=40", "planner=consistent_stops")
    task = draw_tasks(config, 1)
    task = replace(
        task,
        start_distance=torch.tensor([[9.0, -30.0, 16.0]]),
        start_speed=torch.tensor([[0.0, 5.0, 0.0]]),
        desired_speed=torch.tensor([[0.01, 6.0, 6.0]]),
        style_horizon=torch.full((1, 3), 6.0),
    )
    trace = drive_episodes(game, by_horizon(game, fixed_horizon(0.0)), task, 1, config.reward, ("fixed_0", "mixture"))
    assert abs(trace.speed_mps[-20:, 0, [0, 2]]).max() < 0.1
    assert OUTCOMES[int(trace.outcome[0])] == "timeout"


def test_a_follower_that_runs_into_the_ego_could_have_avoided_it() -> None:
    """With the planner that predicts leaders like any other, a blind follower hits an ego that stands."""
    config, game = built("scenario.n_followers=1")
    task = draw_tasks(config, 1)
    task = replace(
        task,
        start_distance=torch.tensor([[20.0, -30.0, 32.0]]),
        start_speed=torch.tensor([[0.0, 5.0, 5.0]]),
        desired_speed=torch.tensor([[0.01, 6.0, 6.0]]),
        style_horizon=torch.zeros(1, 3),
    )
    trace = drive_episodes(game, by_horizon(game, fixed_horizon(0.0)), task, 1, config.reward, ("fixed_0", "mixture"))
    assert OUTCOMES[int(trace.outcome[0])] == "collision"
    assert avoidable_by(trace, config.planner.limits.full_braking_mps2).tolist() == ["social"]


def test_the_ego_does_not_reverse_into_its_follower() -> None:
    config, game = built("scenario.n_followers=1", "planner=reversing")
    s = [[3.0, 3.5, -2.5], [3.0, 3.5, -30.0], [3.0, 3.5, -30.0]]
    world = meet(config, game, s, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    motion = game.plan(game.perceive(world), torch.tensor([[6.0, 2.0, 2.0]]).expand(3, 3))
    assert (motion.state.speed[:, EGO] < 0).tolist() == [False, True, False]
    worlds = drive(game, world, torch.tensor([[6.0, 2.0, 0.0]]).expand(3, 3), 60)
    assert not worlds[-1].has_collided[:, [EGO, 2]].any()


TRAFFIC = ("scenario.n_social=2", "scenario.n_followers=2", "planner=consistent_stops", "perception.range_m=60")


def test_queues_are_absent_in_their_share_of_the_tasks_and_nothing_else_changes() -> None:
    config, _ = built(*TRAFFIC, "scenario.absent_queue_share=0.25")
    task, full = draw_tasks(config, 2000), draw_tasks(built(*TRAFFIC)[0], 2000)
    is_there = task.is_present
    assert is_there[:, :2].all()  # the ego and the first oncoming vehicle
    assert (is_there[:, 3] == is_there[:, 4]).all()  # the followers together
    oncoming, followers = (1 - is_there[:, i].float().mean() for i in (2, 3))
    assert oncoming == pytest.approx(0.25, abs=0.04)
    assert followers == pytest.approx(0.25, abs=0.04)
    both = 1 - (is_there[:, 2] | is_there[:, 3]).float().mean()
    assert both == pytest.approx(0.0625, abs=0.02)
    assert torch.equal(task.start_distance[is_there], full.start_distance[is_there])
    for drawn, same in ((task.desired_speed, full.desired_speed), (task.direction, full.direction)):
        assert torch.equal(drawn, same)


@pytest.mark.parametrize("street", ["narrow_lane", pytest.param("bent_street", marks=pytest.mark.slow)])
def test_absent_vehicles_change_no_drive(street: str) -> None:
    config, game = built(f"scenario={street}", *TRAFFIC, "scenario.absent_queue_share=1.0")
    _, few = built(f"scenario={street}", "planner=consistent_stops", "perception.range_m=60")
    task = draw_tasks(config, 8)
    assert task.is_present.sum(1).tolist() == [2] * 8
    alone = map_tensors(lambda field: field[:, :2] if field.dim() > 1 else field, task)
    choice = torch.tensor([[0.0, 4.0, 6.0, 2.0, 0.0]]).expand(8, -1)
    drives = drive(game, game.simulator.reset(task), choice, 40)
    others = drive(few, few.simulator.reset(alone), choice[:, :2], 40)
    for with_absent, without in zip(drives, others, strict=True):
        assert torch.equal(with_absent.vehicles.position[:, :2], without.vehicles.position)
        assert not with_absent.has_collided[:, 2:].any()
    assert drives[1].has_reached[:, 2:].all()
    success = game.simulator.step(drives[-1], drives[-1].vehicles)[1].is_success
    assert torch.equal(success, few.simulator.step(others[-1], others[-1].vehicles)[1].is_success)


def test_absent_vehicles_want_a_sensor_that_does_not_see_them() -> None:
    with pytest.raises(
        UserError, match=r"^perception\.range_m must be a number where scenario\.absent_queue_share > 0"
    ):
        compose_config(["scenario.n_followers=1", "scenario.absent_queue_share=0.5"])
