"""What a vehicle knows when it decides: itself, and the others as it perceives them.

Nothing else reaches a driver, so no driver can use what its vehicle would not have: the style, desired speed and
plan of the others are not here.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from negopipe.simulation.state import VehicleState, World, map_tensors


@dataclass(frozen=True)
class Perception:
    """Of S seats (vehicles that are driven), each seeing O = V - 1 others; E worlds.

    own: VehicleState [E, S]
    direction: [E, S] float32, own driving direction along the road, +1 or -1
    desired_speed: [E, S] float32, m/s
    style_horizon: [E, S] float32, s, own driving style, the one in force now; NaN where the driver chooses
    other: VehicleState [E, S, O]
    own_history: [E, K, S, 3] float32, own poses x, y, yaw (m, m, rad; world), index 0 now, one step apart
    other_history: [E, K, S, O, 3] float32, poses of the others
    """

    own: VehicleState
    direction: Tensor
    desired_speed: Tensor
    style_horizon: Tensor
    other: VehicleState
    own_history: Tensor
    other_history: Tensor

    def of(self, seat: int) -> "Perception":
        """The perception of one seat, S = 1."""
        return self.of_seats([seat])

    def of_seats(self, seats: list[int]) -> "Perception":
        """The perception of some seats, in the order given."""
        if seats == list(range(self.direction.shape[1])):
            return self

        def pick(field: Tensor) -> Tensor:
            return field[:, seats]

        return Perception(
            own=map_tensors(pick, self.own),
            direction=pick(self.direction),
            desired_speed=pick(self.desired_speed),
            style_horizon=pick(self.style_horizon),
            other=map_tensors(pick, self.other),
            own_history=self.own_history[:, :, seats],
            other_history=self.other_history[:, :, seats],
        )


def perceive(world: World) -> Perception:
    """Perfect perception of every vehicle by every other."""
    n_vehicles = world.task.direction.shape[1]
    others = other_columns(n_vehicles, world.step.device)
    task = world.task
    return Perception(
        own=world.vehicles,
        direction=world.task.direction,
        desired_speed=world.task.desired_speed,
        style_horizon=torch.where(world.has_switched, task.next_style_horizon, task.style_horizon),
        other=map_tensors(lambda field: field[:, others], world.vehicles),
        own_history=world.pose_history,
        other_history=world.pose_history[:, :, others],
    )


def other_columns(n_vehicles: int, device: torch.device | str = "cpu") -> Tensor:
    """[V, V-1] int64: for each vehicle the columns of all others, in order."""
    column = torch.arange(n_vehicles - 1, device=device)
    viewer = torch.arange(n_vehicles, device=device)[:, None]
    return column + (column >= viewer)
