"""Real streets: lanelet2 and CommonRoad files in, CommonRoad scenarios out.

street        the result of every reader: reference line, kerbs, parked vehicles
xml_file      an XML file opened and its numbers read, with one-line errors
projection    latitude and longitude to metres
boxes         oriented rectangles: corners and overlap
line          the reference line in the middle between two kerbs, and the kerbs' distances from it
chain         pieces of road that both directions use, chained to the longest street
parking       vehicles lined up in parking areas and along a kerb
assembly      a chain and its parked vehicles made to a street
lanelet2      reader of lanelet2 maps (OSM XML)
commonroad    reader of CommonRoad scenarios (XML 2018b and 2020a)
lanelets      those of a CommonRoad scenario as they are written again
recording     drives written as a CommonRoad scenario (2020a), and read again
"""

from typing import TYPE_CHECKING

from negopipe.lazy_face import lazy_face

if TYPE_CHECKING:
    from negopipe.maps.commonroad import read_commonroad
    from negopipe.maps.lanelet2 import read_lanelet2
    from negopipe.maps.lanelets import read_lanelets
    from negopipe.maps.parking import KerbsideRow, Parking, Side
    from negopipe.maps.recording import Trajectory, read_trajectories, write_commonroad
    from negopipe.maps.street import MapStreet, free_sides

__all__ = [
    "KerbsideRow",
    "MapStreet",
    "Parking",
    "Side",
    "Trajectory",
    "free_sides",
    "read_commonroad",
    "read_lanelet2",
    "read_lanelets",
    "read_trajectories",
    "write_commonroad",
]

if not TYPE_CHECKING:  # a type checker must not take every name for one of this package
    # imported at their first use: a vehicle's runtime has NumPy alone, no pydantic
    __getattr__, __dir__ = lazy_face(
        __name__,
        {
            "KerbsideRow": "negopipe.maps.parking",
            "MapStreet": "negopipe.maps.street",
            "Parking": "negopipe.maps.parking",
            "Side": "negopipe.maps.parking",
            "Trajectory": "negopipe.maps.recording",
            "free_sides": "negopipe.maps.street",
            "read_commonroad": "negopipe.maps.commonroad",
            "read_lanelet2": "negopipe.maps.lanelet2",
            "read_lanelets": "negopipe.maps.lanelets",
            "read_trajectories": "negopipe.maps.recording",
            "write_commonroad": "negopipe.maps.recording",
        },
    )
