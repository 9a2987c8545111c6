"""The network: an encoder of observations that a policy head and a value head share."""

import math
from itertools import pairwise
from typing import Annotated, Any

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
class HeadsConfig:
    """The heads of a network and the actions it chooses from.

    head_widths: hidden units of the policy head and of the value head, alike
    horizons_s: action i makes the ego predict `horizons_s[i]` seconds ahead
    """

    head_widths: tuple[PositiveInt, ...]
    horizons_s: Annotated[tuple[Horizon, ...], Field(min_length=2), Distinct]


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


class Encoder(nn.Module):
    """An encoder of the observations that an environment shows: [E, *obs] -> features [E, n_features]."""

    observation_shape: tuple[int, ...]

    def read(self, shown: np.ndarray) -> Tensor:
        """Observations for the network [N, *obs], from those of an environment [..., *obs]."""
        raise NotImplementedError


class Policy(ActorCritic):
    """An actor-critic that takes the observations of an environment as they are."""

    @torch.no_grad()
    def act(self, observation: np.ndarray) -> Any:
        """The most probable action for the observations of an environment, as its `step` takes it.

        observation: [*obs] of one world, or [E, *obs]; UserError for another shape
        Returns an int64 number for one world, [E] int64 for E worlds.
        """
        encoder = self.encoder
        assert isinstance(encoder, Encoder)
        shape = encoder.observation_shape
        n_axes = len(shape)
        if np.shape(observation)[-n_axes:] != shape or np.ndim(observation) not in (n_axes, n_axes + 1):
            allowed = f"an array of shape {shape}, or of several of them"
            raise UserError(f"observation must be {allowed}, got the shape {np.shape(observation)}")
        rows = encoder.read(observation).to(self.value_mean.device)
        return greedy_action(self(rows)[0]).cpu().numpy().reshape(np.shape(observation)[:-n_axes])[()]


def mlp(widths: tuple[int, ...]) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with ReLU between them."""
    layers: list[nn.Module] = []
    for n_inputs, n_outputs in pairwise(widths):
        layers += [nn.Linear(n_inputs, n_outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def sample_action(logits: Tensor, generator: Generator) -> Tensor:
    """Draw actions [E] int64 from the policy with logits [E, A]."""
    return torch.multinomial(logits.softmax(-1), 1, generator=generator).squeeze(-1)


def action_of_draw(logits: Tensor, draw: Tensor) -> Tensor:
    """Actions [E] int64 of the policy with logits [E, A], by inversion of the cumulative probabilities.

    draw: [E] uniform numbers in (0, 1)
    """
    until = logits.float().softmax(-1).cumsum(-1)
    return (draw[:, None] > until).sum(-1).clamp(max=logits.shape[-1] - 1)


def log_prob_of(action: Tensor, log_probs: Tensor) -> Tensor:
    """log pi(a|s) [E] of the actions [E] int64, where log_probs [E, A] has that of every action."""
    return log_probs.gather(1, action[:, None]).squeeze(1)


def greedy_action(logits: Tensor) -> Tensor:
    """The most probable actions [E] int64 of the policy with logits [E, A]."""
    return logits.argmax(-1)
