"""Lanelets of a CommonRoad scenario as they are written again, in a scenario of version 2020a."""

from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from xml.etree import ElementTree

from negopipe.maps.commonroad import read_scenario_root

BEFORE_TYPE = ("leftBound", "rightBound", "predecessor", "successor", "adjacentLeft", "adjacentRight")
TYPE = "laneletType"
AFTER_TYPE = ("userOneWay", "userBidirectional")
"""Parts of a lanelet that are kept, in the order of the schema; stop lines, signs and lights are left out."""


def read_lanelets(path: Path) -> list[ElementTree.Element]:
    """All lanelets of a scenario (XML 2018b or 2020a) with their bounds, neighbours and users."""
    return [_kept(lanelet) for lanelet in read_scenario_root(path).findall("lanelet")]


def largest_id(lanelets: Sequence[ElementTree.Element]) -> int:
    """The largest id, 0 without lanelets."""
    return max((int(lanelet.get("id", "0")) for lanelet in lanelets), default=0)


def _kept(lanelet: ElementTree.Element) -> ElementTree.Element:
    """A copy without what refers to other elements than lanelets; version 2018b has no type, which becomes urban."""
    copy = ElementTree.Element("lanelet", id=lanelet.get("id", ""))
    for tag in BEFORE_TYPE:
        copy.extend(deepcopy(part) for part in lanelet.findall(tag))
    types = [(part.text or "").strip() for part in lanelet.findall(TYPE)]
    for name in types or ["urban"]:
        ElementTree.SubElement(copy, TYPE).text = name
    for tag in AFTER_TYPE:
        copy.extend(deepcopy(part) for part in lanelet.findall(tag))
    return copy
