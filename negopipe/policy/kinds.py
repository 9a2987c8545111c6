"""The kinds of network: built for the layout of an observation, and refused where they do not fit it."""

from collections.abc import Iterator
from typing import Annotated

import torch
from pydantic import Field
from torch import Generator

from negopipe.checks import Foresight, Problem, check_horizons
from negopipe.policy.actor_critic import Policy
from negopipe.policy.grids import GridPolicyConfig, grid_actor_critic
from negopipe.policy.objects import ObjectsPolicyConfig, objects_actor_critic
from negopipe.policy.size import Layers, grid_layers, map_sides, objects_layers
from negopipe.tensors.row_blocks import RowBlocks

AnyPolicyConfig = GridPolicyConfig | ObjectsPolicyConfig
PolicyConfig = Annotated[AnyPolicyConfig, Field(discriminator="kind")]

ObservationLayout = tuple[int, int, int] | RowBlocks
"""Layout of one observation: grids (F, H, W), or the blocks of a row."""


def build_policy(
    config: AnyPolicyConfig, layout: ObservationLayout, device: torch.device, generator: Generator
) -> Policy:
    """A new network of a config that fits its observation; the weights depend on the CPU generator only."""
    match config:
        case GridPolicyConfig():
            assert not isinstance(layout, RowBlocks)
            return grid_actor_critic(config, layout, device, generator)
        case ObjectsPolicyConfig():
            assert isinstance(layout, RowBlocks)
            return objects_actor_critic(config, layout, device, generator)


def layers_of(config: AnyPolicyConfig, layout: ObservationLayout) -> Layers:
    """Layers of the network of a config that fits its observation."""
    match config:
        case GridPolicyConfig():
            assert not isinstance(layout, RowBlocks)
            return grid_layers(config, layout)
        case ObjectsPolicyConfig():
            assert isinstance(layout, RowBlocks)
            return objects_layers(config, layout)


def check_policy(
    config: AnyPolicyConfig, layout: ObservationLayout, dt_s: float, foresight: Foresight
) -> Iterator[Problem]:
    """Problems with the observation and with the planner; foresight: of the planner."""
    fitting = "objects" if isinstance(layout, RowBlocks) else "cnn"
    if config.kind != fitting:
        rule = f"be {fitting} for this observation (policy={fitting}; observation=objects goes with policy=objects)"
        yield Problem("policy.kind", rule, config.kind)
        return
    yield from check_horizons({"policy.horizons_s": config.horizons_s}, dt_s, foresight)
    if isinstance(config, GridPolicyConfig) and not isinstance(layout, RowBlocks):
        n_cells = layout[1]
        for index, (side, conv) in enumerate(zip(map_sides(config.conv, n_cells), config.conv, strict=False)):
            # besides, oneDNN corrupts memory with AVX2, kernel 1, a longer stride and few channels (torch 2.13)
            if conv.kernel < conv.stride:
                rule = f"be at least its stride, {conv.stride}, or cells are skipped"
                yield Problem(f"policy.conv.{index}.kernel", rule, conv.kernel)
            if conv.kernel > side:
                rule = f"be at most {side}, the side of its input with observation.n_cells = {n_cells}"
                yield Problem(f"policy.conv.{index}.kernel", rule, conv.kernel)
