"""Computations on the record of E episodes: suspensions, precedence in the corridor, the behaviour index of Eq. 7.

The terms are those of docs/reading.md, "suspend number" and "psi (Eq. 7)".
"""

import numpy as np

from negopipe.evaluation.trace import Trace
from negopipe.simulation.state import AT_REST_MPS, EGO, NEAREST

MOVING_MPS = 0.5
"""Speed above which a vehicle counts as moving; between rest and this speed its last state counts."""


def running(trace: Trace) -> np.ndarray:
    """[T, E] bool: the decision was taken before the episode's end."""
    return np.arange(trace.reward.shape[0])[:, None] < trace.n_steps


def suspensions(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    """Times the ego comes to rest after having moved, before it reaches its target, and time at rest.

    Returns the count [E] int64 and the time [E] float64, s. The state after a decision stands for that
    decision's dt.
    """
    speed = np.abs(trace.speed_mps[:, :, EGO])
    reached = trace.reached_step[:, EGO]
    last_step = np.where(reached >= 0, np.minimum(reached, trace.n_steps), trace.n_steps)
    has_moved = speed[0] > MOVING_MPS
    is_moving = has_moved.copy()
    count = np.zeros(len(last_step), dtype=np.int64)
    n_rest = np.zeros(len(last_step), dtype=np.int64)
    for step in range(1, len(speed)):
        is_rest = (speed[step] < AT_REST_MPS) & has_moved & (step <= last_step)
        count += is_rest & is_moving
        n_rest += is_rest
        has_moved |= speed[step] > MOVING_MPS
        is_moving = np.where(is_rest, False, is_moving | (speed[step] > MOVING_MPS))
    return count, n_rest * trace.dt_s


def passes_first(trace: Trace) -> np.ndarray:
    """[E] str, ego | social | none: whose centre was the first to leave the corridor at its far end."""
    is_through = trace.progress_m > trace.corridor_m[:, None]
    never = len(is_through)
    step = np.where(is_through.any(0), is_through.argmax(0), never)
    ego, social = step[:, EGO], step[:, EGO + 1 :].min(1)
    return np.select([ego < social, social < never], ["ego", "social"], default="none")


def behaviour_index(trace: Trace) -> np.ndarray:
    """psi of Eq. 7, [T+1, E] float64, rad: positive = prosocial, negative = competitive, NaN after the end.

    psi = atan((s_soc - s_ego) / (d_ini_ego / d_ini_soc)) with the distances s travelled since the start, from
    when the social vehicle is perceived; of several social vehicles the one that starts nearest counts.
    """
    travelled = (trace.progress_m - trace.progress_m[0]).astype(np.float64)
    ratio = trace.start_distance_m[:, EGO] / trace.start_distance_m[:, NEAREST]
    psi = np.arctan((travelled[:, :, NEAREST] - travelled[:, :, EGO]) / ratio)
    return np.where(np.arange(len(psi))[:, None] <= trace.n_steps, psi, np.nan)


def mean_over(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Mean of [T, E] values where the mask holds; NaN where it never does or a value is NaN."""
    total = np.where(mask, values, 0.0).sum(0, dtype=np.float64)
    n = mask.sum(0)
    return np.divide(total, n, out=np.full(len(n), np.nan), where=n > 0)
