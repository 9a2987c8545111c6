"""The batched environment: actions reach the planner, episodes start again, final observations are kept."""

from dataclasses import replace

import pytest
import torch
from games import draw_tasks
from torch import Tensor

from negopipe.agents.driver import HorizonDriver, drive_together, fixed_horizon
from negopipe.config.root import RunConfig
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import Game, build_game
from negopipe.game.reward import RewardConfig, reward
from negopipe.simulation.perception import Perception
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, Motion
from negopipe.tensors.tree import map_tensors


def make(config: RunConfig, game: Game, n_worlds: int) -> NegotiationEnv:
    sampler = TaskSampler(config.scenario, config.evaluated_families, torch.Generator().manual_seed(3))
    return NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, n_worlds)


def assert_same(a: object, b: object) -> None:
    map_tensors(lambda x, y: torch.testing.assert_close(x, y, equal_nan=True) or x, a, b)


@pytest.mark.parametrize(
    ("is_collision", "is_success", "paid"), [(False, False, -0.25), (True, False, -5.25), (False, True, 9.75)]
)
def test_eq_3_by_hand(config: RunConfig, is_collision: bool, is_success: bool, paid: float) -> None:
    got = reward(config.reward, torch.tensor([is_collision]), torch.tensor([is_success]))
    assert float(got) == paid
    strict = reward(RewardConfig(-0.25, -50.0, 10.0), torch.tensor([is_collision]), torch.tensor([is_success]))
    assert float(strict) == (paid - 45 if is_collision else paid)


def test_blind_pushing_collides_and_starts_again(config: RunConfig, game: Game) -> None:
    env = make(config, game, 8)
    is_yield = env.world.task.family == 1
    ended = torch.zeros(8, dtype=torch.int64)
    for _ in range(60):
        before = env.world
        step = env.step(torch.zeros(8, dtype=torch.int64))
        is_done = step.is_terminated | step.is_truncated
        assert (env.world.step[is_done] == 0).all()
        assert (env.world.step[~is_done] == before.step[~is_done] + 1).all()
        assert len(step.final_observation) == is_done.sum()
        assert (step.final_observation != step.observation[is_done]).flatten(1).any(1).all()
        told = step.final_info
        assert torch.equal(told["social_start_distance_m"], before.task.start_distance[is_done, 1])
        assert torch.equal(told["style_horizon_s"], before.task.style_horizon[is_done, 1])
        ended += is_done
        if ended.sum() == 0:
            continue
        first = is_done & (ended == 1)
        assert (step.is_collision[first] == is_yield[first]).all()  # style 2 does not give way, style 6 does
        if (ended > 0).all():
            break
    assert (ended > 0).any()


def test_observation_is_that_of_the_world(config: RunConfig, game: Game) -> None:
    env = make(config, game, 4)
    for _ in range(40):
        env.step(torch.zeros(4, dtype=torch.int64))
        assert torch.equal(env.observe(), game.draw(game.perceive(env.world).of(EGO)))


def test_the_joint_horizon_is_the_choice_beside_the_styles_and_leaves_the_world_alone(
    config: RunConfig, game: Game
) -> None:
    world = make(config, game, 2).world
    style = world.style_horizon[:, EGO + 1 :].clone()
    horizon = world.horizons(torch.tensor([2.0, 6.0]))
    assert horizon[:, EGO].tolist() == [2.0, 6.0]
    assert torch.equal(horizon[:, EGO + 1 :], style)
    assert world.style_horizon[:, EGO].isnan().all()


def test_actions_are_horizons(config: RunConfig, game: Game) -> None:
    env = make(config, game, 4)
    for _ in range(8):
        world = env.world
        horizon = world.task.style_horizon.clone()
        horizon[:, EGO] = torch.tensor([0.0, 2.0, 4.0, 6.0])
        expected = game.plan(game.perceive(world), horizon).state
        env.step(torch.arange(4))
        assert_same(env.world.vehicles, expected)


def test_a_world_knows_the_horizons_that_were_driven(config: RunConfig, game: Game) -> None:
    env = make(config, game, 4)
    assert env.world.last_horizon.isnan().all()
    for action in (0, 3):
        style = env.world.style_horizon[:, 1]
        env.step(torch.full((4,), action))
        assert env.world.last_horizon[:, EGO].tolist() == [config.policy.horizons_s[action]] * 4
        assert torch.equal(env.world.last_horizon[:, 1], style)
        assert torch.equal(game.perceive(env.world).last_horizon, env.world.last_horizon)
    env.begin(env.sampler.draw_for(torch.tensor([0])), torch.tensor([0]))
    assert env.world.last_horizon.isnan().any(1).tolist() == [True, False, False, False]


def test_a_switched_style_drives(config: RunConfig, game: Game) -> None:
    env = make(config, game, 4)
    task = replace(env.world.task, next_style_horizon=torch.tensor([[torch.nan, 0.0]] * 4))
    for has_switched in (False, True):
        switched = torch.tensor([[False, has_switched]] * 4)
        env.world = world = replace(env.world, task=task, has_switched=switched)
        horizon = torch.where(switched, task.next_style_horizon, task.style_horizon)
        horizon[:, EGO] = 6.0
        expected = game.plan(game.perceive(world), horizon).state
        env.step(torch.full((4,), 3))
        assert_same(env.world.vehicles, expected)


def test_same_seed_same_episode(config: RunConfig, game: Game) -> None:
    a, b = make(config, game, 4), make(config, game, 4)
    for i in range(30):
        action = torch.full((4,), i % 4)
        x, y = a.step(action), b.step(action)
        assert torch.equal(x.observation, y.observation)
        assert torch.equal(x.reward, y.reward)


def own_style(perception: Perception) -> Tensor:
    return perception.style_horizon


def test_driving_together_equals_driving_alone(config: RunConfig, game: Game) -> None:
    world = game.simulator.reset(draw_tasks(config, 6))
    drivers = [HorizonDriver(fixed_horizon(4.0), game.plan), HorizonDriver(own_style, game.plan)]
    for _ in range(20):
        seen = game.perceive(world)
        together = drive_together(drivers, seen)
        alone = [driver.drive(seen.of(agent)) for agent, driver in enumerate(drivers)]
        apart = map_tensors(lambda *columns: torch.cat(columns, 1), *alone)
        map_tensors(lambda a, b: torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4) or a, together, apart)
        world, _ = game.simulator.step(world, together.state)


class Parked:
    """A driver of another kind: it does not plan at all."""

    def drive(self, perception: Perception) -> Motion:
        own = perception.own
        still = type(own)(own.position, own.yaw, own.speed * 0, own.accel * 0, own.curvature)
        no_horizon = torch.full_like(own.speed, torch.nan)
        return Motion(still, no_horizon, torch.zeros_like(own.speed, dtype=torch.bool))


def test_other_drivers_fit_without_a_change(config: RunConfig, game: Game) -> None:
    world = game.simulator.reset(draw_tasks(config, 2))
    start = world.vehicles.position[:, 1].clone()
    for _ in range(10):
        motion = drive_together([HorizonDriver(fixed_horizon(6.0), game.plan), Parked()], game.perceive(world))
        world, _ = game.simulator.step(world, motion.state)
    assert torch.equal(world.vehicles.position[:, 1], start)
    assert (world.vehicles.position[:, EGO, 0] > -20).all()


@pytest.mark.slow
def test_compiled_equals_eager(config: RunConfig, game: Game) -> None:
    # float32 sums in another order: 1e-4 m per step is a thousand roundings of the largest position (45 m)
    compiled = build_game(config, is_compiled=True)
    world = game.simulator.reset(draw_tasks(config, 8))
    horizon = torch.tensor([[0.0, 2.0], [2.0, 4.0], [4.0, 6.0], [6.0, 0.0]]).repeat(2, 1)
    n_differing_grids = 0.0
    for _ in range(40):
        seen = game.perceive(world)
        a, b = game.plan(seen, horizon), compiled.plan(seen, horizon)
        torch.testing.assert_close(a.state.position, b.state.position, atol=1e-4, rtol=0)
        n_differing_grids += float((game.draw(seen.of(EGO)) != compiled.draw(seen.of(EGO))).float().mean())
        world, _ = compiled.step(world, a)
    assert n_differing_grids / 40 < 1e-4
