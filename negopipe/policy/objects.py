"""The network for objects: one small network per kind of element, shared by its elements, and their maxima.

A maximum over the others does not depend on their order or their number (DeepSets, Zaheer et al. 2017).
"""

from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Generator, Tensor, nn

from negopipe.policy.actor_critic import Encoder, HeadsConfig, Policy, mlp
from negopipe.schema import PositiveInt, schema
from negopipe.tensors.row_blocks import RowBlocks

Widths = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
"""Units of linear layers in a row, each followed by ReLU."""


@schema
class ObjectsPolicyConfig(HeadsConfig):
    """The network for `observation=objects`.

    own_widths: layers over the numbers of the ego
    other_widths: layers over the numbers of each other road user, the same for all
    street_widths: layers over the numbers of each point of the street, the same for all
    trunk_widths: layers over these three together, the last two reduced to their maxima
    """

    kind: Literal["objects"]
    own_widths: Widths
    other_widths: Widths
    street_widths: Widths
    trunk_widths: Widths


class ObjectsEncoder(Encoder):
    """Encoder of rows [E, numbers] to features [E, trunk_widths[-1]]; others that are not known add nothing."""

    def __init__(self, config: ObjectsPolicyConfig, blocks: RowBlocks) -> None:
        super().__init__()
        self.blocks = blocks
        self.observation_shape = (blocks.n_numbers,)
        self.own = _rectified(blocks.own, config.own_widths)
        self.other = _rectified(blocks.others.width, config.other_widths)
        self.street = _rectified(blocks.street.width, config.street_widths)
        joined = config.own_widths[-1] + config.other_widths[-1] + config.street_widths[-1]
        self.trunk = _rectified(joined, config.trunk_widths)

    def forward(self, rows: Tensor) -> Tensor:
        own, others, street = self.blocks.split(rows)
        known = self.other(others) * others[..., :1]
        return self.trunk(torch.cat([self.own(own), known.amax(1), self.street(street).amax(1)], -1))

    def read(self, shown: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(shown, dtype=np.float32)).reshape(-1, *self.observation_shape)


def objects_actor_critic(
    config: ObjectsPolicyConfig, blocks: RowBlocks, device: torch.device, generator: Generator
) -> Policy:
    """The network for rows with these blocks on `device`. The weights depend on the CPU generator only."""
    policy = Policy(
        encoder=ObjectsEncoder(config, blocks),
        n_features=config.trunk_widths[-1],
        head_widths=config.head_widths,
        n_actions=len(config.horizons_s),
        dtype=torch.float32,
        generator=generator,
    )
    return policy.to(device=device)


def _rectified(n_inputs: int, widths: tuple[int, ...]) -> nn.Sequential:
    """Linear layers from `n_inputs` to the last of the widths with ReLU behind each."""
    return nn.Sequential(*mlp((n_inputs, *widths)), nn.ReLU())
