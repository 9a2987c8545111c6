"""Arguments of an exported decision from a perception: what a host gives it, for the check of parity."""

import torch
from torch import Tensor

from negopipe.simulation.perception import Perception


def decision_inputs(perception: Perception, dt_s: float, n_others: int) -> dict[str, Tensor]:
    """Arguments of `decision.Decision` for E worlds, each with a first axis E, without the street.

    perception: of one agent, S = 1, that sees at most `n_others`; what is beyond its number is not seen
    """
    own, other = perception.own, perception.other
    state = [own.position[..., 0], own.position[..., 1], own.yaw, own.speed, own.accel, own.curvature]
    rest = [perception.desired_speed, perception.last_horizon, perception.rest_steps * dt_s]
    columns = [*state, *rest, perception.length, perception.width]
    pose = [other.position[:, 0, :, 0], other.position[:, 0, :, 1]]
    rows = [other.yaw, other.speed, other.accel, perception.other_length, perception.other_width]
    others = torch.stack([*pose, *(field[:, 0] for field in rows)], -1)
    n_missing = n_others - others.shape[1]
    return {
        "own": torch.cat(columns, 1).clone(),
        "own_history": perception.own_history[:, :, 0].clone(),
        "others": torch.nn.functional.pad(others, (0, 0, 0, n_missing)),
        "others_history": torch.nn.functional.pad(perception.other_history[:, :, 0], (0, 0, 0, n_missing)),
        "is_seen": torch.nn.functional.pad(perception.is_seen_history[:, :, 0].float(), (0, n_missing)),
        "direction": torch.sign(perception.direction),
    }
