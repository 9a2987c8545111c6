"""The jerk limit holds from the state planned from on: the step that is executed is the first one."""

import torch
from situations import draw_situations

from negopipe.game.game import Game


def test_the_first_step_keeps_the_jerk_limit(game: Game) -> None:
    planner = game.planner
    limit, dt = planner.config.limits.jerk_max_mps3, planner.dt_s
    rate, n_drivable = planner.config.longitudinal.settle_rate_hz, 0
    for seed in range(10):
        x = draw_situations(planner.road, 60, seed)
        samples = planner.longitudinal.sample(x.route, x.desired_speed)
        paths = planner._paths(x)
        is_drivable = planner._is_drivable(samples, paths).any(0)  # [C, N]
        planned_from = torch.maximum(x.route.s_ddot, -rate * x.route.s_dot)
        jerk = (samples.accel[:, 0] - planned_from) / dt
        n_drivable += int(is_drivable.sum())
        assert float(jerk[is_drivable].abs().max()) <= limit
    assert n_drivable > 1000
