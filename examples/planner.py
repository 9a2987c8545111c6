"""The planner on its own: a car before a corridor between parked cars, an oncoming one, and the plan of each horizon.

    python examples/planner.py plans.png

A short prediction horizon pushes into the corridor, a long one waits before it.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from negopipe.planner.street_planner import Plans, StreetPlanner

HORIZONS_S = (0.0, 2.0, 4.0, 6.0)


def plans_of(planner: StreetPlanner, oncoming_m: float) -> Plans:
    """A plan for every horizon; the other comes from `oncoming_m` beyond the corridor's middle."""
    n = len(HORIZONS_S)
    ego = [-16.0, -1.75, 0.0, 4.8]  # x, y, yaw, speed
    other = [oncoming_m, 1.75, np.pi, 5.0]
    return planner.plan([ego] * n, [[other]] * n, HORIZONS_S, desired_speed_mps=6.0)


def main(picture: str) -> NDArray[np.float32]:
    """Draw the plans over time into a file and return how far each gets, m."""
    planner = StreetPlanner.of("narrow_lane", "frenet", road={"corridor_gap_m": 3.2})
    plans = plans_of(planner, oncoming_m=18.0)
    figure, axes = plt.subplots(figsize=(6.0, 3.5), layout="constrained")
    for horizon, x in zip(HORIZONS_S, plans.states.position[..., 0].numpy(), strict=True):
        width = 8 - horizon  # plans that coincide show as lines within lines
        axes.plot(planner.times.numpy(), x, linewidth=width, label=f"prediction horizon of {horizon:g} s")
    axes.axhspan(-6.0, 6.0, color="0.9")  # the corridor
    axes.set(xlabel="time (s)", ylabel="place along the street (m)")
    axes.legend()
    figure.savefig(picture)
    plt.close(figure)
    distance: NDArray[np.float32] = plans.states.position[:, -1, 0].numpy()
    return distance


if __name__ == "__main__":
    print(main(sys.argv[1]))
