"""jobs/cartpole.py: its carts move as gymnasium's do, episode after episode, and ACKTR masters them, seed by seed."""

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from scripts import load_script
from torch import Generator, Tensor

from negopipe.learning.rollout import RunningEpisodes, collect
from negopipe.policy.actor_critic import sample_action

START_MAX = 0.05
"""Largest absolute value of what is seen of a new cart."""


cartpole = load_script("cartpole")


def balance(observation: Tensor) -> Tensor:
    """Actions [E] that keep the pole up and the cart on its track for as long as one likes."""
    return (observation @ torch.tensor([0.05, 0.1, 1.0, 0.3]) > 0).long()


def drawn(seed: int = 0) -> Any:
    return partial(sample_action, generator=Generator().manual_seed(seed))


def test_every_step_is_that_of_gymnasiums_single_cart() -> None:
    """Half of the carts balance until the time limit, the others soon fall."""
    env, falls = cartpole.CartPole(6, seed=1), torch.arange(6) >= 3
    singles, draw, n_ended = [gymnasium.make("CartPole-v1") for _ in range(6)], drawn(), torch.zeros(6)
    for single in singles:
        single.reset()
    for _ in range(510):
        action = torch.where(falls, draw(torch.zeros(6, 2)), balance(env.observe()))
        for world, single in enumerate(singles):
            single.unwrapped.state = env.envs.state[:, world]
        transition = env.step(action)
        final = iter(transition.final_observation)
        for world, single in enumerate(singles):
            expected, reward, is_terminated, is_truncated, _ = single.step(int(action[world]))
            is_over = is_terminated or is_truncated
            reached = next(final) if is_over else transition.observation[world]
            np.testing.assert_allclose(reached.numpy(), expected, rtol=1e-5, atol=1e-6)
            assert transition.reward[world] == reward == 1
            assert bool(transition.is_terminated[world]) == is_terminated
            assert bool(transition.is_truncated[world]) == is_truncated
            n_ended[world] += is_over
            if is_over:
                single.reset()
        assert next(final, None) is None
    assert n_ended[:3].tolist() == [1, 1, 1]
    assert (n_ended[3:] > 10).all()


def test_a_fallen_pole_leaves_its_last_sight_and_a_new_cart() -> None:
    env, draw, n_fallen = cartpole.CartPole(16, seed=2), drawn(), 0
    for _ in range(100):
        seen = env.observe()
        seen_before = seen.clone()
        transition = env.step(draw(torch.zeros(16, 2)))
        assert torch.equal(seen, seen_before), "a rollout would hold what was overwritten"
        assert torch.equal(transition.observation, env.observe())
        assert transition.observation.dtype == torch.float32
        assert not transition.is_truncated.any()
        assert torch.equal(transition.is_collision, transition.is_terminated)
        new, final = transition.observation[transition.is_terminated], transition.final_observation
        assert len(new) == len(final)
        assert (new.abs() <= START_MAX).all()
        assert ((final[:, 0].abs() > 2.4) | (final[:, 2].abs() > np.radians(12))).all()
        n_fallen += len(new)
    assert n_fallen > 30


def test_the_time_limit_truncates_after_500_steps_and_the_next_episode_has_as_many() -> None:
    env = cartpole.CartPole(4, seed=3)
    for step in range(1, 1001):
        transition = env.step(balance(env.observe()))
        is_last = step in (500, 1000)
        assert transition.is_truncated.tolist() == transition.is_success.tolist() == [is_last] * 4
        assert not transition.is_terminated.any()
        assert len(transition.final_observation) == (4 if is_last else 0)
        if is_last:
            assert (transition.observation.abs() <= START_MAX).all()
            assert not torch.isclose(transition.observation, transition.final_observation).all(1).any()


def test_a_pole_that_falls_with_the_last_step_has_fallen() -> None:
    env = cartpole.CartPole(2, seed=4)
    env.envs.steps[:] = 499
    env.envs.state[2, 0] = 0.3
    transition = env.step(torch.tensor([1, 1]))
    assert transition.is_terminated.tolist() == transition.is_collision.tolist() == [True, False]
    assert transition.is_truncated.tolist() == transition.is_success.tolist() == [False, True]


def test_a_rollout_values_where_time_ran_out_and_not_where_the_pole_fell() -> None:
    env, policy = cartpole.CartPole(8, seed=5), cartpole.network(seed=5)
    torch.nn.init.constant_(policy.value_head[-1].bias, 3.0)
    env.envs.steps[:4] = 490  # the first four have ten steps left
    running = RunningEpisodes.start(8, torch.device("cpu"))
    rollout, _ = collect(env, policy, 40, Generator().manual_seed(0), running)
    assert rollout.is_truncated[9, :4].any()
    assert rollout.is_terminated.any()
    assert torch.equal(rollout.final_value != 0, rollout.is_truncated)
    assert torch.equal(rollout.episode_return[rollout.is_done], rollout.episode_steps[rollout.is_done].float())


def test_only_the_first_episode_of_each_cart_is_judged() -> None:
    """Until a time, short episodes are over-represented among those that have ended."""
    assert cartpole.play(lambda observation: (observation, None), balance, seed=0) == 500
    assert 18 < cartpole.play(cartpole.network(seed=0), drawn(), seed=0) < 28


def test_a_short_training_improves_clearly_and_repeats() -> None:
    config = cartpole.config_of("acktr")
    policy, episodes = cartpole.train(config, 20, seed=11)
    assert cartpole.play(cartpole.network(seed=11), drawn(), seed=11) < 30
    assert cartpole.play(policy, drawn(), seed=11) > 60
    assert episodes["steps"].is_monotonic_increasing
    assert episodes["return"].sum() <= 20 * 64 * 16
    (one, its), (other, others) = (cartpole.train(config, 3, seed=11) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert its.equals(others)


def test_a_seed_that_stays_under_450_is_told_by_the_exit_code(tmp_path: Path, capsys: Any) -> None:
    table = tmp_path / "table.csv"
    arguments = ["--seeds", "1,2", "--steps", "100", "--out", str(table), "algorithm.n_worlds=4"]
    assert cartpole.main([*arguments, "algorithm.n_steps=20"]) == 1
    assert "acktr: 0 of 2 seeds reach 450" in capsys.readouterr().out
    rows = pd.read_csv(table)
    assert tuple(rows) == tuple(cartpole.TABLE.columns)
    assert rows["seed"].tolist() == [1, 2]
    assert rows["steps"].tolist() == [80, 80]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["seed=3"], "overrides must begin with algorithm."),
        (["algorithm.kl_clp=1"], "did you mean kl_clip?"),
        (["algorithm.kl_clip=-1"], "algorithm.kl_clip must be greater than 0, got -1"),
        (["--steps", "1000"], "--steps must be at least 1024"),
        (["--seeds", "1..3"], "invalid seeds value: '1..3'"),
    ],
)
def test_what_cannot_be_run_is_refused(arguments: list[str], said: str, capsys: Any) -> None:
    with pytest.raises(SystemExit) as stop:
        cartpole.main(arguments)
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_acktr_solves_it_with_every_seed(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    assert cartpole.main(["--seeds", "1,2,3,4,5", "--steps", "150000", "--out", str(table)]) == 0
    rows = pd.read_csv(table)
    assert rows["seed"].tolist() == [1, 2, 3, 4, 5]
    assert (rows["greedy"] >= 450).all()
    assert (rows["sampled"] >= 450).all()
    assert (rows["steps"] <= 150_000).all()
