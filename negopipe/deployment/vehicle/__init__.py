"""A vehicle that nobody here modelled, around an exported policy: closed loop through the runtime.

One control step of the simulator

    sensors.py      frames of the others (late, noisy, with gaps) and the own pose -> messages
    Negotiator      messages -> trajectory, every `scenario.dt_s`
    controller.py   trajectory, own pose -> acceleration and steering angle, every `control_s`
    actuators.py    lags of pedals and steering
    plant.py        the car at 1 kHz: multi_body.py of commonroad-vehicle-models, kinematic.py at walking pace

driver.py puts these into the place of the ego's driver in the simulator's evaluation, so that the other vehicles, the
tasks, the outcomes and the measures are those of `evaluate`. `python -m negopipe.deployment.vehicle` drives encounters.
"""
