"""Self-play: the policy decides for vehicles on both sides, and learns from all of these decisions."""

from dataclasses import fields, replace

import pytest
import torch
from composed import compose_config
from torch import Generator, Tensor

from negopipe.config.root import RunConfig
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import Game, build_game
from negopipe.learning.learner import Learner
from negopipe.learning.rollout import Rollout, RunningEpisodes, collect
from negopipe.policy.actor_critic import ActorCritic
from negopipe.runtime.build import build
from negopipe.simulation.scenario import TaskSampler

N = 6
HORIZONS = torch.tensor([0.0, 2.0, 4.0, 6.0])
SMALL = ["+experiment=smoke", "device=cpu", "compile='off'", f"algorithm.n_worlds={N}", "algorithm.n_steps=8"]
GRIDS = ["policy.encoder_width=16"]
"""A small network, which learns quickly."""


def made(*overrides: str) -> tuple[RunConfig, Game, NegotiationEnv]:
    config = compose_config([*SMALL, *overrides])
    game = build_game(config)
    families = {"mixture": config.scenario.families["mixture"]}
    sampler = TaskSampler(config.scenario, families, Generator().manual_seed(3), game.cast.assign)
    env = NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, N, game.cast.learners)
    return config, game, env


def drawn(n: int, seed: int = 0) -> Tensor:
    return torch.randint(0, 4, (n,), generator=Generator().manual_seed(seed))


@pytest.mark.parametrize("n_social", [1, 2])
def test_every_seat_has_its_own_actions(n_social: int) -> None:
    _, game, env = made("population/driver=[self]", f"scenario.n_social={n_social}")
    for seed in range(5):
        world, action = env.world, drawn(N * (1 + n_social), seed)
        assert env.is_learning().all()
        joint = HORIZONS[action].view(1 + n_social, N).T
        expected, _ = game.simulator.step(world, game.plan(game.perceive(world), joint).state)
        env.step(action)
        assert torch.equal(env.world.vehicles.position, expected.vehicles.position)


def test_every_seat_sees_with_its_own_eyes() -> None:
    _, game, env = made("population/driver=[self]", "scenario.n_social=2")
    for _ in range(4):
        seen = game.perceive(env.world)
        by_vehicle = env.observe().unflatten(0, (3, N))
        for vehicle in range(3):
            assert torch.equal(by_vehicle[vehicle], game.draw(seen.of(vehicle)))
        env.step(drawn(3 * N))


def test_only_vehicles_of_the_policy_do_what_it_says() -> None:
    _, game, env = made("population/driver=[planner,self]", "scenario.n_social=2")
    is_its = env.world.task.casting.driver == game.cast.names.index("self")
    assert 0 < is_its.sum() < 2 * N
    assert torch.equal(env.is_learning().view(3, N).T[:, 1:], is_its[:, 1:])
    assert not env.observe()[~env.is_learning()].any()
    world, action = env.world, drawn(3 * N)
    joint = torch.where(is_its, HORIZONS[action].view(3, N).T, world.horizons(HORIZONS[action[:N]]))
    env.step(action)
    expected, _ = game.simulator.step(world, game.plan(game.perceive(world), joint).state)
    assert torch.equal(env.world.vehicles.position, expected.vehicles.position)


def test_nobody_but_the_egos_learns_without_self_play() -> None:
    for driver in ("[planner]", "[policy]"):
        _, game, env = made(f"population/driver={driver}")
        assert env.observe().shape[0] == N
        assert game.cast.learners == ()
    greedy = "population.drivers.self.driver.action=greedy"
    _, game, _ = made("population/driver=[self]", greedy)  # the most probable actions are not drawn by the policy
    assert game.cast.learners == ()


def test_all_seats_of_a_world_end_together_and_are_paid_alike() -> None:
    _, _, env = made("population/driver=[self]")
    n_ended = 0
    for seed in range(60):
        transition = env.step(drawn(2 * N, seed))
        for field in (transition.is_terminated, transition.is_truncated, transition.reward):
            assert torch.equal(field[:N], field[N:])
        n_ended += int(transition.is_done[:N].sum())
        assert len(transition.final_observation) == 2 * int(transition.is_done[:N].sum())
        assert len(transition.final_info["style_horizon_s"]) == int(transition.is_done[:N].sum())
    assert n_ended > 0


def test_who_has_crashed_learns_no_more() -> None:
    _, _, env = made("population/driver=[self]", "scenario.n_social=2")
    crashed = torch.zeros_like(env.world.has_collided)
    crashed[2, 1] = True
    before = env.is_learning()
    env.world = replace(env.world, has_collided=crashed)
    assert (before != env.is_learning()).nonzero().flatten().tolist() == [N + 2]


def rollout_of(*overrides: str, seed: int = 0) -> tuple[RunConfig, ActorCritic, Rollout]:
    config = compose_config([*SMALL, "scenario.episode_steps=20", *overrides])
    game, policy = build(config)
    families = {"mixture": config.scenario.families["mixture"]}
    sampler = TaskSampler(config.scenario, families, Generator().manual_seed(seed), game.cast.assign)
    env = NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, N, game.cast.learners)
    running = RunningEpisodes.start(N, torch.device("cpu"))
    rollout, _ = collect(env, policy, 30, Generator().manual_seed(seed), running)
    return config, policy, rollout


def test_what_others_do_is_not_learnt_from() -> None:
    config, policy, rollout = rollout_of("population/driver=[planner,self]", *GRIDS)
    learns = rollout.is_learning
    assert learns[:, :N].all()
    assert 0 < learns[:, N:].float().mean() < 1

    def garbled(field: Tensor) -> Tensor:
        noise = torch.full_like(field, 1) if field.dtype != torch.float32 else torch.full_like(field, 7.5)
        return torch.where(learns.view(*learns.shape, *[1] * (field.dim() - 2)), field, noise)

    names = ("observation", "action", "log_prob", "reward", "value")
    other = replace(rollout, **{name: garbled(getattr(rollout, name)) for name in names})
    start = {name: weight.clone() for name, weight in policy.state_dict().items()}
    learnt = []
    for each in (rollout, other):
        policy.load_state_dict(start)
        Learner(policy, config.algorithm, Generator().manual_seed(0)).update(each, 0.0)
        learnt.append({name: weight.clone() for name, weight in policy.state_dict().items()})
    assert all(torch.equal(learnt[0][name], learnt[1][name]) for name in start)
    assert any(not torch.equal(learnt[0][name], start[name]) for name in start)


def test_an_agents_decisions_end_before_another_driver_takes_its_place() -> None:
    _, _, rollout = rollout_of("population/driver=[planner,self]", "scenario.n_social=2")
    ends = rollout.is_learning[:-1] & ~rollout.is_learning[1:]
    assert ends.any()
    assert rollout.is_done[:-1][ends].all()


def test_decisions_are_valued_as_the_policy_values_them() -> None:
    _, policy, rollout = rollout_of("population/driver=[planner,self]", *GRIDS)
    learns = rollout.is_learning
    with torch.no_grad():
        logits, value = policy(rollout.observation[learns])
    torch.testing.assert_close(rollout.value[learns], value)
    chosen = logits.log_softmax(-1).gather(-1, rollout.action[learns][:, None])[:, 0]
    torch.testing.assert_close(rollout.log_prob[learns], chosen)
    assert rollout.is_over.shape == rollout.episode_return.shape == (30, N)
    assert torch.equal(rollout.is_over, rollout.is_done[:, :N])


def test_a_saved_environment_goes_on_the_same() -> None:
    _, _, one = made("population/driver=[planner,self]")
    for seed in range(10):
        one.step(drawn(2 * N, seed))
    _, _, other = made("population/driver=[planner,self]")
    other.load_state_dict({name: tensor.clone() for name, tensor in one.state_dict().items()})
    for seed in range(10, 20):
        first, second = one.step(drawn(2 * N, seed)), other.step(drawn(2 * N, seed))
        for field in fields(first):
            a, b = getattr(first, field.name), getattr(second, field.name)
            assert isinstance(a, dict) or torch.equal(a, b)


def test_every_seat_sees_objects_as_the_ego_does() -> None:
    _, game, env = made("observation=objects", "policy=objects", "population/driver=[self]")
    assert env.observe().shape == (2 * N, *game.observation_shape)
    env.step(drawn(2 * N))
    seats = (torch.full((N,), vehicle) for vehicle in (0, 1))
    torch.testing.assert_close(env.observe(), torch.cat([game.see_as(env.world, seat) for seat in seats]))
