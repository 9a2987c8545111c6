"""Occupancy grids of the last seconds, drawn in the ego's current frame.

Occupied are the area beyond the kerbs, the parked cars, the other vehicles and the ego's own footprint. All frames
share the present frame of reference, so standing objects look the same in each of them. The ego's past footprints show
its speed, which the policy needs and sees nowhere else. They cannot be mistaken for another vehicle, since two
footprints share a place only in a collision.
"""

import math
from functools import reduce
from typing import Literal

import torch
from torch import Tensor

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Memory, Observed
from negopipe.observation.frames import FramesConfig
from negopipe.schema import NonNegativeMetres, PositiveInt, PositiveMetres, schema
from negopipe.simulation.geometry import Boxes, Size, boxes_from_pose
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road
from negopipe.simulation.sizes import Sizes
from negopipe.tensors.materialize import materialize

OUT_OF_SIGHT_M = 1000.0
"""Coordinate of vehicles that are not seen, m: beyond every grid."""

WORD_BITS = 28
"""Columns per machine word; three words hold the 84 columns of the paper."""

NIBBLE_BITS = 4
SPREAD, LOWEST_BITS = 0x00204081, 0x01010101
"""Factor and mask that spread a nibble over four bytes: (nibble * SPREAD) & LOWEST_BITS has one of its bits in each."""


@schema
class OccupancyGridConfig(FramesConfig):
    """`conf/observation/occupancy_grid.yaml` says what each value means."""

    kind: Literal["occupancy_grid"]
    n_cells: PositiveInt
    cell_along_m: PositiveMetres
    cell_across_m: PositiveMetres
    behind_m: NonNegativeMetres

    @property
    def n_words(self) -> int:
        """K, machine words per row."""
        return math.ceil(self.n_cells / WORD_BITS)

    @property
    def observed(self) -> Observed:
        """Size of one observation, a byte per cell."""
        n_cells = self.n_frames * self.n_cells**2
        return Observed(n_cells, n_cells, ("observation.n_frames", "observation.n_cells"))

    def memory(self, n_boxes: int, n_worlds: int) -> Memory:
        """Memory of drawing `n_boxes` rectangles in `n_worlds` worlds."""
        n_numbers = n_worlds * self.n_frames * self.n_cells * (self.n_words + 1) * n_boxes
        keys = "observation.n_cells observation.n_frames scenario.n_social scenario.n_followers"
        keys += " scenario.road.n_parked_per_side"
        return Memory("drawing the grids", n_numbers * FLOAT_BYTES * N_TEMPORARIES, tuple(keys.split()))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns of one observation, (F, H, W)."""
        return (self.n_frames, self.n_cells, self.n_cells)

    @property
    def layout(self) -> tuple[int, int, int]:
        """The same as `shape`: what a network for grids is built for."""
        return self.shape


class OccupancyGrid:
    """Occupancy grids of one agent in each of E worlds.

    Row 0 is farthest ahead, column 0 farthest to the left. A cell is occupied if its centre is. Axes here: F frames,
    R rectangles, K machine words, H rows, W columns.
    """

    def __init__(
        self,
        config: OccupancyGridConfig,
        road: Road,
        sizes: Sizes,
        dt_s: float,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.sizes, self.road = config, sizes, road
        n = config.n_cells
        self.shape = config.shape
        self._stride = config.frame_stride(dt_s)
        cells = torch.arange(n, device=device)
        self._ahead = (n - cells - 0.5) * config.cell_along_m - config.behind_m  # [H] m, row centres
        starts = torch.arange(config.n_words, device=device) * WORD_BITS
        self._word_start = starts[:, None]  # [K, 1] first column of each word
        self._shifts = torch.arange(0, WORD_BITS, NIBBLE_BITS, device=device, dtype=torch.int32)
        self._static = torch.cat([road.parked, road.off_road], dim=1)  # [B, R, 6], fields of Boxes, world frame

    def draw(self, perception: Perception) -> Tensor:
        """[E, F, H, W] uint8, 1 = occupied; channel 0 is now, channel f is f frame intervals ago.

        perception: of one agent, S = 1
        """
        own = perception.own_history[:, :: self._stride, 0]  # [E, F, 3]
        others = perception.other_history[:, :: self._stride, 0]  # [E, F, O, 3]
        pose = own[:, 0]
        moving = torch.cat([own[:, :, None], others], dim=2)
        x, y, yaw = moving.unbind(-1)
        is_seen = perception.is_seen_history[:, :: self._stride, 0]
        x = torch.where(torch.cat([torch.ones_like(is_seen[..., :1]), is_seen], dim=-1), x, OUT_OF_SIGHT_M)
        vehicles = boxes_from_pose(x, y, yaw, *self._size(perception))
        standing = Boxes(*self.road.pick(self._static, perception.direction[:, 0]).unbind(-1))
        static = self._rows(_in_body_frame(standing, pose[:, None]))
        return self._cells(static[:, None] | self._rows(_in_body_frame(vehicles, pose[:, None, None])))

    def _size(self, perception: Perception) -> Size:
        """Of the agent and of the others, [E, 1, 1 + O], or floats."""
        length, width = (
            torch.cat([own, others[:, 0]], dim=1)[:, None]
            for own, others in (
                (perception.length, perception.other_length),
                (perception.width, perception.other_width),
            )
        )
        return self.sizes.of(length, width)

    def _rows(self, boxes: Boxes) -> Tensor:
        """Union of the rectangles with fields [..., R] (body frame): [..., K, H] int32, a bit per cell."""
        first, end = self._columns(boxes)
        low = (first[..., None, :] - self._word_start).clamp(0, WORD_BITS).to(torch.int32)
        high = (end[..., None, :] - self._word_start).clamp(0, WORD_BITS).to(torch.int32)
        one = torch.ones_like(low)
        span = (torch.bitwise_left_shift(one, high) - torch.bitwise_left_shift(one, low)).clamp(min=0)
        return self._union(span)

    def _union(self, spans: Tensor) -> Tensor:
        """Words [..., K, H] of all rectangles together, from those [..., R, K, H] of each."""
        return reduce(torch.bitwise_or, spans.unbind(-3))

    def _cells(self, rows: Tensor) -> Tensor:
        """Bits [..., K, H] -> cells [..., H, W] uint8, four at a time; the lowest byte of a word comes first."""
        words = rows.transpose(-1, -2)[..., None]
        nibbles = torch.bitwise_right_shift(words, self._shifts).bitwise_and((1 << NIBBLE_BITS) - 1)
        cells = (nibbles * SPREAD).bitwise_and(LOWEST_BITS)
        return cells.flatten(-2).view(torch.uint8)[..., : self.config.n_cells]

    def _columns(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """First column and one past the last column whose centre is inside, by row, [..., R, H] float32.

        Along a row, each pair of parallel sides leaves an interval, whose middle is proportional to the row's place.
        """
        config = self.config
        half_width = config.n_cells * config.cell_across_m / 2
        long, wide = _slab(boxes.cos, boxes.sin, boxes.half_length), _slab(-boxes.sin, boxes.cos, boxes.half_width)
        values = (field[..., None] for field in materialize(boxes.x, boxes.y, *long, *wide))
        x, y, long_shift, long_half, wide_shift, wide_half = values
        du = self._ahead - x
        long_mid, wide_mid = du * long_shift, du * wide_shift
        left = torch.minimum(long_mid + long_half, wide_mid + wide_half) + y
        right = torch.maximum(long_mid - long_half, wide_mid - wide_half) + y
        first = torch.ceil((half_width - left) / config.cell_across_m - 0.5)
        return first, torch.floor((half_width - right) / config.cell_across_m - 0.5) + 1


def _slab(along: Tensor, across: Tensor, half: Tensor | float) -> tuple[Tensor, Tensor]:
    """The interval {w: |along * u + across * w| <= half}: its middle per u, and its half length.

    Where `across` is nearly 0, it is all w or none.
    """
    across = torch.where(across.abs() < 1e-6, 1e-6, across)
    return -along / across, half / across.abs()


def _in_body_frame(boxes: Boxes, pose: Tensor) -> Boxes:
    """Boxes in the frame of `pose` [..., 3] (x, y, yaw; m, m, rad), from boxes in the world frame."""
    x, y, yaw = pose.unbind(-1)
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    dx, dy = boxes.x - x, boxes.y - y
    return boxes._replace(
        x=dx * cos + dy * sin,
        y=dy * cos - dx * sin,
        cos=boxes.cos * cos + boxes.sin * sin,
        sin=boxes.sin * cos - boxes.cos * sin,
    )
