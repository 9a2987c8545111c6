"""What a street's tables say of waiting and of the view ahead; computed once per street."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from negopipe.deployment.decision import PASSAGE, AnySizes, n_ahead
from negopipe.deployment.graph_road import bound_road
from negopipe.deployment.tables import StreetTables
from negopipe.observation import street_ahead
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.perception import other_columns
from negopipe.simulation.waiting_place import Passage

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

NAMES = (*PASSAGE, "ahead")
"""Names of the tables: the places to wait, [2, M] m each, and the features of the street ahead."""


class Surroundings(nn.Module):
    """Tables of a street, by name -> those of `NAMES`."""

    def __init__(self, config: "RunConfig") -> None:
        super().__init__()
        sizes = config.scenario.sizes
        self._sizes = AnySizes(sizes.ego, sizes.smallest, sizes.largest)
        self._road, self._n_knots, self._dt_s = bound_road(config), n_ahead(config), config.scenario.dt_s

    def forward(self, street: dict[str, Tensor]) -> tuple[Tensor, ...]:
        self._road.bind(street)
        passage = Passage.of(CollisionCheck(self._road, self._dt_s, other_columns(2)), self._sizes)
        ahead = street_ahead.tabulated(self._road, passage, self._n_knots, street["on_line"][None])
        return (*(getattr(passage, name) for name in PASSAGE), ahead)


def as_tensors(tables: StreetTables) -> dict[str, Tensor]:
    """The tables by name."""
    return {name: torch.from_numpy(table.copy()) for name, table in tables._asdict().items()}


@torch.no_grad()
def with_surroundings(surroundings: Surroundings, tables: StreetTables) -> dict[str, Tensor]:
    """The tables by name, those of `NAMES` among them."""
    named = as_tensors(tables)
    return named | dict(zip(NAMES, surroundings(named), strict=True))
