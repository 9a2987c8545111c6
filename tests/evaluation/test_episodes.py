"""Evaluation episodes: outcomes, records that agree with the simulator, the same whatever is driven beside them."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from composed import compose_config
from games import draw_tasks

from negopipe.agents.driver import HorizonDriver, fixed_horizon
from negopipe.agents.horizon_drivers import adaptive_planner, by_horizon
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.trace import EPISODE_AXIS, OUTCOMES, Trace
from negopipe.game.game import Game, build_game, has_compiler
from negopipe.policy.kinds import build_policy
from negopipe.simulation.state import Task
from negopipe.tensors.tree import map_tensors


def task_with(config: RunConfig, distance_m: float, style_s: float, n: int = 1) -> Task:
    task = draw_tasks(config, n)
    distance, style = task.start_distance.clone(), task.style_horizon.clone()
    distance[:, 1], style[:, 1] = distance_m, style_s
    return replace(task, start_distance=distance, style_horizon=style)


@cache
def short_game(episode_steps: int) -> Game:
    return build_game(compose_config([f"scenario.episode_steps={episode_steps}"]))


def drive(config: RunConfig, game: Game, task: Task, horizon_s: float, n_worlds: int) -> Trace:
    reward = config.evaluation.reward
    return drive_episodes(
        game, by_horizon(game, fixed_horizon(horizon_s)), task, n_worlds, reward, (f"fixed_{horizon_s:g}", "x")
    )


@pytest.mark.parametrize(
    ("distance_m", "style_s", "ego_s", "outcome"),
    [
        (13.0, 2.0, 6.0, "success"),  # the pushy one first, the careful one waits
        (17.5, 6.0, 0.0, "success"),
        (13.0, 0.0, 0.0, "collision"),
        (13.0, 2.0, 2.0, "deadlock"),
        (17.5, 6.0, 6.0, "deadlock"),
    ],
)
def test_two_alike_fail_two_unlike_succeed(
    config: RunConfig, game: Game, distance_m: float, style_s: float, ego_s: float, outcome: str
) -> None:
    trace = drive(config, game, task_with(config, distance_m, style_s), ego_s, n_worlds=1)
    assert OUTCOMES[int(trace.outcome[0])] == outcome
    n, end = int(trace.n_steps[0]), {"success": 9.75, "collision": -5.25}.get(outcome, -0.25)
    assert trace.reward[: n - 1, 0].tolist() == [-0.25] * (n - 1)
    assert trace.reward[n - 1, 0] == end
    assert (trace.reward[n:] == 0).all()
    assert n == config.scenario.episode_steps or outcome in ("success", "collision")


def test_records_are_those_of_the_drive(config: RunConfig, game: Game) -> None:
    trace = drive(config, game, task_with(config, 17.5, 6.0), 0.0, n_worlds=1)
    n = int(trace.n_steps[0])
    assert trace.position_m.shape == (config.scenario.episode_steps + 1, 1, 2, 2)
    assert trace.horizon_s.shape == (config.scenario.episode_steps, 1, 2)
    moved = np.diff(trace.progress_m[: n + 1, 0, 0])
    mean_speed = (trace.speed_mps[:n, 0, 0] + trace.speed_mps[1 : n + 1, 0, 0]) / 2
    assert np.abs(moved - mean_speed * trace.dt_s).max() < 0.1
    assert (trace.horizon_s[:n, 0] == [0.0, 6.0]).all()
    assert np.isnan(trace.horizon_s[n:]).all()
    reached = trace.reached_step[0]
    target = config.scenario.road.corridor_length_m + config.scenario.road.target_distance_m
    for vehicle in range(2):
        assert (
            trace.progress_m[reached[vehicle], 0, vehicle]
            >= target
            > trace.progress_m[reached[vehicle] - 1, 0, vehicle]
        )
    assert max(reached) == n
    assert (trace.position_m[n:] == trace.position_m[n]).all()


def test_outcomes_do_not_depend_on_batch_size_or_order(config: RunConfig) -> None:
    game = short_game(72)
    task, order = draw_tasks(config, 10, seed=4), torch.randperm(10, generator=torch.Generator().manual_seed(1))
    one_batch = drive(config, game, task, 6.0, 10)
    in_parts = drive(config, game, map_tensors(lambda field: field[order], task), 6.0, 4)
    for name, axis in EPISODE_AXIS.items():
        a, b = np.take(getattr(one_batch, name), order.numpy(), axis), getattr(in_parts, name)
        if a.dtype.kind in "biU":
            assert np.array_equal(a, b), name
        else:
            assert np.allclose(a, b, atol=1e-3, equal_nan=True), name


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
@pytest.mark.parametrize("planner", ["adaptive", "fixed_6", "random", "give_way", "cautious", "level_k"])
def test_compiled_not_a_bit_depends_on_batch_size_or_order(config: RunConfig, compiled: Game, planner: str) -> None:
    baseline = compose_config(["evaluation/baseline=all"]).evaluation.baselines.get(planner)
    policy = build_policy(
        config.policy, config.observation.layout, torch.device("cpu"), torch.Generator().manual_seed(0)
    )
    make_ego, is_lockstep = by_horizon(compiled, adaptive_planner(policy, compiled, config.policy.horizons_s)), False
    if baseline is not None:
        make_ego, is_lockstep = partial(baseline.driver, compiled), baseline.is_lockstep
    n = 8 if planner == "level_k" else 100
    tasks, order = draw_tasks(config, n, seed=4), torch.randperm(n, generator=torch.Generator().manual_seed(1))
    in_other_order = map_tensors(lambda field: field[order], tasks)
    names, reward = (planner, "x"), config.evaluation.reward
    one_batch = drive_episodes(compiled, make_ego, tasks, n, reward, names, is_lockstep)
    in_parts = drive_episodes(compiled, make_ego, in_other_order, 7, reward, names, is_lockstep)
    for name, axis in EPISODE_AXIS.items():
        a, b = np.take(getattr(one_batch, name), order.numpy(), axis), getattr(in_parts, name)
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name


@pytest.fixture(scope="module")
def compiled(config: RunConfig) -> Game:
    return build_game(config, is_compiled=True)


def test_adaptive_planner_looks_at_the_grids(config: RunConfig) -> None:
    game = short_game(32)
    policy = build_policy(
        config.policy, config.observation.layout, torch.device("cpu"), torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        policy.policy_head[-1].bias.copy_(torch.tensor([0.0, 0.0, 100.0, 0.0]))
    task = task_with(config, 17.5, 6.0)
    choose = adaptive_planner(policy, game, config.policy.horizons_s)
    reward = config.evaluation.reward
    adaptive = drive_episodes(game, by_horizon(game, choose), task, 1, reward, ("adaptive", "x"))
    fixed = drive(config, game, task, 4.0, 1)
    assert np.array_equal(adaptive.position_m, fixed.position_m)
    with torch.no_grad():
        policy.policy_head[-1].bias.zero_()

    def sampling(episode_key: torch.Tensor) -> HorizonDriver:
        return HorizonDriver(adaptive_planner(policy, game, config.policy.horizons_s, episode_key), game.plan)

    drawn, again = (
        drive_episodes(game, sampling, task, 1, reward, ("adaptive", "x"), is_lockstep=True) for _ in range(2)
    )
    n = int(drawn.n_steps[0])
    assert set(drawn.horizon_s[:n, 0, 0].tolist()) == {0.0, 2.0, 4.0, 6.0}
    assert np.array_equal(drawn.horizon_s, again.horizon_s, equal_nan=True)
