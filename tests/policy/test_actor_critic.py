"""The network: shapes, size, initialisation, units of the value."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from pydantic import TypeAdapter
from torch import Generator, Tensor

from negopipe.errors import UserError
from negopipe.policy.actor_critic import (
    ActorCritic,
    PolicyConfig,
    encoder_dtype,
    greedy_action,
    grid_actor_critic,
    sample_action,
)

CPU = torch.device("cpu")
YAML = Path(__file__).parents[2] / "conf" / "policy" / "cnn.yaml"


@pytest.fixture(scope="module")
def config() -> PolicyConfig:
    loaded = TypeAdapter(PolicyConfig).validate_python(yaml.safe_load(YAML.read_text()))
    return replace(loaded, precision="float32")


def network(config: PolicyConfig, seed: int = 0) -> ActorCritic:
    return grid_actor_critic(config, (4, 84, 84), CPU, Generator().manual_seed(seed))


def grids(n: int) -> Tensor:
    return torch.randint(0, 2, (n, 4, 84, 84), generator=Generator().manual_seed(5)).to(torch.uint8)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_outputs_have_the_paper_shapes(config: PolicyConfig, precision: str) -> None:
    logits, value = network(replace(config, precision=precision))(grids(3))
    assert logits.shape == (3, 4)
    assert value.shape == (3,)
    assert logits.dtype == value.dtype == torch.float32


def test_parameter_count_by_hand(config: PolicyConfig) -> None:
    convolutions = (4 * 64 + 1) * 32 + (32 * 16 + 1) * 64 + (64 * 9 + 1) * 64
    encoder = convolutions + (64 * 7 * 7 + 1) * 512
    trunk = (512 + 1) * 128 + (128 + 1) * 128
    heads = 2 * trunk + (128 + 1) * 4 + (128 + 1)
    assert sum(p.numel() for p in network(config).parameters()) == encoder + heads


def test_seed_decides_the_weights(config: PolicyConfig) -> None:
    first, same, other = (network(config, seed).state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not torch.equal(first["encoder.linear.weight"], other["encoder.linear.weight"])


def test_first_policy_is_nearly_uniform_and_first_values_nearly_equal(config: PolicyConfig) -> None:
    logits, value = network(config)(grids(8))
    torch.testing.assert_close(logits.softmax(-1), torch.full((8, 4), 0.25), atol=0.01, rtol=0)
    assert value.std() < 0.05


def test_bfloat16_is_close_to_float32_and_not_equal(config: PolicyConfig) -> None:
    exact = network(config)(grids(4))[0]
    rounded = network(replace(config, precision="bfloat16"))(grids(4))[0]
    assert not torch.equal(exact, rounded)
    torch.testing.assert_close(exact, rounded, atol=1e-3, rtol=0.1)


def test_auto_precision_is_what_the_processor_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    assert encoder_dtype("auto", CPU) == torch.bfloat16
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": False})
    assert encoder_dtype("auto", CPU) == torch.float32


@pytest.mark.parametrize("keep_value", [True, False])
def test_rescaling(config: PolicyConfig, keep_value: bool) -> None:
    policy = network(config)
    before = policy(grids(4))[1].detach()
    policy.rescale_value(torch.tensor(-20.0), torch.tensor(7.0), keep_value)
    expected = before if keep_value else -20 + 7 * before
    torch.testing.assert_close(policy(grids(4))[1].detach(), expected, atol=1e-4, rtol=1e-4)


def test_actions_follow_the_probabilities() -> None:
    probabilities = torch.tensor([0.1, 0.6, 0.3])
    logits = probabilities.log().expand(20_000, 3)
    action = sample_action(logits, Generator().manual_seed(0))
    share = torch.bincount(action, minlength=3) / len(action)
    torch.testing.assert_close(share, probabilities, atol=0.015, rtol=0)
    assert torch.equal(action, sample_action(logits, Generator().manual_seed(0)))
    assert greedy_action(logits[:2]).tolist() == [1, 1]


def test_too_small_grid_is_the_users_error(config: PolicyConfig) -> None:
    with pytest.raises(UserError, match=r"policy\.conv"):
        grid_actor_critic(config, (4, 20, 20), CPU, Generator())
