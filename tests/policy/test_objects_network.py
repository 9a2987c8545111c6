"""The network for objects: invariant to the order and the number of the others, refused where it does not fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from composed import compose_config
from corridor import TWO_FIRST
from games import tiny_config
from torch import Generator, Tensor, nn

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.policy.actor_critic import Policy
from negopipe.policy.kinds import build_policy, layers_of
from negopipe.tensors.row_blocks import RowBlocks
from negopipe.training.training import Training

CPU = torch.device("cpu")
OBJECTS = ("observation=objects", "policy=objects")


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return compose_config(OBJECTS)


def network(config: RunConfig, seed: int = 0) -> Policy:
    policy = build_policy(config.policy, config.observation.layout, CPU, Generator().manual_seed(seed))
    for head in (policy.policy_head, policy.value_head):  # first outputs are nearly equal for all observations
        nn.init.orthogonal_(head[-1].weight, generator=Generator().manual_seed(seed))  # type: ignore[arg-type]
    return policy


def layout(config: RunConfig) -> RowBlocks:
    assert isinstance(config.observation.layout, RowBlocks)
    return config.observation.layout


def rows(config: RunConfig, n: int, known: list[int]) -> Tensor:
    """Rows in which the others of these indices are known."""
    row = torch.randn(n, layout(config).n_numbers, generator=Generator().manual_seed(3))
    _, others, _ = layout(config).split(row)
    is_known = torch.zeros(others.shape[1], dtype=torch.bool)
    is_known[known] = True
    others *= is_known[:, None]
    others[..., 0] = is_known.float()
    return row


def test_outputs_have_the_shapes_of_the_papers_network(config: RunConfig) -> None:
    logits, value = network(config)(rows(config, 3, [0]))
    assert (logits.shape, value.shape) == ((3, 4), (3,))
    assert logits.dtype == value.dtype == torch.float32


def test_the_order_of_the_others_does_not_matter(config: RunConfig) -> None:
    policy, row = network(config), rows(config, 6, [0, 1, 3])
    turned = row.clone()
    _, others, _ = layout(config).split(turned)
    others.copy_(others[:, [3, 0, 2, 1]].clone())
    assert not torch.equal(row, turned)
    for found, expected in zip(policy(turned), policy(row), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)


def test_others_that_are_not_known_add_nothing(config: RunConfig) -> None:
    """The same weights for more places for others, which are empty."""
    more = compose_config([*OBJECTS, "observation.n_others=9"])
    few, many = network(config), network(more)
    assert {name: w.shape for name, w in few.state_dict().items()} == {
        name: w.shape for name, w in many.state_dict().items()
    }
    row = rows(config, 5, [0, 2])
    own, others, street = layout(config).split(row)
    padded = nn.functional.pad(others, (0, 0, 0, 5))
    wide = torch.cat([own, padded.flatten(1), street.flatten(1)], -1)
    for found, expected in zip(many(wide), few(row), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)


def test_every_block_counts(config: RunConfig) -> None:
    policy, row = network(config), rows(config, 4, [0])
    for index in range(3):
        changed = row.clone()
        block = layout(config).split(changed)[index]
        block[..., 1:] += 0.5 * (block[..., :1] if index == 1 else 1.0)
        assert not torch.allclose(policy(changed)[0], policy(row)[0], atol=1e-4)


def test_layers_are_those_of_the_network(config: RunConfig) -> None:
    policy = network(config)
    outputs: list[tuple[int, int]] = []
    for layer in policy.modules():
        if isinstance(layer, nn.Linear):
            layer.register_forward_hook(
                lambda layer, _, output: outputs.append((sum(p.numel() for p in layer.parameters()), output.numel()))
            )
    policy(rows(config, 1, [0]))
    sizes = layers_of(config.policy, config.observation.layout).sizes
    assert sorted((size.n_weights, size.n_outputs * size.n_positions) for size in sizes) == sorted(outputs)


def test_act_takes_observations_of_the_environment(config: RunConfig) -> None:
    policy, row = network(config), rows(config, 5, [0]).numpy()
    actions = policy.act(row)
    assert actions.tolist() == policy(torch.from_numpy(row))[0].argmax(-1).tolist()
    assert isinstance(policy.act(row[0]), np.int64)
    with pytest.raises(UserError, match=r"observation must be an array of shape \(\d+,\)"):
        policy.act(row[:, 1:])


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("observation=objects", "policy.kind must be objects .*, got cnn$"),
        ("policy=objects", "must be cnn .* objects$"),
    ],
)
def test_a_network_that_does_not_fit_the_observation_is_refused(override: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        compose_config([override])


@pytest.mark.parametrize("key", ["own_widths", "other_widths", "street_widths", "trunk_widths", "head_widths"])
def test_options_act(config: RunConfig, key: str) -> None:
    changed = replace(config, policy=replace(config.policy, **{key: (24, 16)}))  # type: ignore[arg-type]
    weights = (sum(p.numel() for p in network(each).parameters()) for each in (config, changed))
    assert len({*weights}) == 2


@pytest.mark.parametrize("algorithm", TWO_FIRST)
def test_every_algorithm_trains_it(algorithm: str) -> None:
    config = tiny_config("smoke", *OBJECTS, f"algorithm={algorithm}", "policy.horizons_s=[0,4,inf]", *GIVES_WAY)
    training = Training(config)
    before = {name: weight.clone() for name, weight in training.policy.named_parameters()}
    for _ in range(2):
        training.iterate()
    after = dict(training.policy.named_parameters())
    assert all(weight.isfinite().all() for weight in after.values())
    assert {name for name in before if not torch.equal(before[name], after[name])} == set(before)


GIVES_WAY = ("planner=consistent_stops",)
