"""The network: shapes, size, initialisation, units of the value."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from pydantic import TypeAdapter
from torch import Generator, Tensor

from negopipe.errors import UserError
from negopipe.policy.actor_critic import ActorCritic, greedy_action, sample_action
from negopipe.policy.grids import GridPolicyConfig, grid_actor_critic, recast

CPU = torch.device("cpu")
YAML = Path(__file__).parents[2] / "conf" / "policy" / "cnn.yaml"


@pytest.fixture(scope="module")
def config() -> GridPolicyConfig:
    loaded = TypeAdapter(GridPolicyConfig).validate_python(yaml.safe_load(YAML.read_text()))
    return replace(loaded, precision="float32", memory_format="channels_last")


def network(config: GridPolicyConfig, seed: int = 0) -> ActorCritic:
    return grid_actor_critic(config, (4, 84, 84), CPU, Generator().manual_seed(seed))


def grids(n: int) -> Tensor:
    return torch.randint(0, 2, (n, 4, 84, 84), generator=Generator().manual_seed(5)).to(torch.uint8)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_outputs_have_the_paper_shapes(config: GridPolicyConfig, precision: str) -> None:
    logits, value = network(replace(config, precision=precision))(grids(3))
    assert logits.shape == (3, 4)
    assert value.shape == (3,)
    assert logits.dtype == value.dtype == torch.float32


def test_parameter_count_by_hand(config: GridPolicyConfig) -> None:
    convolutions = (4 * 64 + 1) * 32 + (32 * 16 + 1) * 64 + (64 * 9 + 1) * 64
    encoder = convolutions + (64 * 7 * 7 + 1) * 512
    trunk = (512 + 1) * 128 + (128 + 1) * 128
    heads = 2 * trunk + (128 + 1) * 4 + (128 + 1)
    assert sum(p.numel() for p in network(config).parameters()) == encoder + heads


def test_seed_decides_the_weights(config: GridPolicyConfig) -> None:
    first, same, other = (network(config, seed).state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not torch.equal(first["encoder.linear.weight"], other["encoder.linear.weight"])


def test_first_policy_is_nearly_uniform_and_first_values_nearly_equal(config: GridPolicyConfig) -> None:
    logits, value = network(config)(grids(8))
    torch.testing.assert_close(logits.softmax(-1), torch.full((8, 4), 0.25), atol=0.01, rtol=0)
    assert value.std() < 0.05


def test_bfloat16_is_close_to_float32_and_not_equal(config: GridPolicyConfig) -> None:
    exact = network(config)(grids(4))[0]
    rounded = network(replace(config, precision="bfloat16"))(grids(4))[0]
    assert not torch.equal(exact, rounded)
    torch.testing.assert_close(exact, rounded, atol=1e-3, rtol=0.1)


def formats(policy: ActorCritic) -> list[torch.memory_format]:
    """In which the weights of the convolutions, their gradients and the maps behind them lie."""
    maps: list[Tensor] = []
    layers = [layer for layer in policy.modules() if isinstance(layer, torch.nn.Conv2d)]
    handles = [layer.register_forward_hook(lambda *call: maps.append(call[-1])) for layer in layers]
    policy(grids(2))[1].sum().backward()
    for handle in handles:
        handle.remove()
    gradients = [layer.weight.grad for layer in layers]
    tensors = [*(layer.weight for layer in layers), *(g for g in gradients if g is not None), *maps]
    assert len(tensors) == 3 * 3
    names = (torch.contiguous_format, torch.channels_last)
    assert all(sum(tensor.is_contiguous(memory_format=name) for name in names) == 1 for tensor in tensors)
    return [name for tensor in tensors for name in names if tensor.is_contiguous(memory_format=name)]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize(
    ("name", "expected"), [("channels_last", torch.channels_last), ("channels_first", torch.contiguous_format)]
)
def test_the_memory_format_reaches_weights_and_maps(
    config: GridPolicyConfig, precision: str, name: str, expected: torch.memory_format
) -> None:
    policy = network(replace(config, precision=precision, memory_format=name))
    assert set(formats(policy)) == {expected}


def test_the_memory_format_changes_rounding_only(config: GridPolicyConfig) -> None:
    last, first = (network(replace(config, memory_format=f"channels_{side}")) for side in ("last", "first"))
    assert all(torch.equal(weight, first.state_dict()[name]) for name, weight in last.state_dict().items())
    torch.testing.assert_close(last(grids(3)), first(grids(3)), atol=1e-5, rtol=1e-4)


def test_a_network_can_be_recast(config: GridPolicyConfig) -> None:
    policy = network(config)
    other = recast(policy, "bfloat16", "channels_first")
    expected = network(replace(config, precision="bfloat16", memory_format="channels_first"))
    assert torch.equal(other(grids(3))[0], expected(grids(3))[0])
    assert set(formats(other)) == {torch.contiguous_format}
    assert (policy.dtype, set(formats(policy))) == (torch.float32, {torch.channels_last})


def test_apart_from_a_run_auto_is_float32_and_channels_last(config: GridPolicyConfig) -> None:
    policy = network(replace(config, precision="auto", memory_format="auto"))
    assert (policy.dtype, set(formats(policy))) == (torch.float32, {torch.channels_last})


@pytest.mark.parametrize("keep_value", [True, False])
def test_rescaling(config: GridPolicyConfig, keep_value: bool) -> None:
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


def test_too_small_grid_is_the_users_error(config: GridPolicyConfig) -> None:
    with pytest.raises(UserError, match=r"policy\.conv"):
        grid_actor_critic(config, (4, 20, 20), CPU, Generator())
