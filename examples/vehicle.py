"""An exported policy in a vehicle: messages in, a trajectory out; needs NumPy and onnxruntime alone.

python -m negopipe.deployment.export pretrained/yield export +experiment=yield 'export.files=[policy,decision]'
python examples/vehicle.py export
"""

import sys

import numpy as np

from negopipe.deployment import EgoState, Negotiator, ObjectState


def main(folder: str) -> None:
    """Ten decisions on a street of 7 m with parked cars on both sides, while another car comes towards the ego."""
    negotiator = Negotiator.load(folder)
    x = np.linspace(-60.0, 60.0, 121)
    left, right = (np.column_stack([x, np.full_like(x, y)]) for y in (3.5, -3.5))
    parked = np.array([[at, y, 0.0, 3.6, 1.9] for at in (-4.2, 0.0, 4.2) for y in (2.55, -2.55)])
    street = negotiator.street_between(left, right, parked)
    state = np.array([-20.0, -1.75, 0.0, 4.8, 0.0, 0.0])  # x, y, yaw, speed, acceleration, curvature
    for time_s in 0.2 * np.arange(10):
        ego = EgoState(*[time_s, *state, 6.0])  # wants to drive at 6 m/s
        car = ObjectState("car", time_s, 22.0 - 5.0 * time_s, 1.75, np.pi, 5.0, length=4.5, width=1.8)
        plan = negotiator.decide(ego, [car], street, time_s)
        print(f"{time_s:.1f} s  horizon {plan.horizon_s:g} s  {state[3]:.2f} m/s  {plan.diagnostics.intervention}")
        state = plan.at(time_s + 0.2)  # a vehicle that drives its plan


if __name__ == "__main__":
    main(sys.argv[1])
