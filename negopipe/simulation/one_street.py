"""One street in closed form: kerbs, parked cars, the corridor between them, and the route that a vehicle follows."""

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from negopipe.simulation.bays import park_in_bays
from negopipe.simulation.geometry import Boxes, box_rows, rim
from negopipe.simulation.knot_tables import BEYOND_M, knots
from negopipe.simulation.off_road import off_road_rows
from negopipe.simulation.reference_line import ReferenceLine
from negopipe.simulation.road import Road
from negopipe.simulation.road_config import StreetConfig
from negopipe.simulation.smoothstep import smoothstep


class OneStreet(Road):
    """A two-lane street along its reference line.

    reference: the line in the middle between the kerbs
    parked_cars: [P, 5] float32, x, y, yaw, length, width; world frame, m and rad
    target_s_m: s at which a vehicle has arrived
    """

    n_streets = 1

    def __init__(self, config: StreetConfig, device: torch.device | str = "cpu") -> None:
        self.config, self.device = config, torch.device(device)
        self.reference = ReferenceLine(config.bends, device)
        self.is_straight = self.reference.is_straight
        self.target_s_m = config.corridor_length_m + config.target_distance_m
        self.narrow_places = torch.tensor([[[0.0, config.corridor_length_m]]] * 2, device=device)
        self.n_places = torch.ones(1, dtype=torch.int64, device=device)
        self._gap_middle_m = config.gap_middles_m[0]
        self._parked = park(config).to(device)
        sigma, d, length, width = self._parked.unbind(-1)
        yaw = self.reference.heading(sigma)
        self.parked_cars = torch.stack([*self.reference.place(sigma, d), yaw, length, width], dim=-1)
        self.parked = box_rows(self.parked_cars)[None]

    @cached_property
    def off_road(self) -> Tensor:
        sigma = torch.from_numpy(knots(self.config.reach_m + BEYOND_M))
        line = torch.stack(self.reference.pose(sigma), -1).cpu().numpy()
        rows = off_road_rows(line, np.full((2, len(sigma)), self.config.width_m / 2))
        return box_rows(torch.tensor(rows, dtype=torch.float32, device=self.device))[None]

    def line(self, direction: Tensor) -> ReferenceLine:
        return self.reference

    def sign(self, direction: Tensor) -> Tensor:
        return direction

    def pick(self, table: Tensor, direction: Tensor) -> Tensor:
        return table[0]

    def corridor_m(self, direction: Tensor) -> float:
        return self.config.corridor_length_m

    def target_s(self, direction: Tensor) -> float:
        return self.target_s_m

    @property
    def parked_on_line(self) -> list[list[tuple[float, float, float, float]]]:
        return [[tuple(car) for car in self._parked.tolist()]]

    def kerbs_at(self, sigma: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        half = torch.full_like(sigma, self.config.width_m / 2)
        return half, half

    def kerb_excess(self, s: Tensor, direction: Tensor, d: Tensor, reach: Tensor, sagitta: Tensor | float) -> Tensor:
        return d.abs() + reach + sagitta - self.config.width_m / 2

    def is_off_road(self, boxes: Boxes, direction: Tensor | None = None) -> Tensor:
        half_road = self.config.width_m / 2
        if self.is_straight:
            reach = boxes.half_length * boxes.sin.abs() + boxes.half_width * boxes.cos.abs()
            return boxes.y.abs() + reach > half_road
        x, y = rim(boxes)
        return self.reference.project(x, y)[1].abs().amax(0) > half_road

    def route_offset(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Offset d (m) of the route at s [...], with d' (1) and d'' (1/m) by s: own lane, corridor, own lane.

        Outside the corridor the route keeps right (negative d), inside it follows the gap's middle line; it is
        symmetric about the corridor's middle. `direction` (+1 or -1) broadcasts with s.
        """
        config = self.config
        half = config.corridor_length_m / 2
        from_middle = s - half
        rate = 1 / config.swerve_length_m  # the planner's innermost loop: a product costs less than a division
        step, step_prime, step_pprime = smoothstep((from_middle.abs() - half - config.swerve_margin_m) * rate)
        step_prime = step_prime * torch.sign(from_middle) * rate
        step_pprime = step_pprime * rate**2
        if self._gap_middle_m == 0:
            lane = -config.lane_offset_m
            return lane * step, lane * step_prime, lane * step_pprime
        middle = direction * self._gap_middle_m
        shift = -config.lane_offset_m - middle
        return middle + shift * step, shift * step_prime, shift * step_pprime


def park(config: StreetConfig) -> Tensor:
    """[P, 4] float32, sigma, d, length and width (m): cars in rows, evenly spread so that each row fills its corridor.

    Irregularly parked cars are some of them, moved along their row and towards their kerb. Those in bays come last.
    """
    n, length, width = config.n_parked_per_side, config.parked_car_length_m, config.parked_car_width_m
    last = (config.corridor_length_m - length) / 2
    along = torch.linspace(-last, last, n) if n > 1 else torch.zeros(1)
    size = torch.tensor([length, width]).expand(n, 2)
    from_middle = (config.corridor_gap_m + width) / 2
    rows = []
    for (start, end), sides, middle in zip(config.corridors_m, config.sides, config.gap_middles_m, strict=True):
        for side in sides:
            d = torch.full((n, 1), middle + side * from_middle)
            rows.append(torch.cat([along[:, None] + (start + end) / 2, d, size], dim=1))
    cars = torch.cat(rows)
    if config.is_closed_form:
        return cars
    return torch.cat([_irregular(cars, config), park_in_bays(config.bays, config.width_at, length, width)])


def _irregular(cars: Tensor, config: StreetConfig) -> Tensor:
    """Some of the cars [P, 4], moved; of every street the first and the last car of a row stay."""
    generator = torch.Generator().manual_seed(config.parked_seed)
    empty, ahead, aside = torch.rand(3, len(cars), generator=generator)
    n, length, width = config.n_parked_per_side, config.parked_car_length_m, config.parked_car_width_m
    at = torch.arange(len(cars)) % n
    is_end = (at == 0) | (at == n - 1)
    room_m = (config.corridor_length_m - n * length) / max(n - 1, 1) / 2  # to the middle of the space to the next car
    room_across_m = (config.width_at(cars[:, 0].double()) / 2 - width / 2).float()
    to_kerb_m = (room_across_m - cars[:, 1].abs()).clamp(min=0)
    shift = torch.where(is_end, 0.0, config.parked_irregularity * (2 * ahead - 1) * room_m)
    inward = torch.where(is_end, 0.0, config.parked_irregularity * aside)
    moved = torch.stack(
        [cars[:, 0] + shift, cars[:, 1] + torch.sign(cars[:, 1]) * inward * to_kerb_m, cars[:, 2], cars[:, 3]], dim=-1
    )
    return moved[is_end | (empty >= config.parked_empty_share)]
