"""Configuration of a street that is read from a map, and the reading."""

from functools import lru_cache
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

from negopipe.maps import KerbsideRow, MapStreet, Parking, read_commonroad, read_lanelet2, read_lanelets
from negopipe.schema import PathText, schema

READERS = {"lanelet2": read_lanelet2, "commonroad": read_commonroad}


@schema
class MapConfig:
    """A street of a map; `conf/scenario/lanelet2.yaml` says what each value means."""

    format: Literal["lanelet2", "commonroad"]
    file: PathText
    ids: tuple[int, ...]
    parking: Parking
    rows: tuple[KerbsideRow, ...]


@lru_cache(maxsize=4)
def read_map(config: MapConfig) -> MapStreet:
    """The street with its parked vehicles; UserError where the file has none."""
    return READERS[config.format](Path(config.file), config.ids, config.parking, config.rows)


def lanelets_of(config: MapConfig) -> list[ElementTree.Element]:
    """The map's lanelets for a CommonRoad scenario; none where it is no CommonRoad map."""
    return read_lanelets(Path(config.file)) if config.format == "commonroad" else []
