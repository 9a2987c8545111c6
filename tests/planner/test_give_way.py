"""An infinite horizon: who gives way enters the passage only if it is out before the other could be in, or after it."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks, drive, meet
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.state import EGO, Motion, World
from negopipe.tensors.tree import map_tensors

INF = math.inf
STREETS = ["narrow_lane", pytest.param("bent_street", marks=pytest.mark.slow), "one_sided"]


def built(street: str) -> tuple[RunConfig, Game]:
    config = compose_config([f"scenario={street}", "planner=consistent_stops"])
    return config, build_game(config)


@pytest.fixture(scope="module")
def narrow() -> tuple[RunConfig, Game]:
    return built("narrow_lane")


def rule_of(game: Game, world: World) -> tuple[Tensor, Tensor]:
    """Earliest entry and latest exit of the other as the ego sees it, [E] s each."""
    seen = game.perceive(world).of(EGO)
    assert game.planner.give_way is not None
    now = game.planner.situation(seen, torch.full_like(seen.direction, INF))
    earliest, latest = game.planner.give_way.times_of_others(now)
    return earliest[0], latest[0]


def test_the_others_times_are_those_of_its_fastest_and_of_its_present_speed(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    world = meet(config, game, [[-30.0, -29.0], [-30.0, -29.0], [-30.0, 0.0], [-30.0, 21.25]],
                 [[5.0, 7.0], [5.0, 0.0], [5.0, 3.0], [5.0, 3.0]])  # fmt: skip
    earliest, latest = rule_of(game, world)
    # 20 m to the passage at 7 m/s; or from rest, 7^2 / 4.8 = 10.2 m of gaining speed in 2.92 s; inside; out
    expected = [20 / 7, 7 / 2.4 + (20 - 49 / 4.8) / 7, 0.0]
    assert earliest[:3].tolist() == pytest.approx(expected, abs=1e-3)
    assert latest[[0, 2]].tolist() == pytest.approx([(21.0 + 29.0) / 7, 21.0 / 3], abs=1e-3)
    assert float(latest[1]) > 1e5  # who stands may stand for ever
    assert float(earliest[3]) > 1e5
    assert float(latest[3]) < -1e5


def test_who_gives_way_goes_first_only_where_the_other_is_far(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    world = meet(config, game, [[-13.0, -60.0], [-13.0, -24.0]], [[5.0, 3.0], [5.0, 3.0]])
    worlds = drive(game, world, torch.tensor([[INF, 0.0]]).expand(2, 2), 12)
    s = game.simulator.road.progress(worlds[-1].vehicles.position, worlds[-1].task.direction)
    assert float(s[0, EGO]) > -3
    assert float(s[1, EGO]) < -8.6
    six = drive(game, world, torch.tensor([[6.0, 0.0]]).expand(2, 2), 12)[-1]
    s = game.simulator.road.progress(six.vehicles.position, six.task.direction)
    assert float(s[1, EGO]) > -8.6  # constant speed says that there is room


@pytest.mark.parametrize("street", STREETS)
def test_who_gives_way_gets_through_behind_everyone_who_comes(street: str) -> None:
    config, game = built(street)
    start = [[-ego, -other] for ego in (12.0, 16.0, 21.0) for other in (9.0, 14.0, 19.0, 25.0)]
    world = meet(config, game, start, [[4.0, 3.0 + 0.2 * i] for i in range(12)])
    worlds = drive(game, world, torch.tensor([[INF, 0.0]]).expand(12, 2), config.scenario.episode_steps)
    assert not worlds[-1].has_collided.any()
    assert worlds[-1].has_reached.all()


def test_mirrored_tasks_give_mirrored_drives(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    start, speed = [[-13.0, -15.0], [-18.0, -24.0]], [[5.0, 4.0], [3.0, 5.0]]
    worlds = drive(game, meet(config, game, start, speed), torch.tensor([[INF, 2.0]]).expand(2, 2), 60)
    swapped = meet(config, game, [row[::-1] for row in start], [row[::-1] for row in speed])
    swapped = replace(swapped, task=replace(swapped.task, desired_speed=swapped.task.desired_speed.flip(1)))
    mirrored = drive(game, swapped, torch.tensor([[2.0, INF]]).expand(2, 2), 60)
    for one, other in zip(worlds, mirrored, strict=True):
        torch.testing.assert_close(one.vehicles.position, -other.vehicles.position.flip(1), atol=2e-3, rtol=0)


def test_three_others_are_all_let_through() -> None:
    config = compose_config(["scenario.n_social=3", "planner=consistent_stops"])
    game = build_game(config)
    world = meet(config, game, [[-14.0, -12.0, -24.0, -36.0]], [[4.0, 5.0, 5.0, 5.0]])
    worlds = drive(game, world, torch.tensor([[INF, 0.0, 0.0, 0.0]]), config.scenario.episode_steps)
    assert not worlds[-1].has_collided.any()
    assert worlds[-1].has_reached.all()


def test_finite_horizons_know_no_rule(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    without = build_game(compose_config(["planner=consistent_stops", "planner.give_way=null"]))
    world, horizon = game.simulator.reset(draw_tasks(config, 16)), torch.tensor([[6.0, 2.0], [0.0, 4.0]]).repeat(8, 1)
    for _ in range(20):
        motion = game.plan(game.perceive(world), horizon)
        again = without.plan(without.perceive(world), horizon)
        assert torch.equal(motion.state.position, again.state.position)
        world, _ = game.simulator.step(world, motion.state)


def test_a_batch_equals_single_worlds(narrow: tuple[RunConfig, Game]) -> None:
    def alone(world: World, horizon: Tensor) -> tuple[Motion, int]:
        return narrow[1].plan(narrow[1].perceive(map_tensors(lambda f: f[5:6], world)), horizon[5:6]), 5

    compare_drives(narrow, alone)


@pytest.mark.slow
def test_compiled_equals_eager(narrow: tuple[RunConfig, Game]) -> None:
    compiled = build_game(narrow[0], "cpu", is_compiled=True)
    compare_drives(narrow, lambda world, horizon: (compiled.plan(compiled.perceive(world), horizon), None))


def compare_drives(narrow: tuple[RunConfig, Game], other: Callable[[World, Tensor], tuple[Motion, int | None]]) -> None:
    """Plans of a batch agree with those of `other`, which may be of one of its worlds alone."""
    config, game = narrow
    world, horizon = game.simulator.reset(draw_tasks(config, 8)), torch.tensor([[INF, 2.0], [4.0, INF]]).repeat(4, 1)
    for step in range(24):
        together = game.plan(game.perceive(world), horizon)
        if step % 6 == 0:
            motion, of = other(world, horizon)
            same = together if of is None else map_tensors(lambda f, i=of: f[i : i + 1], together)
            states = (motion.state, same.state)
            map_tensors(lambda x, y: torch.testing.assert_close(x, y, atol=1e-4, rtol=1e-4) or x, *states)
        world, _ = game.simulator.step(world, together.state)


@pytest.mark.parametrize("option", ["margin_s=4.0", "accel_mps2=0.1", "speed_max_mps=3.0"])
def test_options_act(narrow: tuple[RunConfig, Game], option: str) -> None:
    config, game = narrow
    other = build_game(compose_config(["planner=consistent_stops", f"planner.give_way.{option}"]))
    world = meet(config, game, [[-13.0, -14.0 - 1.5 * i] for i in range(32)], [[5.0, 2.5]] * 32)
    first, second = (drive(g, world, torch.tensor([[INF, 6.0]]).expand(32, 2), 8)[-1] for g in (game, other))
    assert float((first.vehicles.position - second.vehicles.position)[:, EGO].abs().max()) > 0.5
