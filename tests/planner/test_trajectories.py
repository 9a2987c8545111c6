"""What is executed can be driven by a vehicle: within the limits, smooth, without sliding, turning or creeping."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from composed import compose_config
from games import draw_tasks, pass_through
from situations import draw_situations
from torch import Tensor

from negopipe.game.game import Game, build_game
from negopipe.planner.config import LimitConfig
from negopipe.planner.frenet import FrenetPlanner
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import VehicleState
from negopipe.tensors.tree import map_tensors

DT_S = 0.2
STREETS = ("narrow_lane", pytest.param("bent_street", marks=pytest.mark.slow), "one_sided")
HORIZONS = (0.0, 2.0, 4.0, 6.0)


class Steps(NamedTuple):
    """Steps of vehicles from `before` to `after`, fields [K].

    is_planned: bool, a feasible trajectory was followed
    is_calm: bool, and so it was one step before, so that the vehicle was not left braking beyond the limits
    """

    before: VehicleState
    after: VehicleState
    before_on_road: RouteState
    after_on_road: RouteState
    is_planned: Tensor
    is_calm: Tensor


def make_steps(
    game: Game, before: VehicleState, after: VehicleState, direction: Tensor, is_planned: Tensor, is_calm: Tensor
) -> Steps:
    road = game.simulator.road
    on_road = (road.to_route(before, direction), road.to_route(after, direction))
    return joined([Steps(before, after, *on_road, is_planned, is_calm)], lambda field: field.flatten(0, 1))


def joined(rows: list[Steps], flat: Callable[[Tensor], Tensor] = lambda field: field) -> Steps:
    before, after, road_before, road_after, *rest = map_tensors(lambda *parts: flat(torch.cat(parts)), *rows)
    return Steps(before, after, RouteState(*road_before), RouteState(*road_after), *rest)


def driven(game: Game, scenario: str, n_steps: int = 64) -> list[Steps]:
    """Every pair of horizons, three times, from the start of an episode on."""
    config = compose_config([f"scenario={scenario}"])
    world = game.simulator.reset(draw_tasks(config, 48))
    pairs = torch.cartesian_prod(torch.tensor(HORIZONS), torch.tensor(HORIZONS)).repeat(3, 1)
    was_planned, rows = torch.ones(48, 2, dtype=torch.bool), []
    for _ in range(n_steps):
        motion = game.plan(game.perceive(world), pairs)
        is_planned = ~motion.is_full_braking
        is_calm = is_planned & was_planned
        rows.append(make_steps(game, world.vehicles, motion.state, world.task.direction, is_planned, is_calm))
        world, was_planned = pass_through(game, world, motion.state), is_planned
    return rows


def planned_from_anywhere(game: Game, scenario: str, n_batches: int = 12, n: int = 48) -> list[Steps]:
    """One step from random states in and beside the own lane, with another vehicle somewhere."""
    config, road, rows = compose_config([f"scenario={scenario}"]), game.simulator.road, []
    seen = game.perceive(game.simulator.reset(draw_tasks(config, n))).of(0)
    for seed in range(n_batches):
        x = draw_situations(road, n, seed)
        d, d_prime, _ = road.route_offset(x.route.s, x.direction)
        nearer = x.route._replace(d=d + 0.4 * (x.route.d - d), d_prime=d_prime + 0.3 * (x.route.d_prime - d_prime))
        own = map_tensors(lambda field: field[:, None], road.to_world(nearer, x.direction))
        other = road.to_world(x.others.route, x.others.direction)
        others = map_tensors(lambda field: field[0][:, None, None], other)
        direction = x.direction[:, None]
        motion = game.plan(replace(seen, own=own, other=others, direction=direction), x.horizon[:, None])
        is_planned = ~motion.is_full_braking
        # a vehicle that brakes harder than at its settling rate is eased by the planner at once
        is_calm = is_planned & (nearer.s_ddot >= -config.planner.longitudinal.settle_rate_hz * nearer.s_dot)[:, None]
        rows.append(make_steps(game, own, motion.state, direction, is_planned, is_calm))
    return rows


class Driving(NamedTuple):
    game: Game
    limits: LimitConfig
    drive: list[Steps]
    everything: Steps


@pytest.fixture(scope="module", params=STREETS)
def driving(request: pytest.FixtureRequest) -> Driving:
    game = build_game(compose_config([f"scenario={request.param}"]))
    drive = driven(game, request.param)
    everything = joined(drive + planned_from_anywhere(game, request.param))
    return Driving(game, game.planner.config.limits, drive, everything)


def test_most_steps_are_planned(driving: Driving) -> None:
    assert float(driving.everything.is_planned.float().mean()) > 0.75


def test_speed_acceleration_and_curvature_keep_the_limits(driving: Driving) -> None:
    limits, x = driving.limits, driving.everything
    speed, accel, curvature = (field[x.is_planned] for field in (x.after.speed, x.after.accel, x.after.curvature))
    assert float(x.after.speed.min()) >= 0
    assert float(speed.max()) <= limits.speed_max_mps
    assert float(accel.max()) <= limits.accel_max_mps2
    assert float(accel.min()) >= -limits.decel_max_mps2
    # paths are checked every 0.5 m, at the first point 0.5 m ahead
    assert float(curvature.abs().max()) <= limits.curvature_max_1pm * 1.05
    assert float((speed**2 * curvature.abs()).max()) <= limits.lateral_accel_max_mps2 * 1.05


def test_nothing_brakes_harder_than_full_braking(driving: Driving) -> None:
    x = driving.everything
    full = driving.limits.full_braking_mps2
    gained = (x.after.speed - x.before.speed)[~x.is_planned] / DT_S
    assert float(gained.min()) >= -full - 1.0  # the ratio of path to road changes under way, by up to 12 %
    assert float(gained.max()) <= 1.0


def test_jerk_is_bounded(driving: Driving) -> None:
    """Along the road the limit holds; bends of the path add to what is felt along it, for a step or two."""
    limit, x = driving.limits.jerk_max_mps3, driving.everything
    of_drive = joined(driving.drive)
    along_road = ((of_drive.after_on_road.s_ddot - of_drive.before_on_road.s_ddot) / DT_S)[of_drive.is_calm].abs()
    along_path = ((of_drive.after.accel - of_drive.before.accel) / DT_S)[of_drive.is_calm].abs()
    assert float(along_road.max()) <= limit
    assert float((along_path > limit).float().mean()) < 1e-3
    assert float(along_path.max()) <= 1.25 * limit
    assert float(along_path.quantile(0.99)) < 0.6 * limit
    anywhere = ((x.after.accel - x.before.accel) / DT_S)[x.is_calm].abs()
    assert float(anywhere.max()) <= 1.4 * limit


def test_who_rests_stays_where_it_is(driving: Driving) -> None:
    """To the bit on a straight road; on a bent one the position is rounded on its way to the line and back."""
    x = joined(driving.drive)
    rests = (x.before.speed == 0) & (x.after.speed == 0)
    assert rests.sum() > 100
    rounding = 0.0 if driving.game.simulator.road.reference.is_straight else 1e-5
    assert float((x.after.position - x.before.position)[rests].abs().max()) <= rounding
    assert float(wrap_angle(x.after.yaw - x.before.yaw)[rests].abs().max()) <= max(rounding, 1e-6)
    assert (x.after.accel[rests] == 0).all()


def test_who_starts_from_rest_starts_smoothly(driving: Driving) -> None:
    x = driving.everything
    starts = (x.before.speed == 0) & (x.after.speed > 0)
    assert starts.any()
    accel = driving.limits.jerk_max_mps3 * DT_S
    assert float(x.after.accel[starts].max()) <= accel
    assert float(x.after.speed[starts].max()) <= accel * DT_S  # twice what a constant jerk would reach
    moved = (x.after.position - x.before.position)[starts]
    heading = torch.stack([torch.cos(x.before.yaw[starts]), torch.sin(x.before.yaw[starts])], dim=-1)
    assert float((moved * heading).sum(-1).min()) >= -1e-4


def test_position_follows_speed_and_heading(driving: Driving) -> None:
    x = driving.everything
    step = x.after.position - x.before.position
    turned = wrap_angle(x.after.yaw - x.before.yaw)
    yaw = x.before.yaw + turned / 2
    ahead = torch.cos(yaw) * step[:, 0] + torch.sin(yaw) * step[:, 1]
    across = -torch.sin(yaw) * step[:, 0] + torch.cos(yaw) * step[:, 1]
    mean_speed = (x.before.speed + x.after.speed) / 2
    # the trapezoid errs by dt^2 / 12 of the change in acceleration; a chord is shorter than its arc by turned^2 / 24
    eased = x.is_planned & ~x.is_calm  # restarts from an acceleration that was cut
    expected = mean_speed * DT_S - (x.after.accel - x.before.accel) * DT_S**2 / 12
    off = (ahead - expected)[~eased & x.is_planned]
    assert float(off.abs().max()) < 0.02
    sharper = (x.after.curvature - x.before.curvature) * ahead**2 / 12  # by which a clothoid's chord is off
    assert float((across + sharper).abs().max()) < 0.01
    # the path turns with its curvature, which itself bends within a step: k'' of 0.3 /m3 for 1.1 m is 0.03 rad
    by_curvature = (x.before.curvature + x.after.curvature) / 2 * ahead
    assert float((turned - by_curvature)[x.is_planned].abs().max()) < 0.04
    assert float((turned - by_curvature)[x.is_planned].abs().mean()) < 0.002


def test_candidates_are_consistent_in_time_and_space(driving: Driving) -> None:
    """The step taken is the start of the whole candidate: each derivative is that of the one before."""
    planner = driving.game.planner
    fine_s = 0.01
    fine = FrenetPlanner(replace(planner.config, horizon_s=1.0), planner.road, planner.sizes, fine_s)
    x = draw_situations(planner.road, 40, seed=5)
    coarse_samples = planner.longitudinal.sample(x.route, x.desired_speed)
    samples = fine.longitudinal.sample(x.route, x.desired_speed)
    every = round(DT_S / fine_s)
    for coarse_field, field in zip(coarse_samples[:3], samples[:3], strict=True):
        torch.testing.assert_close(coarse_field[:, :5], field[:, every - 1 :: every], atol=1e-4, rtol=1e-4)
    for value, rate in ((samples.travelled, samples.speed), (samples.speed, samples.accel)):
        change = (value[:, 1:] - value[:, :-1]) / fine_s
        assert float((change - (rate[:, 1:] + rate[:, :-1]) / 2).abs().max()) < 0.02
    coefficients = planner.lateral.start(x.route, x.direction)
    along = torch.arange(0, 12, 0.01)[:, None].expand(-1, 40)
    d, d_prime, d_pprime = planner.lateral.follow(coefficients, x.route.s, x.direction, along)
    for value, rate in ((d, d_prime), (d_prime, d_pprime)):
        change = (value[:, 1:] - value[:, :-1]) / 0.01
        assert float((change - (rate[:, 1:] + rate[:, :-1]) / 2).abs().max()) < 0.02
    for field, start in zip((d, d_prime, d_pprime), (x.route.d, x.route.d_prime, x.route.d_pprime), strict=True):
        torch.testing.assert_close(field[:, 0], start.expand_as(field[:, 0]), atol=1e-5, rtol=1e-5)
