"""The work of one decision, and the physical limit of decisions per second that follows from it.

The count covers the planner and the grids, fused into one pass: operations on single numbers, and those bytes that must
be read or written between two decisions. The network and the trackers are not part of it, nor is the arithmetic of an
observation of objects, which is little. Every predicted time of every other vehicle is counted. A CPU skips those that
do not count in a plan (`tensors/sparse.py`), so with short horizons it may exceed the limit.
"""

from dataclasses import dataclass

from negopipe.game.game import Game
from negopipe.observation.kinds import AnyObservationConfig
from negopipe.observation.occupancy_grid import OccupancyGridConfig
from negopipe.simulation.scenario import ScenarioConfig

OVERLAP = 49
"""Operations of `geometry.overlap_depth` for a pair of boxes."""

_ROUTE = 31  # route_offset: smoothstep with two derivatives 18, its argument 5, scaling the three 8
_FOLLOW = 24 + _ROUTE + 6  # a quintic with two derivatives by Horner, the route, and their sums
_STATION = _FOLLOW + 8 + 10  # ... curvature and its limit; heading, reach and kerb
_CHECK = _FOLLOW - 14 + 4  # ... without the second derivatives; heading
_ROW = 26  # a footprint against a row of parked cars
_BLOCKED = 10  # ends of a blocked interval, from the depths at two stations
_WITHIN = 4  # whether a candidate is within the interval, keep the deepest
_SAMPLE = 4 * 5 + 12  # four derivatives, each a row times three numbers; limits and costs
_PREDICT = _ROUTE + 13  # route, fading offset, the viewer's frame
_CROSSING = 32  # first and last column of a box in a row of cells
_WORD = 13  # the same as bits of one machine word
_CELL = 1  # shift, mask, product and mask of four at a time

_STATE_FLOATS = 13  # position 2, yaw, speed, acceleration, curvature; of the vehicle and of its plan; last horizon
_POSE_FLOATS = 4  # with the speed
_TASK_FLOATS = 8
_FLAG_BYTES = 3 + 8  # has reached, has collided, has switched; steps at rest
_WORLD_BYTES = 3 * 8  # step, family, noise seed
_WORD_BITS = 28


@dataclass(frozen=True)
class Workload:
    """Work of one decision in one world.

    flops: operations on single numbers
    bytes: bytes read and written
    """

    flops: float
    bytes: float

    def decisions_per_s(self, gflops: float, gb_per_s: float) -> float:
        """Upper bound for a machine with these two rates that computes and moves bytes at the same time."""
        return min(gflops * 1e9 / self.flops, gb_per_s * 1e9 / self.bytes)


def decision_workload(game: Game, scenario: ScenarioConfig, observation: AnyObservationConfig) -> Workload:
    """Work of one decision at the configured sizes.

    With V vehicles, O = V - 1 others, L lateral and C longitudinal candidates, T times, S stations, K stations around
    a predicted vehicle, P parked cars in R rows, B boxes beyond the kerbs, F frames of H x W cells and J poses
    remembered:

        flops = V [C T sample + L S (station + R row)
                   + O T (L K (check + overlap + blocked) + L C within + predict)]
              + V (O + P) overlap + (F V + P + B) H (crossing + words * word) + F H W cell
        bytes = 2 V (state + J pose + flags) + V task + 3 counters + observation
    """
    n_vehicles = scenario.n_vehicles
    n_others, n_parked = scenario.n_others, game.simulator.road.parked_boxes().x.shape[-1]
    flops = n_vehicles * (_plan(game, n_others) + (n_others + n_parked) * OVERLAP)
    if isinstance(observation, OccupancyGridConfig):
        flops += _grids(game, observation, n_vehicles)
    state = 4 * (_STATE_FLOATS + (1 + game.simulator.sensor.memory_steps) * _POSE_FLOATS) + _FLAG_BYTES
    moved = 2 * (n_vehicles * state + _WORLD_BYTES) + n_vehicles * 4 * _TASK_FLOATS
    return Workload(float(flops), float(moved + observation.observed.n_bytes))


def _grids(game: Game, observation: OccupancyGridConfig, n_vehicles: int) -> int:
    """Operations of drawing the grids of one agent."""
    road, (n_frames, height, width) = game.simulator.road, observation.shape
    n_parked, n_beyond_kerbs = (boxes.x.shape[-1] for boxes in (road.parked_boxes(), road.off_road_boxes()))
    n_rows = (n_frames * n_vehicles + n_parked + n_beyond_kerbs) * height  # of boxes
    return n_rows * (_CROSSING + -(-width // _WORD_BITS) * _WORD) + n_frames * height * width * _CELL


def _plan(game: Game, n_others: int) -> int:
    """Operations of one vehicle's plan."""
    planner = game.planner
    n_lateral, n_longitudinal = planner.lateral.n_candidates, planner.longitudinal.n_candidates
    n_times, n_stations = len(planner.times), len(planner.stations)
    n_around, n_rows = len(planner.conflicts.around), planner.roadside.n_rows
    sampling = n_longitudinal * n_times * _SAMPLE
    roadside = n_lateral * n_stations * (_STATION + n_rows * _ROW)
    checks = n_lateral * n_around * (_CHECK + OVERLAP + _BLOCKED) + n_lateral * n_longitudinal * _WITHIN
    return sampling + roadside + n_others * n_times * (checks + _PREDICT)
