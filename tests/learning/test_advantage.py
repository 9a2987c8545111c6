"""Returns of k steps (Eq. 6) and their average (GAE), by hand."""

import pytest
import torch

from negopipe.learning.advantage import GaeConfig, KStepConfig, estimate_advantage, k_step_return, lambda_return
from negopipe.learning.rollout import Rollout

GAMMA = 0.5


def one_world(terminated: int | None = None, truncated: int | None = None) -> Rollout:
    """Four steps of one world: r = 1 2 3 4, V = 10 20 30 40, V of the last state 50, final value 7."""
    done = torch.zeros(4, 1, dtype=torch.bool)
    is_terminated, is_truncated, final_value = done.clone(), done.clone(), torch.zeros(4, 1)
    if terminated is not None:
        is_terminated[terminated] = True
    if truncated is not None:
        is_truncated[truncated] = True
        final_value[truncated] = 7.0
    return Rollout(
        observation=torch.zeros(4, 1, 1),
        is_learning=~done,
        action=torch.zeros(4, 1, dtype=torch.int64),
        log_prob=torch.zeros(4, 1),
        reward=torch.tensor([[1.0], [2.0], [3.0], [4.0]]),
        value=torch.tensor([[10.0], [20.0], [30.0], [40.0]]),
        is_terminated=is_terminated,
        is_truncated=is_truncated,
        final_value=final_value,
        last_value=torch.tensor([50.0]),
        episode_return=torch.full((4, 1), torch.nan),
        episode_steps=torch.zeros(4, 1, dtype=torch.int64),
        is_success=done,
        is_collision=done,
    )


@pytest.mark.parametrize(
    ("rollout", "k", "expected"),
    [
        # r + V/2 of the next state
        (one_world(), 1, [1 + 10, 2 + 15, 3 + 20, 4 + 25]),
        # two rewards and V/4; the last step only has one
        (one_world(), 2, [1 + 1 + 7.5, 2 + 1.5 + 10, 3 + 2 + 12.5, 4 + 25]),
        # up to the rollout's end, whatever lies beyond it
        (one_world(), 99, [1 + 1 + 0.75 + 0.5 + 3.125, 2 + 1.5 + 1 + 6.25, 3 + 2 + 12.5, 4 + 25]),
        # terminated in the middle: nothing is bootstrapped, nothing leaks from the next episode
        (one_world(terminated=1), 99, [1 + 1, 2, 3 + 2 + 12.5, 4 + 25]),
        # truncated in the middle: the final observation's value 7, not the next episode's 30
        (one_world(truncated=1), 99, [1 + 1 + 7 / 4, 2 + 7 / 2, 3 + 2 + 12.5, 4 + 25]),
        # both at once: the episode is over for good
        (one_world(terminated=1, truncated=1), 99, [1 + 1, 2, 3 + 2 + 12.5, 4 + 25]),
    ],
)
def test_returns_by_hand(rollout: Rollout, k: int, expected: list[float]) -> None:
    returns = k_step_return(rollout, GAMMA, k)
    torch.testing.assert_close(returns[:, 0], torch.tensor(expected, dtype=torch.float32))
    advantage, same = estimate_advantage(rollout, GAMMA, KStepConfig("k_step", k))
    torch.testing.assert_close(advantage, returns - rollout.value)
    torch.testing.assert_close(same, returns)


ENDS = [(None, None), (1, None), (None, 1), (1, 1), (3, None), (None, 3)]


@pytest.mark.parametrize(("terminated", "truncated"), ENDS)
@pytest.mark.parametrize("gae_lambda", [0.0, 0.3, 0.95, 1.0])
def test_lambda_return_is_the_average_of_all_k_step_returns(
    gae_lambda: float, terminated: int | None, truncated: int | None
) -> None:
    """The sum of its definition; the longest return takes the weights that are left."""
    rollout = one_world(terminated, truncated)
    of_k = [k_step_return(rollout, GAMMA, k) for k in (1, 2, 3, 4)]
    shares = [(1 - gae_lambda) * gae_lambda**i for i in range(3)] + [gae_lambda**3]
    expected = sum(share * returns for share, returns in zip(shares, of_k, strict=True))
    torch.testing.assert_close(lambda_return(rollout, GAMMA, gae_lambda), expected)


def test_generalised_advantage_is_the_sum_of_temporal_differences() -> None:
    """Schulman et al. 2016, Eq. 16: A_t = sum_l (gamma lambda)^l delta_{t+l}."""
    rollout, share = one_world(), 0.6
    values = torch.cat([rollout.value[:, 0], rollout.last_value])
    delta = rollout.reward[:, 0] + GAMMA * values[1:] - values[:-1]
    expected = torch.stack([sum((GAMMA * share) ** (j - t) * delta[j] for j in range(t, 4)) for t in range(4)])
    advantage, returns = estimate_advantage(rollout, GAMMA, GaeConfig("gae", share))
    torch.testing.assert_close(advantage[:, 0], expected)
    torch.testing.assert_close(returns, advantage + rollout.value)
