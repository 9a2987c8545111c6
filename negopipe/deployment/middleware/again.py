"""A recorded drive through the runtime once more: the same messages, decisions for the same times."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from negopipe.deployment.middleware.codec import decode, encode
from negopipe.deployment.middleware.incoming import stamp_ns
from negopipe.deployment.middleware.interface import DEBUG, INPUTS, TRAJECTORY
from negopipe.deployment.middleware.planning_node import PlanningNode
from negopipe.deployment.middleware.recording import SEED, about, messages
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.deployment.negotiator import Negotiator
from negopipe.errors import UserError

ALLOWED_M, ALLOWED_MPS = 1e-3, 1e-2
"""Differences that another machine's rounding may make."""


@dataclass(frozen=True)
class Comparison:
    """How the trajectories of a replay differ from the recorded ones.

    n_decisions: of the recording; n_trajectories: those with a recorded trajectory
    n_equal: the same bit for bit; n_unpaired: decisions with a trajectory on one side only
    largest_m, largest_mps: largest differences of a place and of a speed at the same time of a plan
    """

    n_decisions: int
    n_trajectories: int
    n_equal: int
    n_unpaired: int
    largest_m: float
    largest_mps: float

    @property
    def is_same(self) -> bool:
        """Whether the differences are rounding at most."""
        return not self.n_unpaired and self.largest_m <= ALLOWED_M and self.largest_mps <= ALLOWED_MPS


def seed_of(path: Path) -> int:
    """Seed of the horizons that were drawn in a recording. UserError where it holds none."""
    try:
        return int(about(path)[SEED])
    except (KeyError, ValueError) as error:
        raise UserError(f"{path} must hold the seed of its drawn horizons, got {error}") from error


def replay(path: Path, negotiator: Negotiator) -> Comparison:
    """Drive a recording again and compare. UserError where the file is no recording."""
    try:
        vehicle = Vehicle.of_texts(about(path))
    except (KeyError, ValueError) as error:
        raise UserError(f"{path} must hold the measures of its vehicle, got {error}") from error
    pairs = list(_pairs(path, PlanningNode(negotiator, vehicle, negotiator.settings.dt_s)))
    both = [(one, two) for one, two in pairs if one and two]
    apart = np.array([_difference(*pair) for pair in both]).reshape(-1, 2)
    return Comparison(
        n_decisions=len(pairs),
        n_trajectories=sum(bool(one) for one, _ in pairs),
        n_equal=sum(one == two for one, two in both),
        n_unpaired=sum(bool(one) != bool(two) for one, two in pairs),
        largest_m=float(apart[:, 0].max(initial=0.0)),
        largest_mps=float(apart[:, 1].max(initial=0.0)),
    )


def _pairs(path: Path, node: PlanningNode) -> Iterator[tuple[bytes, bytes]]:
    """Recorded and new trajectory of each decision, empty where there was none."""
    stamp, recorded, new = None, b"", b""
    for topic, data in messages(path):
        try:
            message = decode(data, topic.type_name)
        except UserError:  # as the node left it out
            continue
        if topic in INPUTS:
            node.take(topic, message)
        elif topic in (TRAJECTORY, DEBUG):
            if stamp_ns(message) != stamp:
                if stamp is not None:
                    yield recorded, new
                stamp, recorded = stamp_ns(message), b""
                said = dict(node.decide(stamp))
                new = encode(said[TRAJECTORY]) if TRAJECTORY in said else b""
            if topic is TRAJECTORY:
                recorded = data
    if stamp is not None:
        yield recorded, new


def _difference(one: bytes, two: bytes) -> tuple[float, float]:
    """Largest difference of a place, m, and of a speed, m/s, of two trajectories of one length."""
    rows = [
        np.array([[p.pose.position.x, p.pose.position.y, p.longitudinal_velocity_mps] for p in each.points])
        for each in (decode(data, TRAJECTORY.type_name) for data in (one, two))
    ]
    apart = rows[0] - rows[1]
    return float(np.hypot(apart[:, 0], apart[:, 1]).max()), float(np.abs(apart[:, 2]).max())
