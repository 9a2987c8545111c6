"""Checks of start positions: no vehicle starts in a collision, and the corridor is wide enough for a vehicle."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from negopipe.checks import Problem
from negopipe.simulation.build_road import build_road, draw_streets
from negopipe.simulation.drivable import is_in_a_car, is_off_road_on_route
from negopipe.simulation.geometry import Boxes, Size, boxes_from_pose, overlap_depth
from negopipe.simulation.road import RouteState
from negopipe.simulation.scenario import FamilyConfig, ScenarioConfig
from negopipe.simulation.vehicle_kinds import bounds

STEP_M = 0.25
"""Spacing of the start distances that are checked in an interval, m."""

SEARCHED_M = 50.0
"""Length of the search for a clear start, m."""

FARTHEST_M = 1000.0
"""Start distances that are tried at most: farther away the road is the same everywhere."""

ON_BOTH = (1.0, -1.0)
"""Both ways along a street."""

TOUCH_M = 1e-3
"""Smallest overlap that is a contact, m; less is rounding."""


def check_starts(scenario: ScenarioConfig, families: Mapping[str, FamilyConfig], ego_key: str) -> Iterator[Problem]:
    """Tasks of `families` that may start a vehicle in a parked car, over a kerb or in another vehicle.

    families: task families by their config key
    ego_key: config key of `scenario.ego_start_distance_m`, for the message
    """
    starts = _Starts(scenario)
    yield from starts.check_corridor()
    yield from starts.check_queue(ego_key, scenario.ego_start_distance_m, 1 + scenario.n_followers, 1.0)
    pieces = {piece: key for key, family in families.items() for piece in family.pieces_m or [family.start_distance_m]}
    for piece, key in pieces.items():  # what several families have in common is tried once
        yield from starts.check_queue(f"{key}.start_distance_m", piece, scenario.n_social, -1.0)
        yield from starts.check_ego(f"{key}.start_distance_m", piece[0], ego_key)
    behind_ego_m, behind_social_m = scenario.queue_m
    farthest_m = max(scenario.ego_start_distance_m[1] + behind_ego_m, *(piece[1] + behind_social_m for piece in pieces))
    yield from starts.check_kinds(min(farthest_m, FARTHEST_M))


class _Starts:
    """Start positions of a scenario, and their checks."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self.scenario, self.size = scenario, scenario.sizes.ego
        self.largest = scenario.sizes.largest
        self.streets, self.road = draw_streets(scenario), build_road(scenario)
        self._number = torch.arange(1.0, 1 + self.road.n_streets)

    def check_corridor(self) -> Iterator[Problem]:
        """A vehicle fits between the parked cars; a map's road is checked where it is built."""
        if not self.streets:
            return
        gap_m = min(street.corridor_gap_m for street in self.streets)
        widths = {"scenario.vehicle": self.size.width}
        widths |= {f"scenario.kinds.{name}": kind.width_m for name, kind in self.scenario.largest_of_kinds.items()}
        for key, width_m in widths.items():
            if width_m > gap_m:
                yield Problem(f"{key}.width_m", f"be at most scenario.road.corridor_gap_m = {gap_m}", width_m)

    def check_kinds(self, farthest_m: float) -> Iterator[Problem]:
        """The largest vehicle of every kind gets from its start to its target along both routes.

        A kind that is within another one needs no check of its own.
        """
        last_m = float(torch.as_tensor(self.road.target_s(self._number)).max())
        s = torch.arange(-farthest_m, last_m, STEP_M)
        kinds = self.scenario.largest_of_kinds
        for name, kind in kinds.items():
            if any(kind != other and kind.is_within(other) for other in kinds.values()):
                continue
            size = Size(kind.length_m, kind.width_m)
            touches = torch.stack([self._touches(-s, way, size) for way in ON_BOTH])
            if touches.any():
                first_m = float(s.expand_as(touches)[touches].abs().min())
                rule = "fit along the routes of all streets (a longer scenario.road.swerve_length_m, a wider gap)"
                got = f"{kind.length_m:g} m x {kind.width_m:g} m, which touches a parked car or a kerb {first_m:g} m"
                yield Problem(f"scenario.kinds.{name}", rule, f"{got} from a mouth of the corridor")

    def check_queue(
        self, key: str, interval: tuple[float, float], n_vehicles: int, direction: float
    ) -> Iterator[Problem]:
        """A queue whose first vehicle starts anywhere in the interval."""
        low, high = bounds(self.scenario.social_spacing_m)
        of_each = [_tried((interval[0] + k * low, interval[1] + k * high)) for k in range(n_vehicles)]
        yield from self.check_roadside(key, interval, torch.cat(of_each), direction)
        yield from self.check_spacing(_tried(interval)[:, None] + torch.arange(n_vehicles) * low, direction)

    def check_roadside(
        self, key: str, interval: tuple[float, float], distance: Tensor, direction: float
    ) -> Iterator[Problem]:
        """Nobody starts at the mouth itself, in a parked car or over a kerb."""
        if interval[0] == 0:
            yield Problem(key, "be greater than 0, where the corridor begins", list(interval))
            return
        touches = self._touches(distance, direction, self.size)
        if not touches.any():
            return
        nearest_m, width_m = float(distance.expand_as(touches)[touches].min()), self.size.width
        farther = nearest_m + torch.arange(0, SEARCHED_M, STEP_M)
        clear = farther[~self._touches(farther, direction, self.size).any(0)]
        lane_m = min((min(street.widths_m) - 2 * street.lane_offset_m for street in self.streets), default=0.0)
        if self.streets and not len(clear) and width_m > lane_m:
            rule = f"be at most scenario.road.width_m - 2 lane_offset_m = {lane_m:g}, the width of a lane"
            yield Problem("scenario.vehicle.width_m", rule, width_m)
            return
        hint = f", at {float(clear[0]):g} m none does" if len(clear) else ""
        touch = f"at {nearest_m:g} m a vehicle touches one{hint}"
        yield Problem(key, "keep clear of kerbs and parked cars", f"{list(interval)}: {touch}")

    def check_spacing(self, distance: Tensor, direction: float) -> Iterator[Problem]:
        """Vehicles of one direction, which start at the distances [N, S], do not start in each other."""
        ahead, behind = (self._boxes(each, direction, self.largest) for each in (distance[:, :-1], distance[:, 1:]))
        if (overlap_depth(ahead, behind) > TOUCH_M).any():
            spacing_m = self.scenario.social_spacing_m
            got = list(spacing_m) if isinstance(spacing_m, tuple) else spacing_m
            yield Problem("scenario.social_spacing_m", self._apart, got)

    @property
    def _apart(self) -> str:
        lengths_m = {"vehicle": self.size.length}
        lengths_m |= {f"kinds.{name}": kind.length_m for name, kind in self.scenario.largest_of_kinds.items()}
        longest = max(lengths_m, key=lengths_m.__getitem__)
        return f"keep vehicles of scenario.{longest}.length_m = {lengths_m[longest]} apart"

    def check_ego(self, key: str, social_m: float, ego_key: str) -> Iterator[Problem]:
        """The ego and the nearest social vehicle do not start in each other."""
        ego = self._boxes(torch.tensor([self.scenario.ego_start_distance_m[0]]), 1.0, self.size)
        social = self._boxes(torch.tensor([social_m]), -1.0, self.largest)
        if (overlap_depth(ego, social) > TOUCH_M).any():
            lengths_m = [street.corridor_length_m for street in self.streets]
            corridor = f"scenario.road.corridor_length_m = {min(lengths_m)}" if lengths_m else "the narrow places"
            got = f"{social_m} and {self.scenario.ego_start_distance_m[0]} across {corridor}"
            yield Problem(f"{key} and {ego_key}", "keep the vehicles apart", got)

    def _touches(self, distance: Tensor, direction: float, size: Size) -> Tensor:
        """[B, ...] bool: a vehicle with the start distance [...] touches a parked car or goes over a kerb."""
        boxes, way = self._boxes(distance, direction, size), self._way(distance, direction)
        is_in = is_in_a_car(boxes, self.road.parked_boxes(way), TOUCH_M)
        return is_in | is_off_road_on_route(self.road, boxes, -distance.expand_as(way), way)

    def _way(self, distance: Tensor, direction: float) -> Tensor:
        """[B, ...]: the direction of every street, with an axis for each of `distance`."""
        return direction * self._number.reshape(-1, *[1] * distance.dim()).expand(-1, *distance.shape)

    def _boxes(self, distance: Tensor, direction: float, size: Size) -> Boxes:
        """Footprints [B, ...] of vehicles that start `distance` [...] before their mouth, on their route."""
        way = self._way(distance, direction)
        s = -distance.expand_as(way)
        start = RouteState(s, torch.zeros_like(s), torch.zeros_like(s), *self.road.route_offset(s, way))
        vehicles = self.road.to_world(start, way)
        x, y = vehicles.position.unbind(-1)
        return boxes_from_pose(x, y, vehicles.yaw, *size)


def _tried(interval: tuple[float, float]) -> Tensor:
    """[N] float32, m: both ends of the interval and what lies between; far away all is alike."""
    low, high = interval[0], min(interval[1], max(interval[0], FARTHEST_M))
    return torch.linspace(low, high, 2 + int((high - low) / STEP_M) if high > low else 1)
