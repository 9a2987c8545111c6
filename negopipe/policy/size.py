"""Sizes of the network's layers, known from its config alone, and the memory that its weights take."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Memory
from negopipe.policy.actor_critic import HeadsConfig
from negopipe.policy.grids import ConvConfig, GridPolicyConfig
from negopipe.policy.objects import ObjectsPolicyConfig
from negopipe.tensors.row_blocks import RowBlocks


class LayerSize(NamedTuple):
    """Inputs of one position and outputs, without the bias; positions that it is applied at, 1 for a plain layer."""

    n_inputs: int
    n_outputs: int
    n_positions: int

    @property
    def n_weights(self) -> int:
        return (self.n_inputs + 1) * self.n_outputs


class Layers(NamedTuple):
    """All layers of a network, in the order in which they are built.

    weight_keys: dotted keys that the number of weights depends on
    position_keys: dotted keys that the outputs of layers with several positions depend on
    """

    sizes: list[LayerSize]
    weight_keys: tuple[str, ...]
    position_keys: tuple[str, ...]

    @property
    def n_outputs(self) -> int:
        """Numbers that all layers put out for one observation."""
        return sum(layer.n_outputs * layer.n_positions for layer in self.sizes)

    @property
    def memory(self) -> Memory:
        """Memory of the weights with their gradients and what an optimiser keeps of them."""
        n_weights = sum(layer.n_weights for layer in self.sizes)
        return Memory("the network", n_weights * FLOAT_BYTES * N_TEMPORARIES, self.weight_keys)


def map_sides(convolutions: Sequence[ConvConfig], n_cells: int) -> list[int]:
    """Cells along a side of the grid and of the map behind each convolution."""
    sides = [n_cells]
    for conv in convolutions:
        sides.append((sides[-1] - conv.kernel) // conv.stride + 1)
    return sides


def grid_layers(config: GridPolicyConfig, shape: tuple[int, int, int]) -> Layers:
    """Convolutions, the encoder's linear layer, the policy head, the value head, for grids (F, H, W)."""
    n_frames, n_cells, _ = shape
    sides = map_sides(config.conv, n_cells)
    channels = [n_frames, *(conv.channels for conv in config.conv)]
    behind = zip(pairwise(channels), config.conv, sides[1:], strict=True)
    layers = [LayerSize(n_in * conv.kernel**2, n_out, side**2) for (n_in, n_out), conv, side in behind]
    layers.append(LayerSize(channels[-1] * sides[-1] ** 2, config.encoder_width, 1))
    grid = ("observation.n_cells", "observation.n_frames")
    return Layers(
        layers + _heads(config, config.encoder_width),
        ("policy.encoder_width", "policy.head_widths", "policy.conv", *grid),
        ("policy.conv", "observation.n_cells"),
    )


def objects_layers(config: ObjectsPolicyConfig, blocks: RowBlocks) -> Layers:
    """The layers of the ego, of each other, of each point of the street, the trunk and both heads."""
    joined = config.own_widths[-1] + config.other_widths[-1] + config.street_widths[-1]
    layers = [
        *_in_a_row((blocks.own, *config.own_widths), 1),
        *_in_a_row((blocks.others.width, *config.other_widths), blocks.others.n),
        *_in_a_row((blocks.street.width, *config.street_widths), blocks.street.n),
        *_in_a_row((joined, *config.trunk_widths), 1),
    ]
    element_keys = ("policy.other_widths", "policy.street_widths")
    return Layers(
        layers + _heads(config, config.trunk_widths[-1]),
        (*element_keys, "policy.own_widths", "policy.trunk_widths", "policy.head_widths", "observation.n_frames"),
        (*element_keys, "observation.n_others", "observation.n_points"),
    )


def _heads(config: HeadsConfig, n_features: int) -> list[LayerSize]:
    return [
        layer
        for n_outputs in (len(config.horizons_s), 1)
        for layer in _in_a_row((n_features, *config.head_widths, n_outputs), 1)
    ]


def _in_a_row(widths: tuple[int, ...], n_positions: int) -> list[LayerSize]:
    return [LayerSize(n_in, n_out, n_positions) for n_in, n_out in pairwise(widths)]
