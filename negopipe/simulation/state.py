"""Tensor dataclasses that hold the world, and the axes, declared once.

Axes: E worlds, V vehicles (column 0 is the ego, the others are social: those that come towards it, then those behind
it), T time, P parked cars, H/W rows and columns of the grid, C candidates of the planner.

Frames
    world   right-handed, metres; the corridor's middle is the origin and the road's reference line leaves it
            along +x. A straight road's line is the x axis.
    line    of the road: `sigma` along the reference line with sigma = 0 in the corridor's middle, `d` to its left.
    route   per vehicle: `s` along the line in its own driving direction with s = 0 at the mouth of the corridor
            that the vehicle meets first, `d` to its own left; the corridor spans 0 <= s <= corridor length.
    body    x ahead, y to the left, origin at the centre of the footprint.

A direction is a signed number: +n along the line of street n, -n against it, with n from 1; +1 and -1 where there is
one street. All vehicles of a world drive on one street.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Memory

EGO = 0
"""Column of the ego on every vehicle axis."""

NEAREST = 1
"""Column of the social vehicle that starts nearest to its mouth of the corridor."""

NOBODY = -1
"""`Casting.driver` of a vehicle without a driver of the population: of the ego, and where tasks have no population."""

ABSENT_M = 1000.0
"""Distance behind a mouth, m, from which on a vehicle that starts there takes no part in an episode."""

AT_REST_MPS = 0.1
"""A vehicle that is slower than this, forwards or backwards, is at rest (docs/reading.md, "suspend number")."""


@dataclass(frozen=True)
class VehicleState:
    """Motion of vehicles at one instant; every field has the same leading axes, usually [E, V].

    position: [..., 2] float32, m, world (centre of the footprint)
    yaw: [...] float32, rad, world
    speed: [...] float32, m/s, negative of a vehicle that drives backwards
    accel: [...] float32, m/s2, along the path
    curvature: [...] float32, 1/m, of the path driven, positive to the left
    """

    position: Tensor
    yaw: Tensor
    speed: Tensor
    accel: Tensor
    curvature: Tensor


@dataclass(frozen=True)
class Casting:
    """Drivers of the vehicles in E episodes; drawn by `agents.population.Cast`.

    driver: [E, V] int64, index in the population; `NOBODY` for an ego that is none of it, and everywhere in tasks
        without a population
    redraw_steps: [E, V] int64, control steps after which the prediction horizon is redrawn, over and over; 0 = never
    redrawn_horizon: [E, V, R] float32, s, the horizons in their order, from the episode's start on; NaN where there
        are none, and R = 0 where no driver has any
    reaction_steps: [E, V] int64, control steps by which the driver goes by what it saw before
    lapse_share: [E, V] float32, share of the seconds in which the driver sees nobody
    """

    driver: Tensor
    redraw_steps: Tensor
    redrawn_horizon: Tensor
    reaction_steps: Tensor
    lapse_share: Tensor

    @staticmethod
    def of_nobody(direction: Tensor) -> "Casting":
        """Without a population; direction: [E, V]."""
        nobody = torch.full_like(direction, NOBODY, dtype=torch.int64)
        none, no_horizon = torch.zeros_like(nobody), direction.new_zeros(*direction.shape, 0)
        return Casting(nobody, none, no_horizon, none.clone(), torch.zeros_like(direction))


@dataclass(frozen=True)
class Task:
    """Initial conditions of E episodes; drawn by `scenario.TaskSampler`.

    start_distance: [E, V] float32, m, from the vehicle's centre to the mouth that it meets first
    start_speed, desired_speed: [E, V] float32, m/s
    style_horizon: [E, V] float32, s, prediction horizon of the social vehicles; NaN where the driver chooses
    next_style_horizon: [E, V] float32, s, prediction horizon after a switch; NaN where there is none
    switch_time: [E, V] float32, s, time in the episode of a switch; inf = never
    patience: [E, V] float32, s, time at rest without a break before a switch; inf = never
    direction: [E, V] float32, +n drives along the line of street n (n from 1; towards growing sigma), -n against it
    noise_seed: [E] int64, from 0 to 2^24 - 1, of the errors with which vehicles perceive each other
    family: [E] int64, index of the task family (push, yield, ...) in `TaskSampler.families`
    length, width: [E, V] float32, m, of the footprint
    casting: who drives the social vehicles
    """

    start_distance: Tensor
    start_speed: Tensor
    desired_speed: Tensor
    style_horizon: Tensor
    next_style_horizon: Tensor
    switch_time: Tensor
    patience: Tensor
    direction: Tensor
    noise_seed: Tensor
    family: Tensor
    length: Tensor
    width: Tensor
    casting: Casting

    def __len__(self) -> int:
        return self.family.shape[0]

    @property
    def is_present(self) -> Tensor:
        """[E, V] bool: the vehicle takes part; absent ones have arrived long before, far away."""
        return self.start_distance > -ABSENT_M


@dataclass(frozen=True)
class Sightings:
    """Every other vehicle (O = V - 1 of them) as every vehicle knows it, in the last J steps, index 0 the latest.

    pose: [E, J, V, O, 3] float32, x, y, yaw (m, m, rad; world)
    speed: [E, J, V, O] float32, m/s
    is_seen: [E, J, V, O] bool; where false, the others are 0 and mean nothing
    """

    pose: Tensor
    speed: Tensor
    is_seen: Tensor


@dataclass(frozen=True)
class Estimate:
    """Estimate of a vehicle's motion: means and covariances of a Kalman filter (`tracker.py`); leading axes [...].

    position, velocity: [..., 2] float32, m and m/s, world
    covariance: [..., 3] float32, along each of the world's axes, which are independent and alike: of position
        (m2), of position and velocity (m2/s), of velocity (m2/s2)
    yaw: [...] float32, rad, world
    yaw_variance: [...] float32, rad2
    """

    position: Tensor
    velocity: Tensor
    covariance: Tensor
    yaw: Tensor
    yaw_variance: Tensor


@dataclass(frozen=True)
class Tracks:
    """Tracks of every other vehicle by every vehicle; without a tracker all tensors are empty.

    estimate: Estimate [E, V, O], of the time of the last sighting; 0 where there is no track
    n_missed: [E, V, O] int64, sightings missed in a row; more than a tracker carries on for where there is no track
    history: Sightings, J steps: the vehicles as they were tracked at these steps, without later knowledge
    """

    estimate: Estimate
    n_missed: Tensor
    history: Sightings


@dataclass(frozen=True)
class World:
    """Complete state of E worlds; a step maps one to the next.

    vehicles: VehicleState [E, V]
    reference: VehicleState [E, V], state of each vehicle in its own plan, from which the next plan starts; with
        perfect dynamics the same as `vehicles`
    task: Task
    step: [E] int64, decisions taken in this episode
    has_reached: [E, V] bool, the vehicle has passed its target in this episode
    has_collided: [E, V] bool, the vehicle touched another vehicle, a parked car or the kerb
    rest_steps: [E, V] int64, control steps for which the vehicle has been at rest without a break until now; those
        within the episode's first second do not count
    last_horizon: [E, V] float32, s, prediction horizon of the plan that the vehicle drove by in the last step; NaN at
        the start of an episode, and for a driver without horizons
    has_switched: [E, V] bool, the vehicle drives in its task's next style from now on
    pose_history: [E, K, V, 3] float32, x (m), y (m), yaw (rad) in the world frame; index 0 is now, index k is
        k steps ago. Before the episode's start the first state is repeated.
    speed_history: [E, K, V] float32, m/s, of the same states
    command_queue: [E, D, V, 2] float32, commands on their way to the actuators (`dynamics.Dynamics.move`)
    tracks: Tracks, what each vehicle's tracker holds of the others
    kept_stop: [E, K] float32, path of the stop that the ego's last plan left it (`negopipe.safety`), NaN at the start
        of an episode; K = 0 without a safety layer
    """

    vehicles: VehicleState
    reference: VehicleState
    task: Task
    step: Tensor
    has_reached: Tensor
    has_collided: Tensor
    rest_steps: Tensor
    last_horizon: Tensor
    has_switched: Tensor
    pose_history: Tensor
    speed_history: Tensor
    command_queue: Tensor
    tracks: Tracks
    kept_stop: Tensor

    @property
    def style_horizon(self) -> Tensor:
        """[E, V] float32, s: the driving style in force now; NaN where the driver chooses."""
        task = self.task
        style = torch.where(self.has_switched, task.next_style_horizon, task.style_horizon)
        n_kept, redrawn = task.casting.redraw_steps, task.casting.redrawn_horizon
        if redrawn.shape[-1] == 0:
            return style
        index = (self.step[:, None] // n_kept.clamp(min=1)).clamp(max=redrawn.shape[-1] - 1)
        return torch.where(n_kept > 0, redrawn.gather(-1, index[..., None])[..., 0], style)

    def horizons(self, ego: Tensor | float) -> Tensor:
        """[E, V] float32, s: `ego` [E] for the ego, else and where that is NaN the driving style in force now."""
        horizons = self.style_horizon
        given = torch.full_like(self.step, ego, dtype=torch.float32) if isinstance(ego, float) else ego
        horizons[:, EGO] = torch.where(given.isnan(), horizons[:, EGO], given)
        return horizons


def world_memory(n_worlds: int, n_vehicles: int, memory_steps: int, delay_steps: int) -> Memory:
    """Memory of worlds that remember `memory_steps` past states, while everyone looks at everyone's past."""
    n_numbers = memory_steps * n_vehicles**2 * 4 + delay_steps * n_vehicles * 2
    keys = "algorithm.n_worlds scenario.n_social scenario.n_followers scenario.dt_s observation.n_frames"
    keys += " observation.frame_interval_s perception.delay_s perception.accel_window_s"
    return Memory("the worlds' past", n_worlds * n_numbers * FLOAT_BYTES * N_TEMPORARIES, tuple(keys.split()))


@dataclass(frozen=True)
class Motion:
    """Motion of S agents in E worlds until the next decision, as their drivers want it.

    state: VehicleState [E, S], wanted one control step later
    horizon: [E, S] float32, s, prediction horizon of the plan; NaN for a driver without one
    is_full_braking: [E, S] bool, no feasible plan existed
    """

    state: VehicleState
    horizon: Tensor
    is_full_braking: Tensor
