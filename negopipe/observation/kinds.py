"""The kinds of observation: what one is built from, and its interface."""

from typing import Annotated, Protocol

from pydantic import Field
from torch import Tensor

from negopipe.observation.objects import Objects, ObjectsConfig
from negopipe.observation.occupancy_grid import OccupancyGrid, OccupancyGridConfig
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.waiting_place import Passage

AnyObservationConfig = OccupancyGridConfig | ObjectsConfig
ObservationConfig = Annotated[AnyObservationConfig, Field(discriminator="kind")]


class Observation(Protocol):
    """Observations of one agent in each of E worlds, of one `shape`."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def draw(self, perception: Perception) -> Tensor:
        """[E, *shape] from the perception of one agent, S = 1."""
        ...


def build_observation(config: AnyObservationConfig, simulator: Simulator) -> Observation:
    """The observation of a config in the worlds of a simulator."""
    scenario = simulator.scenario
    match config:
        case OccupancyGridConfig():
            return OccupancyGrid(config, simulator.road, scenario.sizes, scenario.dt_s, simulator.road.device)
        case ObjectsConfig():
            return Objects(config, Passage.of(simulator.collisions, scenario.sizes), scenario.dt_s)
