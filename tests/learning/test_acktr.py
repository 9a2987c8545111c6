"""ACKTR: every option acts, the trust regions hold, seeds repeat, a corridor is solved."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from pydantic import TypeAdapter
from rollouts import episode_statistics
from torch import Generator, Tensor, nn

from negopipe.learning.acktr import Acktr, AcktrConfig, inner, minibatches, shortening, trust_region_step
from negopipe.learning.rollout import Rollout, RunningEpisodes, Transition, collect
from negopipe.policy.actor_critic import ActorCritic, mlp

CPU = torch.device("cpu")
YAML = Path(__file__).parents[2] / "conf" / "algorithm" / "acktr.yaml"
SMALL: dict[str, Any] = {"n_worlds": 16, "n_steps": 8, "n_return_steps": 5, "minibatch_size": 64}
SMALL_KFAC = {"n_statistics": 32, "statistics_interval": 2, "inverse_interval": 2}


class Corridor:
    """Cells 0 to 6, start at 3: action 1 moves up, 0 down. Cell 6 gives +10, cell 0 -10, each step costs 0.25.

    Cut off after 12 steps. The best return is 10 - 3 * 0.25 = 9.25.
    """

    def __init__(self, n_worlds: int) -> None:
        self.n_worlds = n_worlds
        self.cell = torch.full((n_worlds,), 3)
        self.steps = torch.zeros(n_worlds, dtype=torch.int64)

    def observe(self) -> Tensor:
        return nn.functional.one_hot(self.cell, 7).float()

    def step(self, action: Tensor) -> Transition:
        cell, self.steps = self.cell + 2 * action - 1, self.steps + 1
        is_success, is_collision = cell == 6, cell == 0
        is_terminated = is_success | is_collision
        is_truncated = (self.steps == 12) & ~is_terminated
        is_done = is_terminated | is_truncated
        self.cell = torch.where(is_done, 3, cell)
        self.steps = torch.where(is_done, 0, self.steps)
        reward = torch.where(is_success, 10.0, 0.0) + torch.where(is_collision, -10.0, 0.0) - 0.25
        final = nn.functional.one_hot(cell[is_done], 7).float()
        return Transition(self.observe(), final, reward, is_terminated, is_truncated, is_success, is_collision)


def config(**changes: Any) -> AcktrConfig:
    values = yaml.safe_load(YAML.read_text()) | SMALL
    values["kfac"] = values["kfac"] | SMALL_KFAC | changes.pop("kfac", {})
    return TypeAdapter(AcktrConfig).validate_python(values | changes)


def network(seed: int = 0) -> ActorCritic:
    encoder = nn.Sequential(mlp((7, 16)), nn.ReLU())
    return ActorCritic(encoder, 16, (16,), 2, torch.float32, Generator().manual_seed(seed))


def train(
    cfg: AcktrConfig, n_iterations: int, progress: float = 0.0
) -> tuple[ActorCritic, Acktr, list[dict[str, float]]]:
    policy, actions = network(), Generator().manual_seed(1)
    learner = Acktr(policy, cfg, Generator().manual_seed(2))
    env, running, metrics = Corridor(cfg.n_worlds), RunningEpisodes.start(cfg.n_worlds, CPU), []
    for _ in range(n_iterations):
        rollout, running = collect(env, policy, cfg.n_steps, actions, running)
        metrics.append(learner.update(rollout, progress) | episode_statistics(rollout))
    return policy, learner, metrics


def weights(policy: ActorCritic) -> Tensor:
    return torch.cat([p.detach().flatten() for p in policy.parameters()])


def a_rollout() -> Rollout:
    return collect(Corridor(16), network(), 8, Generator().manual_seed(1), RunningEpisodes.start(16, CPU))[0]


def test_learns_the_corridor() -> None:
    _, _, metrics = train(config(kl_clip=0.01, n_steps=16), 60)
    assert metrics[0]["return_mean"] < 4
    assert metrics[-1]["return_mean"] > 8.5
    assert metrics[-1]["success_rate"] > 0.95


@pytest.mark.parametrize(
    "change",
    [
        {"n_worlds": 8},
        {"n_steps": 6},
        {"minibatch_size": 50},
        {"gamma": 0.9},
        {"n_return_steps": 2},
        {"learning_rate": 1e-4},
        {"kl_clip": 1e-5},
        {"value_kl_clip": 1e-4},
        {"momentum": 0.0},
        {"value_coefficient": 0.1},
        {"entropy_coefficient": 0.5},
        {"return_decay": 0.2},
        {"kfac": {"damping": 0.1}},
        {"kfac": {"statistics_decay": 0.1}},
        {"kfac": {"statistics_interval": 1}},
        {"kfac": {"n_statistics": 16}},
        {"kfac": {"inverse_interval": 3}},
        {"kfac": {"max_factor_size": 5}},
    ],
    ids=str,
)
def test_every_option_acts(change: dict[str, Any]) -> None:
    assert not torch.equal(weights(train(config(), 4)[0]), weights(train(config(**change), 4)[0]))


def test_final_step_share_acts_with_progress() -> None:
    half, whole = (train(config(final_step_share=share), 2, progress=1.0)[0] for share in (0.5, 1.0))
    start, same = (train(config(final_step_share=share), 2, progress=0.0)[0] for share in (0.5, 1.0))
    assert not torch.equal(weights(half), weights(whole))
    assert torch.equal(weights(start), weights(same))


def test_number_of_patches_acts_on_convolutions() -> None:
    observation = torch.randint(0, 2, (8, 16, 1, 6, 6), generator=Generator().manual_seed(0)).float()
    rollout = replace(a_rollout(), observation=observation)
    results = []
    for n_patches in (16, 10_000):
        encoder = nn.Sequential(nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Flatten())
        policy = ActorCritic(encoder, 64, (8,), 2, torch.float32, Generator().manual_seed(0))
        learner = Acktr(policy, config(kfac={"n_patches": n_patches}), Generator().manual_seed(2))
        learner.update(rollout, 0.0)
        results.append(weights(policy))
    assert not torch.equal(*results)


def test_same_seed_same_weights() -> None:
    assert torch.equal(weights(train(config(), 5)[0]), weights(train(config(), 5)[0]))


def test_resumed_equals_uninterrupted() -> None:
    rollout = a_rollout()
    policy = network()
    learner = Acktr(policy, config(), Generator().manual_seed(2))
    for _ in range(3):
        learner.update(rollout, 0.0)
    saved, saved_policy = learner.state_dict(), {k: v.clone() for k, v in policy.state_dict().items()}
    saved = {name: value.clone() for name, value in saved.items()}
    other_policy = network(seed=9)
    other_policy.load_state_dict(saved_policy)
    other = Acktr(other_policy, config(), Generator().manual_seed(77))
    other.load_state_dict(saved)
    for _ in range(3):
        assert learner.update(rollout, 0.0) == other.update(rollout, 0.0)
    assert torch.equal(weights(policy), weights(other_policy))
    assert all(value.is_contiguous() for value in saved.values())


def test_trust_region_bounds_the_quadratic_form() -> None:
    quadratic = torch.tensor([0.0, 1e-6, 0.3, 50.0])
    eta = trust_region_step(quadratic, 0.001, 0.25)
    assert (0.5 * eta.square() * quadratic <= 0.001 * (1 + 1e-5)).all()
    assert eta[:2].tolist() == [0.25, 0.25]


def test_step_stays_within_the_undamped_trust_region() -> None:
    policy = network()
    learner = Acktr(policy, config(momentum=0.0, minibatch_size=1000), Generator().manual_seed(2))
    before = {name: matrix(layer) for name, layer in learner.kfac.layers.items()}
    learner.update(a_rollout(), 0.0)
    bounds = {"policy": 0.0, "value": 0.0}
    for name, layer in learner.kfac.layers.items():
        step, factors = matrix(layer) - before[name], learner.kfac.factors[name]
        if name.startswith("value_head.2"):  # rescaling moved this layer too
            continue
        group = "value" if name.startswith("value_head") else "policy"
        bounds[group] += 0.5 * float((step * (factors.outputs @ step @ factors.inputs[0])).sum())
    assert 0 < bounds["policy"] <= learner.config.kl_clip
    assert 0 < bounds["value"] <= learner.config.value_kl_clip


def matrix(layer: nn.Linear | nn.Conv2d) -> Tensor:
    assert layer.bias is not None
    return torch.cat([layer.weight.detach().flatten(1), layer.bias.detach()[:, None]], 1).clone()


def test_measured_kl_keeps_to_the_clips() -> None:
    _, _, metrics = train(config(kl_clip=0.002, value_kl_clip=0.005), 25)
    assert max(m["kl"] for m in metrics) < 0.002 * 1.3
    assert max(m["value_kl"] for m in metrics) < 0.005 * 1.3
    assert max(m["kl"] for m in metrics) > 0.0005


def test_shortening_makes_a_quadratic_kl_fit() -> None:
    kl = torch.tensor([0.0, 0.5, 4.0, torch.nan, torch.inf])
    share = shortening(kl, 1.0)
    assert share.tolist() == [1.0, 1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("poison", ["nan", "zero"])
def test_unusable_gradients_move_nothing(poison: str) -> None:
    policy = network()
    learner = Acktr(policy, config(minibatch_size=1000), Generator().manual_seed(2))
    learner.update(a_rollout(), 0.0)
    before = weights(policy)
    zero = {name: torch.zeros_like(matrix(layer)) for name, layer in learner.kfac.layers.items()}
    if poison == "nan":
        zero["policy_head.0"][0, 0] = torch.nan
    probe = torch.eye(7)
    old = tuple(x.detach() for x in policy(probe))
    learner._descend(zero, 1.0, probe, (old[0].log_softmax(-1), old[1]))
    assert torch.equal(before, weights(policy))
    assert learner.n_skipped == 1


def test_uphill_momentum_is_dropped() -> None:
    learner = Acktr(network(), config(), Generator().manual_seed(2))
    learner.update(a_rollout(), 0.0)
    gradient = {name: torch.ones_like(m) for name, m in learner.momentum.items()}
    learner.momentum = {name: -100 * g for name, g in gradient.items()}
    momentum, v = learner._direction(gradient)
    assert all(torch.equal(momentum[name], gradient[name]) for name in gradient)
    assert inner(v, gradient) > 0


def test_scale_of_rewards_does_not_matter() -> None:
    """Rewards ten times as large give the same actions' policy after some updates, up to rounding."""
    results = []
    for scale in (1.0, 16.0):
        policy = network()
        learner = Acktr(policy, config(), Generator().manual_seed(2))
        rollout = a_rollout()
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


def test_minibatches_partition_the_decisions() -> None:
    parts = list(minibatches(100, 48, Generator().manual_seed(0)))
    assert [len(part) for part in parts] == [34, 34, 32]
    assert torch.cat(parts).sort().values.tolist() == list(range(100))
