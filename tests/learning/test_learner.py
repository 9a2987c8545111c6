"""All algorithms: every option acts, seeds repeat, a learner goes on where it stopped, a corridor is learnt."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from corridor import ALGORITHMS, TWO_FIRST, a_rollout, config_of, network, train, weights
from torch import Generator, nn

from negopipe.learning.learner import Learner
from negopipe.policy.actor_critic import ActorCritic

FASTER = {
    "acktr": ("algorithm.kl_clip=0.01",),
    "acktr_adam": ("algorithm.adam.policy_rate=0.005", "algorithm.adam.value_rate=0.01"),
    "a2c": ("algorithm.adam.policy_rate=0.01", "algorithm.adam.value_rate=0.01"),
    "ppo": ("algorithm.adam.policy_rate=0.005", "algorithm.adam.value_rate=0.01"),
}
"""A network this small takes larger steps than that of the grids."""

SHARED = (
    "n_worlds=8", "n_steps=6", "n_epochs=3", "minibatch_size=50", "gamma=0.9", "value_coefficient=0.1",
    "entropy_coefficient=0.5", "return_decay=0.2", "advantage.kind=k_step", "advantage.kind=gae",
)  # fmt: skip
KFAC = (
    "kfac.damping=0.1", "kfac.statistics_decay=0.1", "kfac.statistics_interval=1", "kfac.n_statistics=16",
    "kfac.inverse_interval=3", "kfac.max_factor_size=5",
)  # fmt: skip
ADAM = ("adam.policy_rate=0.01", "adam.value_rate=0.01")
OWN = {
    "acktr": ("learning_rate=1e-4", "kl_clip=1e-5", "value_kl_clip=1e-4", "momentum=0.0", "n_probe=5", *KFAC),
    "acktr_adam": (*ADAM, *KFAC),
    "a2c": (*ADAM, "gradient_norm_max=1e-6"),
    "ppo": (*ADAM, "gradient_norm_max=1e-6", "clip=0.001"),
}


def overrides_of(algorithm: str, option: str) -> list[str]:
    if option == "advantage.kind=k_step":
        return ["algorithm/advantage=k_step", "algorithm.advantage.n_return_steps=2"]
    if option == "advantage.kind=gae":
        return ["algorithm/advantage=gae", "algorithm.advantage.gae_lambda=0.3"]
    return [f"algorithm.{option}"]


@cache
def usual_weights(algorithm: str) -> torch.Tensor:
    """After four iterations with the options as they stand."""
    return weights(train(config_of(algorithm), 4)[0])


@pytest.mark.parametrize("algorithm", TWO_FIRST)
def test_learns_the_corridor(algorithm: str) -> None:
    _, _, metrics = train(config_of(algorithm, *FASTER[algorithm], "algorithm.n_steps=16"), 60)
    assert metrics[0]["return_mean"] < 4
    assert metrics[-1]["return_mean"] > 8.5
    assert metrics[-1]["success_rate"] > 0.95


@pytest.mark.parametrize(
    ("algorithm", "option"), [(a, option) for a in ALGORITHMS for option in (*SHARED, *OWN[a])], ids=str
)
def test_every_option_acts(algorithm: str, option: str) -> None:
    changed = config_of(algorithm, *overrides_of(algorithm, option))
    assert not torch.equal(usual_weights(algorithm), weights(train(changed, 4)[0]))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_number_of_probed_decisions_acts_on_the_measured_kl(algorithm: str) -> None:
    few, many = (train(config_of(algorithm, f"algorithm.n_probe={n}"), 2)[2][-1]["kl"] for n in (5, 32))
    assert few != many


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("key", ["final_step_share", "final_entropy_share"])
def test_final_shares_act_with_progress(algorithm: str, key: str) -> None:
    configs = [config_of(algorithm, "algorithm.entropy_coefficient=0.1", f"algorithm.{key}={s}") for s in (0.5, 1.0)]
    half, whole = (train(config, 2, progress=1.0)[0] for config in configs)
    start, same = (train(config, 2, progress=0.0)[0] for config in configs)
    assert not torch.equal(weights(half), weights(whole))
    assert torch.equal(weights(start), weights(same))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_entropy_penalty_makes_a_policy_decided(algorithm: str) -> None:
    settling = [f"algorithm.entropy_penalty={value}" for value in ("{start: 0.0, coefficient: 1.0}", "null")]
    configs = [config_of(algorithm, *FASTER[algorithm], value) for value in settling]
    decided, neutral = (train(config, 20)[2][-1]["entropy"] for config in configs)
    assert decided < neutral


def test_lambda_acts() -> None:
    low, high = (
        train(config_of("acktr", "algorithm/advantage=gae", f"algorithm.advantage.gae_lambda={share}"), 2)[0]
        for share in (0.5, 0.9)
    )
    assert not torch.equal(weights(low), weights(high))


def test_number_of_patches_acts_on_convolutions() -> None:
    observation = torch.randint(0, 2, (8, 16, 1, 6, 6), generator=Generator().manual_seed(0)).float()
    rollout = replace(a_rollout(), observation=observation)
    results = []
    for n_patches in (16, 10_000):
        encoder = nn.Sequential(nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Flatten())
        policy = ActorCritic(encoder, 64, (8,), 2, torch.float32, Generator().manual_seed(0))
        config = config_of("acktr", f"algorithm.kfac.n_patches={n_patches}")
        Learner(policy, config, Generator().manual_seed(2)).update(rollout, 0.0)
        results.append(weights(policy))
    assert not torch.equal(*results)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_same_seed_same_weights(algorithm: str) -> None:
    assert torch.equal(usual_weights(algorithm), weights(train(config_of(algorithm), 4)[0]))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_resumed_equals_uninterrupted(algorithm: str) -> None:
    rollout, policy = a_rollout(), network()
    learner = Learner(policy, config_of(algorithm), Generator().manual_seed(2))
    for _ in range(3):
        learner.update(rollout, 0.0)
    saved, saved_policy = learner.state_dict(), {k: v.clone() for k, v in policy.state_dict().items()}
    saved = {name: value.clone() for name, value in saved.items()}
    other_policy = network(seed=9)
    other_policy.load_state_dict(saved_policy)
    other = Learner(other_policy, config_of(algorithm), Generator().manual_seed(77))
    other.load_state_dict(saved)
    for _ in range(3):
        assert learner.update(rollout, 0.0) == other.update(rollout, 0.0)
    assert torch.equal(weights(policy), weights(other_policy))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
def test_unusable_decisions_move_nothing(algorithm: str, poison: float) -> None:
    policy, rollout = network(), a_rollout()
    learner = Learner(policy, config_of(algorithm, "algorithm.minibatch_size=1000"), Generator().manual_seed(2))
    learner.update(rollout, 0.0)
    before = weights(policy)
    log_prob = torch.full_like(rollout.log_prob, poison)
    observation = torch.full_like(rollout.observation, poison)
    metrics = learner.update(replace(rollout, observation=observation, log_prob=log_prob), 0.0)
    assert torch.equal(before, weights(policy)) or _differs_in_scaling_only(policy, before)
    assert metrics["n_skipped"] > 0


def _differs_in_scaling_only(policy: ActorCritic, before: torch.Tensor) -> bool:
    """The value's last layer follows the statistics of the returns, without an update."""
    n_last = sum(p.numel() for p in policy.value_head[-1].parameters())
    return torch.equal(before[:-n_last], weights(policy)[:-n_last])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_scale_of_rewards_does_not_matter(algorithm: str) -> None:
    """Rewards sixteen times as large give the same actions' policy after some updates, up to rounding."""
    results = []
    for scale in (1.0, 16.0):
        policy, rollout = network(), a_rollout()
        learner = Learner(policy, config_of(algorithm), Generator().manual_seed(2))
        rollout = replace(
            rollout,
            reward=scale * rollout.reward,
            value=torch.zeros_like(rollout.value),
            final_value=torch.zeros_like(rollout.final_value),
            last_value=torch.zeros_like(rollout.last_value),
        )
        for _ in range(3):
            learner.update(rollout, 0.0)
        results.append(policy(torch.eye(7))[0].softmax(-1).detach())
    torch.testing.assert_close(*results, atol=1e-3, rtol=1e-3)
