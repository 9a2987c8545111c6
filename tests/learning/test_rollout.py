"""Collecting: what is stored, bootstrapped and counted."""

import torch
from rollouts import episode_statistics
from torch import Generator, Tensor, nn

from negopipe.learning.rollout import RunningEpisodes, Transition, collect
from negopipe.policy.actor_critic import ActorCritic

CPU = torch.device("cpu")


class Counter:
    """World 0 terminates (success) every third step, world 1 is truncated every second. Reward 1 and 2.

    The observation is the number of steps in the episode.
    """

    n_worlds = 2

    def __init__(self) -> None:
        self.steps = torch.zeros(2)

    def observe(self) -> Tensor:
        return self.steps[:, None]

    def is_learning(self) -> Tensor:
        return torch.ones(self.n_worlds, dtype=torch.bool)

    def step(self, action: Tensor) -> Transition:
        reached = self.steps + 1
        is_terminated = torch.stack([reached[0] == 3, torch.tensor(False)])
        is_truncated = torch.stack([torch.tensor(False), reached[1] == 2])
        self.steps = torch.where(is_terminated | is_truncated, 0.0, reached)
        return Transition(
            observation=self.steps[:, None],
            final_observation=reached[is_terminated | is_truncated][:, None],
            reward=torch.tensor([1.0, 2.0]),
            is_terminated=is_terminated,
            is_truncated=is_truncated,
            is_success=is_terminated,
            is_collision=torch.zeros(2, dtype=torch.bool),
            final_info={"n_steps": reached[is_terminated | is_truncated]},
        )


def policy() -> ActorCritic:
    network = ActorCritic(nn.Identity(), 1, (8,), 2, torch.float32, Generator().manual_seed(0))
    network.rescale_value(torch.tensor(3.0), torch.tensor(100.0), keep_value=False)
    return network


def test_rollout_stores_states_values_and_ends() -> None:
    network = policy()
    rollout, _ = collect(Counter(), network, 4, Generator().manual_seed(0), RunningEpisodes.start(2, CPU))
    assert rollout.observation[:, :, 0].tolist() == [[0, 0], [1, 1], [2, 0], [0, 1]]
    assert rollout.is_terminated.tolist() == [[False, False], [False, False], [True, False], [False, False]]
    assert rollout.is_truncated.tolist() == [[False, False], [False, True], [False, False], [False, True]]
    with torch.no_grad():
        final = network(torch.tensor([[2.0]]))[1]
        torch.testing.assert_close(rollout.value, network(rollout.observation.flatten(0, 1))[1].view(4, 2))
        torch.testing.assert_close(rollout.last_value, network(torch.tensor([[1.0], [0.0]]))[1])
    torch.testing.assert_close(rollout.final_value[[1, 3], 1], final.expand(2))
    assert rollout.final_value[:, 0].eq(0).all()
    assert rollout.final_value[[0, 2], 1].eq(0).all()
    assert torch.equal(rollout.final_info["n_steps"], rollout.episode_steps[rollout.is_done].float())


def test_episodes_go_on_across_rollouts() -> None:
    env, network, generator = Counter(), policy(), Generator().manual_seed(0)
    first, running = collect(env, network, 2, generator, RunningEpisodes.start(2, CPU))
    assert running.reward_sum.tolist() == [2.0, 0.0]
    assert running.n_steps.tolist() == [2, 0]
    assert episode_statistics(first) == {
        "n_episodes": 1.0,
        "return_mean": 4.0,
        "steps_mean": 2.0,
        "success_rate": 0.0,
        "collision_rate": 0.0,
    }
    second, running = collect(env, network, 1, generator, running)
    assert second.episode_return[0, 0] == 3.0
    assert second.episode_steps[0].tolist() == [3, 0]
    assert episode_statistics(second)["success_rate"] == 1.0
    assert second.final_info["n_steps"].tolist() == [3.0]
    third, _ = collect(Counter(), network, 1, generator, RunningEpisodes.start(2, CPU))
    assert episode_statistics(third) == {"n_episodes": 0.0}


def test_actions_depend_on_the_generator_only() -> None:
    runs = [
        collect(Counter(), policy(), 20, Generator().manual_seed(seed), RunningEpisodes.start(2, CPU))[0].action
        for seed in (0, 0, 1)
    ]
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_simulation_does_not_run_in_the_networks_precision() -> None:
    class Product(Counter):
        def step(self, action: Tensor) -> Transition:
            assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.float32
            return super().step(action)

    network = ActorCritic(nn.Linear(1, 4), 4, (8,), 2, torch.bfloat16, Generator().manual_seed(0))
    collect(Product(), network, 2, Generator().manual_seed(0), RunningEpisodes.start(2, CPU))
