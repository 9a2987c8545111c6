"""Sizes of the network's layers, known from its config alone, and the memory that its weights take."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Foresight, Memory, Problem, check_horizons
from negopipe.policy.actor_critic import ConvConfig, PolicyConfig


class LayerSize(NamedTuple):
    """Inputs of one position and outputs, without the bias; side of the square output map, 1 for a linear layer."""

    n_inputs: int
    n_outputs: int
    side: int

    @property
    def n_weights(self) -> int:
        return (self.n_inputs + 1) * self.n_outputs


def map_sides(convolutions: Sequence[ConvConfig], n_cells: int) -> list[int]:
    """Cells along a side of the grid and of the map behind each convolution."""
    sides = [n_cells]
    for conv in convolutions:
        sides.append((sides[-1] - conv.kernel) // conv.stride + 1)
    return sides


def layer_sizes(config: PolicyConfig, n_frames: int, n_cells: int) -> list[LayerSize]:
    """All layers: convolutions, the encoder's linear layer, the policy head, the value head."""
    sides = map_sides(config.conv, n_cells)
    channels = [n_frames, *(conv.channels for conv in config.conv)]
    behind = zip(pairwise(channels), config.conv, sides[1:], strict=True)
    layers = [LayerSize(n_in * conv.kernel**2, n_out, side) for (n_in, n_out), conv, side in behind]
    layers.append(LayerSize(channels[-1] * sides[-1] ** 2, config.encoder_width, 1))
    for n_outputs in (len(config.horizons_s), 1):
        widths = (config.encoder_width, *config.head_widths, n_outputs)
        layers += [LayerSize(n_in, n_out, 1) for n_in, n_out in pairwise(widths)]
    return layers


def check_policy(config: PolicyConfig, n_cells: int, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
    """n_cells: side of the grid; foresight: of the planner."""
    yield from check_horizons({"policy.horizons_s": config.horizons_s}, dt_s, foresight)
    for index, (side, conv) in enumerate(zip(map_sides(config.conv, n_cells), config.conv, strict=False)):
        if conv.kernel > side:
            rule = f"be at most {side}, the side of its input with observation.n_cells = {n_cells}"
            yield Problem(f"policy.conv.{index}.kernel", rule, conv.kernel)


def network_memory(layers: Sequence[LayerSize]) -> Memory:
    """Memory of the weights with their gradients and what an optimiser keeps of them."""
    n_weights = sum(layer.n_weights for layer in layers)
    keys = ("policy.encoder_width", "policy.head_widths", "policy.conv", "observation.n_cells", "observation.n_frames")
    return Memory("the network", n_weights * FLOAT_BYTES * N_TEMPORARIES, keys)
