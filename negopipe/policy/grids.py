"""The paper's network: convolutions over occupancy grids, behind them a linear layer."""

from copy import deepcopy
from typing import Literal

import numpy as np
import torch
from torch import Generator, Tensor, nn

from negopipe.errors import UserError
from negopipe.policy.actor_critic import ActorCritic, Encoder, HeadsConfig, Policy
from negopipe.schema import PositiveInt, schema


@schema
class ConvConfig:
    """One convolution, followed by ReLU: output channels, side of the square kernel, stride (cells)."""

    channels: PositiveInt
    kernel: PositiveInt
    stride: PositiveInt


@schema
class GridPolicyConfig(HeadsConfig):
    """The paper's network.

    conv: convolutions over the grids, in order
    encoder_width: units of the linear layer behind them
    precision: arithmetic of the encoder
    memory_format: order in which the encoder's weights and maps lie in memory

    A run resolves `auto` (`negopipe.runtime.network_choice`). A policy that is built without a run takes `auto` for
    float32 and channels_last.
    """

    kind: Literal["cnn"]
    conv: tuple[ConvConfig, ...]
    encoder_width: PositiveInt
    precision: Literal["auto", "float32", "bfloat16"]
    memory_format: Literal["auto", "channels_last", "channels_first"]


def encoder_dtype(precision: str) -> torch.dtype:
    """torch's dtype of a `GridPolicyConfig.precision`."""
    return {"auto": torch.float32, "float32": torch.float32, "bfloat16": torch.bfloat16}[precision]


def encoder_memory_format(memory_format: str) -> torch.memory_format:
    """torch's memory format of a `GridPolicyConfig.memory_format`."""
    return torch.contiguous_format if memory_format == "channels_first" else torch.channels_last


class GridEncoder(Encoder):
    """Encoder of occupancy grids [E, C, H, W] (0 or 1) to features [E, encoder_width].

    UserError where the convolutions leave no cell of the grid.
    """

    def __init__(self, config: GridPolicyConfig, observation_shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.observation_shape = observation_shape
        channels, height, width = observation_shape
        layers: list[nn.Module] = []
        for conv in config.conv:
            layers += [nn.Conv2d(channels, conv.channels, conv.kernel, conv.stride), nn.ReLU()]
            channels = conv.channels
            height, width = ((side - conv.kernel) // conv.stride + 1 for side in (height, width))
        if min(height, width) < 1:
            raise UserError(f"policy.conv must leave at least one cell of a {observation_shape[1:]} grid, got none")
        self.convolutions = nn.Sequential(*layers)
        self.linear = nn.Linear(channels * height * width, config.encoder_width)
        self.memory_format = encoder_memory_format(config.memory_format)

    def forward(self, grid: Tensor) -> Tensor:
        maps = self.convolutions(grid.contiguous(memory_format=self.memory_format))
        return torch.relu(self.linear(maps.flatten(1)))

    def read(self, shown: np.ndarray) -> Tensor:
        """Bool grids: 0 = free and any other value occupied, so 0 and 255 of an environment or 0 and 1."""
        return torch.from_numpy(np.not_equal(shown, 0)).reshape(-1, *self.observation_shape)


def grid_actor_critic(
    config: GridPolicyConfig, observation_shape: tuple[int, int, int], device: torch.device, generator: Generator
) -> Policy:
    """The paper's network on `device`, for grids [C, H, W]. The weights depend on the CPU generator only."""
    policy = Policy(
        encoder=GridEncoder(config, observation_shape),
        n_features=config.encoder_width,
        head_widths=config.head_widths,
        n_actions=len(config.horizons_s),
        dtype=encoder_dtype(config.precision),
        generator=generator,
    )
    memory_format = encoder_memory_format(config.memory_format)
    return policy.to(device=device, memory_format=memory_format)  # type: ignore[call-overload]


def recast(policy: ActorCritic, precision: str, memory_format: str) -> ActorCritic:
    """Copy of a network for grids, with another precision and memory format."""
    other = deepcopy(policy)
    assert isinstance(other.encoder, GridEncoder)
    other.dtype, other.encoder.memory_format = encoder_dtype(precision), encoder_memory_format(memory_format)
    return other.to(memory_format=other.encoder.memory_format)  # type: ignore[call-overload]
