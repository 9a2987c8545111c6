"""What a street's tables say of waiting and of the view ahead; computed once per street."""

import torch
from torch import Tensor

from negopipe.deployment.decision import PASSAGE, AnySizes, BoundRoad
from negopipe.deployment.tables import StreetTables
from negopipe.observation import street_ahead
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.perception import other_columns
from negopipe.simulation.waiting_place import Passage


def with_surroundings(
    road: BoundRoad, sizes: AnySizes, tables: StreetTables, n_knots: int, dt_s: float
) -> dict[str, Tensor]:
    """The tables by name, with the places to wait (`PASSAGE`, [2, M] m) and the street `ahead`, as tensors.

    n_knots: of the table ahead, `decision.n_ahead`
    """
    named = {name: torch.from_numpy(table.copy()) for name, table in tables._asdict().items()}
    road.bind(named)
    passage = Passage.of(CollisionCheck(road, dt_s, other_columns(2)), sizes)
    waiting = {name: getattr(passage, name) for name in PASSAGE}
    ahead = street_ahead.tabulated(road, passage, n_knots, named["on_line"][None])
    return named | waiting | {"ahead": ahead}
