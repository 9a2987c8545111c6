"""The network of the paper: a shared encoder, a policy head and a value head."""

import math
from copy import deepcopy
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Generator, Tensor, nn

from negopipe.errors import UserError
from negopipe.schema import Distinct, Horizon, PositiveInt, schema

HIDDEN_GAIN = math.sqrt(2)
LAST_GAIN = 0.01
"""Gain of the last layers of both heads. It is small, so that the first policy is nearly uniform and the first values
are nearly equal. Random first values would be unlearned by shrinking the shared encoder, which can disable it."""


@schema
class ConvConfig:
    """One convolution, followed by ReLU: output channels, side of the square kernel, stride (cells)."""

    channels: PositiveInt
    kernel: PositiveInt
    stride: PositiveInt


@schema
class PolicyConfig:
    """The network and the actions it chooses from.

    conv: convolutions over the grids, in order
    encoder_width: units of the linear layer behind them
    head_widths: hidden units of the policy head and of the value head, alike
    horizons_s: action i makes the ego predict `horizons_s[i]` seconds ahead
    precision: arithmetic of the encoder
    memory_format: order in which the encoder's weights and maps lie in memory

    A run resolves `auto` (`negopipe.runtime.network_choice`). A policy that is built without a run takes `auto` for
    float32 and channels_last.
    """

    conv: tuple[ConvConfig, ...]
    encoder_width: PositiveInt
    head_widths: tuple[PositiveInt, ...]
    horizons_s: Annotated[tuple[Horizon, ...], Field(min_length=2), Distinct]
    precision: Literal["auto", "float32", "bfloat16"]
    memory_format: Literal["auto", "channels_last", "channels_first"]


def encoder_dtype(precision: str) -> torch.dtype:
    """torch's dtype of a `PolicyConfig.precision`."""
    return {"auto": torch.float32, "float32": torch.float32, "bfloat16": torch.bfloat16}[precision]


def encoder_memory_format(memory_format: str) -> torch.memory_format:
    """torch's memory format of a `PolicyConfig.memory_format`."""
    return torch.contiguous_format if memory_format == "channels_first" else torch.channels_last


class ActorCritic(nn.Module):
    """pi(a|s) and V(s) on a shared encoder.

    The output of the value head is a normalised value v. V = value_mean + value_std * v is in units of return, as are
    all values outside this class. `rescale_value` changes mean and scale without changing V.

    encoder: maps observations [E, *obs] to features [E, n_features], float32 or, under autocast, `dtype`
    """

    value_mean: Tensor
    value_std: Tensor

    def __init__(
        self,
        encoder: nn.Module,
        n_features: int,
        head_widths: tuple[int, ...],
        n_actions: int,
        dtype: torch.dtype,
        generator: Generator,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.policy_head = mlp((n_features, *head_widths, n_actions))
        self.value_head = mlp((n_features, *head_widths, 1))
        self.dtype = dtype
        self.register_buffer("value_mean", torch.zeros(()))
        self.register_buffer("value_std", torch.ones(()))
        self._initialise(generator)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Observations [E, *obs] -> logits [E, A] float32, V [E] float32 in units of return."""
        device = observation.device.type
        with torch.autocast(device, dtype=self.dtype, enabled=self.dtype != torch.float32):
            features = self.encoder(observation.to(self.dtype)).float()
        logits = self.policy_head(features)
        value = self.value_head(features).squeeze(-1)
        return logits, self.value_mean + self.value_std * value

    @torch.no_grad()
    def rescale_value(self, mean: Tensor, std: Tensor, keep_value: bool) -> None:
        """Set value_mean and value_std.

        keep_value: adapt the last layer so that V stays the same (van Hasselt 2016); otherwise V is rescaled
        """
        last = self.value_head[-1]
        assert isinstance(last, nn.Linear)
        if keep_value:
            last.weight.mul_(self.value_std / std)
            last.bias.mul_(self.value_std / std).add_((self.value_mean - mean) / std)
        self.value_mean.copy_(mean)
        self.value_std.copy_(std)

    def _initialise(self, generator: Generator) -> None:
        for layer in self.modules():
            if isinstance(layer, nn.Linear | nn.Conv2d):
                nn.init.orthogonal_(layer.weight, HIDDEN_GAIN, generator=generator)
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            for head in (self.policy_head, self.value_head):
                head[-1].weight.mul_(LAST_GAIN / HIDDEN_GAIN)  # type: ignore[operator,union-attr]


class GridEncoder(nn.Module):
    """Encoder of occupancy grids [E, C, H, W] (0 or 1) to features [E, encoder_width].

    UserError where the convolutions leave no cell of the grid.
    """

    def __init__(self, config: PolicyConfig, observation_shape: tuple[int, int, int]) -> None:
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


class GridPolicy(ActorCritic):
    """The actor-critic whose encoder is a `GridEncoder`."""

    @torch.no_grad()
    def act(self, grids: np.ndarray) -> Any:
        """The most probable action for the grids that an environment shows, as its `step` takes it.

        grids: [F, H, W] of one world, or [E, F, H, W]; 0 = free and any other value occupied, so 0 and 255 of
            `negopipe.envs.gymnasium` or 0 and 1. UserError for another shape
        Returns an int64 number for one world, [E] int64 for E worlds.
        """
        assert isinstance(self.encoder, GridEncoder)
        shape = self.encoder.observation_shape
        if np.shape(grids)[-3:] != shape or np.ndim(grids) not in (3, 4):
            allowed = f"an array of shape {shape}, or of several of them"
            raise UserError(f"grids must be {allowed}, got the shape {np.shape(grids)}")
        occupied = torch.from_numpy(np.not_equal(grids, 0)).reshape(-1, *shape).to(self.value_mean.device)
        return greedy_action(self(occupied)[0]).cpu().numpy().reshape(np.shape(grids)[:-3])[()]


def grid_actor_critic(
    config: PolicyConfig, observation_shape: tuple[int, int, int], device: torch.device, generator: Generator
) -> GridPolicy:
    """The paper's network on `device`, for grids [C, H, W]. The weights depend on the CPU generator only."""
    policy = GridPolicy(
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


def mlp(widths: tuple[int, ...]) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with ReLU between them."""
    layers: list[nn.Module] = []
    for n_inputs, n_outputs in pairwise(widths):
        layers += [nn.Linear(n_inputs, n_outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def sample_action(logits: Tensor, generator: Generator) -> Tensor:
    """Draw actions [E] int64 from the policy with logits [E, A]."""
    return torch.multinomial(logits.softmax(-1), 1, generator=generator).squeeze(-1)


def log_prob_of(action: Tensor, log_probs: Tensor) -> Tensor:
    """log pi(a|s) [E] of the actions [E] int64, where log_probs [E, A] has that of every action."""
    return log_probs.gather(1, action[:, None]).squeeze(1)


def greedy_action(logits: Tensor) -> Tensor:
    """The most probable actions [E] int64 of the policy with logits [E, A]."""
    return logits.argmax(-1)
