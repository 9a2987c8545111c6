"""The safety layer in the game: it checks what the ego of every world is about to drive."""

from dataclasses import replace

import torch
from torch import Tensor

from negopipe.safety.config import AnySafetyConfig, NoSafetyConfig
from negopipe.safety.layer import N_KEPT, SafetyLayer
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import EGO, NOBODY, Motion, World
from negopipe.tensors.tree import map_tensors


class Guard:
    """A safety layer for the egos; without one (`layer` None) every motion is driven as it is."""

    def __init__(self, config: AnySafetyConfig, simulator: Simulator) -> None:
        self.layer = None if isinstance(config, NoSafetyConfig) else SafetyLayer.of(config, simulator)

    def decided(self, perception: Perception, motion: Motion) -> Motion:
        """The motions [E, S] with NaN for who follows the planner with NaN as its horizon: that is no decision."""
        if self.layer is None:
            return motion
        is_undecided = (perception.driver == NOBODY) & motion.horizon.isnan()
        speed = torch.where(is_undecided, torch.nan, motion.state.speed)
        return replace(motion, state=replace(motion.state, speed=speed))

    def guard(self, world: World, perception: Perception, motion: Motion) -> tuple[World, Motion, Tensor]:
        """The world with the stop that is kept, the motions [E, V] of which the ego's is checked, and the layer's
        interventions [E] int64.

        perception, motion: of all vehicles
        """
        if self.layer is None:
            return world, motion, torch.zeros_like(world.step)
        own = map_tensors(lambda field: field[:, EGO : EGO + 1], motion)
        checked = self.layer.guard(perception.of(EGO), own, world.kept_stop)
        motion = map_tensors(lambda new, field: torch.cat([new, field[:, EGO + 1 :]], 1), checked.motion, motion)
        return replace(world, kept_stop=checked.kept), motion, checked.intervention


def n_kept(config: AnySafetyConfig) -> int:
    """K, numbers that a world holds of the stop that the layer keeps."""
    return 0 if isinstance(config, NoSafetyConfig) else N_KEPT
