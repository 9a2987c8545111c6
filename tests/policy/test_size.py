"""Sizes of layers that are known from the config are those of the network that is built from it."""

import torch
from composed import compose_config
from torch import Generator, nn

from negopipe.policy.grids import GridPolicyConfig, grid_actor_critic
from negopipe.policy.size import grid_layers


def test_layers_are_those_of_the_network() -> None:
    config = compose_config(["observation.n_cells=60", "policy.head_widths=[32]"])
    shape = (config.observation.n_frames, 60, 60)
    assert isinstance(config.policy, GridPolicyConfig)
    network = grid_actor_critic(config.policy, shape, torch.device("cpu"), Generator())
    outputs: list[tuple[nn.Module, torch.Tensor]] = []
    for layer in network.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            layer.register_forward_hook(lambda layer, _, output: outputs.append((layer, output)))
    network(torch.zeros(1, *shape, dtype=torch.uint8))
    built = [(sum(p.numel() for p in layer.parameters()), output[0].numel()) for layer, output in outputs]
    sizes = grid_layers(config.policy, shape).sizes
    assert [(size.n_weights, size.n_outputs * size.n_positions) for size in sizes] == built
