"""Limits of a step: whether a vehicle can get from one state to the next within a control step."""

import torch
from torch import Tensor

from negopipe.safety.config import MotionLimitConfig
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.state import VehicleState
from negopipe.tensors.tree import tensors


def is_finite(state: VehicleState) -> Tensor:
    """[E] bool: no field of the states [E] is NaN or infinite."""
    fields = [field.isfinite() for field in tensors(state)]
    return torch.stack([field.all(-1) if field.dim() > 1 else field for field in fields]).all(0)


def is_drivable(limits: MotionLimitConfig, before: VehicleState, after: VehicleState, dt_s: float) -> Tensor:
    """[E] bool: speed, its change, curvature and acceleration across the path are within the limits, and the position
    and the heading are where they lead; states [E]."""
    speed, slack = after.speed, limits.tolerance_mps
    fastest = before.speed.clamp(min=limits.speed_max_mps) + slack
    gain = speed - before.speed
    is_ok = (speed.abs() <= fastest) & (gain.abs() <= limits.decel_max_mps2 * dt_s + slack)
    is_ok = is_ok & (speed.abs() - before.speed.abs() <= limits.accel_max_mps2 * dt_s + slack)
    is_ok = is_ok & (after.curvature.abs() <= limits.curvature_max_1pm)
    is_ok = is_ok & (speed**2 * after.curvature.abs() <= limits.lateral_accel_max_mps2)
    turn = wrap_angle(after.yaw - before.yaw)
    travelled = (before.speed + speed) / 2 * dt_s
    is_ok = is_ok & (turn.abs() <= limits.curvature_max_1pm * travelled.abs() + slack * dt_s)
    middle = before.yaw + turn / 2
    expected = torch.stack([travelled * torch.cos(middle), travelled * torch.sin(middle)], -1)
    return is_ok & ((after.position - before.position - expected).norm(dim=-1) <= slack * dt_s)
