"""Occupancy grids of the last seconds, drawn in the ego's current frame.

What is drawn: everything beyond the kerbs, the parked cars, the other vehicles, and the vehicle's own footprint.
All frames share the present frame of reference, so what stands still looks the same in each of them; the own past
footprints are the only trace of the own speed, which the policy needs, and they cannot be mistaken for another
vehicle since two footprints never share a place without a collision.
"""

from functools import reduce

import torch
from torch import Tensor

from negopipe.schema import NonNegativeFloat, PositiveFloat, PositiveInt, schema
from negopipe.simulation.geometry import Boxes
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road
from negopipe.simulation.scenario import VehicleConfig

FAR_M = 1000.0
"""Where no grid reaches."""

WORD_BITS = 28
"""Columns per machine word; three words hold the paper's 84 columns."""


@schema
class ObservationConfig:
    """`conf/observation/occupancy_grid.yaml` says what each value means."""

    n_cells: PositiveInt
    cell_along_m: PositiveFloat
    cell_across_m: PositiveFloat
    behind_m: NonNegativeFloat
    n_frames: PositiveInt
    frame_interval_s: PositiveFloat


def frame_stride(config: ObservationConfig, dt_s: float) -> int:
    """Control steps between two frames."""
    return max(1, round(config.frame_interval_s / dt_s))


def history_steps(config: ObservationConfig, dt_s: float) -> int:
    """How many past poses the simulator must remember for the grids."""
    return (config.n_frames - 1) * frame_stride(config, dt_s)


class OccupancyGrid:
    """Draws grids for one seat of E worlds.

    Row 0 is farthest ahead, column 0 farthest to the left; a cell is occupied if its centre is. Axes here: F
    frames, R rectangles, H rows, W columns.
    """

    def __init__(
        self,
        config: ObservationConfig,
        road: Road,
        vehicle: VehicleConfig,
        dt_s: float,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.vehicle = config, vehicle
        n = config.n_cells
        self.shape = (config.n_frames, n, n)
        self._stride = frame_stride(config, dt_s)
        cells = torch.arange(n, device=device)
        self._ahead = (n - cells - 0.5) * config.cell_along_m - config.behind_m  # [H] m, row centres
        self._word_start = torch.arange(0, n, WORD_BITS, device=device)  # [K] first column of each word
        self._bits = torch.arange(WORD_BITS, device=device, dtype=torch.int32)
        self._static = _static_boxes(road, device)  # fields [R], world frame

    def draw(self, perception: Perception) -> Tensor:
        """[E, F, H, W] uint8, 1 = occupied; channel 0 is now, channel f is f frame intervals ago.

        `perception` is that of one seat (S = 1).
        """
        own = perception.own_history[:, :: self._stride, 0]  # [E, F, 3]
        others = perception.other_history[:, :: self._stride, 0]  # [E, F, O, 3]
        pose = own[:, 0]
        moving = torch.cat([own[:, :, None], others], dim=2)
        x, y, yaw = moving.unbind(-1)
        is_seen = perception.is_seen_history[:, :: self._stride, 0]
        x = torch.where(torch.cat([torch.ones_like(is_seen[..., :1]), is_seen], dim=-1), x, FAR_M)
        half_length, half_width = self.vehicle.length_m / 2, self.vehicle.width_m / 2
        vehicles = Boxes(x, y, torch.cos(yaw), torch.sin(yaw), half_length, half_width)
        static = self._rows(_in_body_frame(self._static, pose[:, None]))
        return self._cells(static[:, None] | self._rows(_in_body_frame(vehicles, pose[:, None, None])))

    def _rows(self, boxes: Boxes) -> Tensor:
        """Union of the rectangles with fields [..., R] (body frame): [..., H, K] int32, a bit per cell."""
        config = self.config
        left, right = self._row_crossings(boxes)
        half_width = config.n_cells * config.cell_across_m / 2
        first = torch.ceil((half_width - left) / config.cell_across_m - 0.5)
        end = torch.floor((half_width - right) / config.cell_across_m - 0.5) + 1
        low = (first[..., None] - self._word_start).clamp(0, WORD_BITS).to(torch.int32)
        high = (end[..., None] - self._word_start).clamp(0, WORD_BITS).to(torch.int32)
        one = torch.ones_like(low)
        span = (torch.bitwise_left_shift(one, high) - torch.bitwise_left_shift(one, low)).clamp(min=0)
        return reduce(torch.bitwise_or, span.unbind(-3))

    def _cells(self, rows: Tensor) -> Tensor:
        """Bits [..., H, K] -> cells [..., H, W] uint8."""
        cells = torch.bitwise_right_shift(rows[..., None], self._bits).bitwise_and(1).to(torch.uint8)
        return cells.flatten(-2)[..., : self.config.n_cells]

    def _row_crossings(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """Leftmost and rightmost y (m, body frame) at which each row's centre line is inside, [..., R, H]."""
        half_length = torch.as_tensor(boxes.half_length)[..., None]
        half_width = torch.as_tensor(boxes.half_width)[..., None]
        cos, sin = boxes.cos[..., None], boxes.sin[..., None]
        du = self._ahead - boxes.x[..., None]
        long_mid, long_half = _slab(du * cos, sin, half_length)
        wide_mid, wide_half = _slab(-du * sin, cos, half_width)
        left = torch.minimum(long_mid + long_half, wide_mid + wide_half)
        right = torch.maximum(long_mid - long_half, wide_mid - wide_half)
        return left + boxes.y[..., None], right + boxes.y[..., None]


def _slab(offset: Tensor, slope: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and half length of {w: |offset + slope * w| <= half}; a slope of nearly 0 means all w or none."""
    slope = torch.where(slope.abs() < 1e-6, 1e-6, slope)
    return -offset / slope, half / slope.abs()


def _in_body_frame(boxes: Boxes, pose: Tensor) -> Boxes:
    """World frame -> frame of `pose` [..., 3] (x, y, yaw)."""
    x, y, yaw = pose.unbind(-1)
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    dx, dy = boxes.x - x, boxes.y - y
    return boxes._replace(
        x=dx * cos + dy * sin,
        y=dy * cos - dx * sin,
        cos=boxes.cos * cos + boxes.sin * sin,
        sin=boxes.sin * cos - boxes.cos * sin,
    )


def _static_boxes(road: Road, device: torch.device | str) -> Boxes:
    """Parked cars and, as two wide rectangles, what lies beyond the kerbs."""
    far = FAR_M
    right, left = road.kerb_y_m
    sides = torch.tensor([[0.0, right - far / 2, 0.0, far, far], [0.0, left + far / 2, 0.0, far, far]], device=device)
    x, y, yaw, length, width = torch.cat([road.parked_cars, sides]).unbind(-1)
    return Boxes(x, y, torch.cos(yaw), torch.sin(yaw), length / 2, width / 2)
