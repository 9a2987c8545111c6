"""The league: earlier states of the policy drive, the oldest makes room, hard ones are met more often."""

from pathlib import Path

import pytest
import torch
from composed import compose_config
from torch import Generator, Tensor

from negopipe.agents.population import Cast
from negopipe.config.root import RunConfig
from negopipe.game.game import build_game
from negopipe.policy.actor_critic import ActorCritic
from negopipe.runtime.build import build, with_learned
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import NEAREST, Task
from negopipe.training.league import League
from negopipe.training.lost_shares import LEAST_LOST
from negopipe.training.training import Training

LEAGUE = "population.drivers.league.driver"
SMALL = ["+experiment=smoke", "device=cpu", "compile='off'", "population/driver=[planner,league]",
         f"{LEAGUE}.n_members=2", f"{LEAGUE}.every_iterations=3"]  # fmt: skip


def made(*overrides: str) -> tuple[RunConfig, Cast, ActorCritic, League]:
    config = compose_config([*SMALL, *overrides])
    game, policy = build(config)
    return config, game.cast, policy, League(game.cast, policy)


def shift(policy: ActorCritic, value: float) -> None:
    with torch.no_grad():
        for weight in policy.parameters():
            weight.fill_(value)


def values(league: League) -> list[float]:
    return [float(next(member.parameters()).flatten()[0]) for member in league.members.values()]


def draw(config: RunConfig, league: League, n: int = 4000) -> Task:
    families = {"mixture": config.scenario.families["mixture"]}
    return TaskSampler(config.scenario, families, Generator().manual_seed(0), league.assign).draw(n)


def shares(drivers: Tensor) -> list[float]:
    return [float((drivers[:, NEAREST] == index).float().mean()) for index in range(3)]


def test_members_are_drivers_of_their_own_that_share_the_weight() -> None:
    config, cast, _, league = made("population.drivers.league.weight=3")
    assert cast.names == ("planner", "league_1", "league_2")
    assert shares(draw(config, league).casting.driver) == pytest.approx([0.25, 0.375, 0.375], abs=0.03)
    assert cast.learners == ()


def test_the_oldest_member_makes_room() -> None:
    _, _, policy, league = made()
    seen = []
    for n_done in range(1, 10):
        shift(policy, n_done)
        league.admit(policy, n_done)
        seen.append(values(league))
    assert seen[2][0] == 3  # after every third iteration
    assert seen[1][0] != 3
    assert seen[5] == [3, 6]
    assert seen[8] == [9, 6]


def test_the_hardest_are_met_more_often() -> None:
    config, _, policy, league = made(f"{LEAGUE}.draw=hardest")
    assert shares(draw(config, league).casting.driver)[1:] == pytest.approx([0.25, 0.25], abs=0.03)
    n = 2000
    league.lost.record(torch.full((n,), 1), torch.arange(n) % 4 > 0)  # a quarter of the episodes is lost
    league.lost.record(torch.full((n,), 2), torch.ones(n, dtype=torch.bool))
    lost = league.lost.shares.tolist()
    assert lost[1] == pytest.approx(0.25, abs=0.01)
    assert lost[2] < LEAST_LOST
    expected = [0.5, 0.5 * 0.25 / 0.3, 0.5 * LEAST_LOST / 0.3]
    assert shares(draw(config, league).casting.driver) == pytest.approx(expected, abs=0.03)
    league.admit(policy, 3)  # a new member is as hard as can be until it is known
    assert league.lost.shares.tolist()[1] == 1.0


def test_members_drive_by_their_own_networks() -> None:
    config, cast, policy, league = made("population.drivers.planner.weight=0")
    for index, favourite in ((1, 0), (2, 3)):
        head = league.members[index].policy_head[-1]
        with torch.no_grad():
            head.weight.zero_()
            head.bias.copy_(100.0 * torch.nn.functional.one_hot(torch.tensor(favourite), 4))
    game = with_learned(build_game(config), config, policy, league.members)
    world = game.simulator.reset(draw(config, league, 16))
    horizon = game.choose(world, torch.zeros(16))[:, NEAREST]
    driver = world.task.casting.driver[:, NEAREST]
    assert torch.equal(horizon, torch.where(driver == 1, 0.0, 6.0))
    assert len(cast.names) == 3


def test_a_training_lets_the_policy_in_and_an_evaluation_meets_itself(tmp_path: Path) -> None:
    config = compose_config([*SMALL, f"{LEAGUE}.every_iterations=2", "scenario.episode_steps=12"])
    training = Training(config, tmp_path)
    before = values(training.league)
    for _ in range(2):
        training.iterate()
    after = values(training.league)
    assert after[0] != before[0]
    assert after[1] == before[1]
    assert after[0] == float(next(training.policy.parameters()).flatten()[0])
    assert {"social_driver"} <= set(training.curve.episodes)
    game, policy = build(config)
    world = game.simulator.reset(draw(config, League(game.cast, policy), 16))
    assert not game.choose(world, torch.zeros(16)).isnan().any()
