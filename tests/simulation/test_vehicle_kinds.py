"""Kinds of vehicles: what is drawn, what is refused, and that one size costs and changes nothing."""

import re
from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks, drive

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.game.game import Game, build_game
from negopipe.simulation.geometry import Size
from negopipe.simulation.perception import other_columns
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.tree import map_tensors

ALL = "scenario/kind=[small_car,car,van,bus,cyclist]"
FOUR = ("scenario.n_social=2", "scenario.n_followers=1", "scenario.episode_steps=60", ALL)


def built(*overrides: str) -> tuple[RunConfig, Game]:
    config = compose_config(list(overrides))
    return config, build_game(config)


def test_every_kind_is_drawn_by_its_weight_and_within_its_sizes() -> None:
    weighted = compose_config([ALL, "scenario.kinds.bus.weight=3.0", "scenario.n_social=3"])
    task = draw_tasks(weighted, 4000)
    length, width, speed = (field[:, 1:].flatten() for field in (task.length, task.width, task.desired_speed))
    is_bus, is_cyclist = length == 7.4, width < 1.0
    assert float(is_bus.float().mean()) == pytest.approx(3 / 7, abs=0.02)
    assert float(is_cyclist.float().mean()) == pytest.approx(1 / 7, abs=0.02)
    assert (speed[~is_cyclist] == 6.0).all()
    assert 4.2 <= float(speed[is_cyclist].min()) < 4.3
    assert 5.5 < float(speed[is_cyclist].max()) <= 5.6
    assert (task.start_speed <= task.desired_speed).all()
    is_van = (length >= 4.9) & (length <= 5.9)
    assert float(length[is_van].max() - length[is_van].min()) > 0.9
    assert torch.equal(task.length[:, EGO], torch.full((4000,), 4.5))
    plain = draw_tasks(compose_config(["scenario.n_social=3"]), 4000)
    assert torch.equal(plain.start_distance, task.start_distance)
    assert torch.equal(plain.noise_seed, task.noise_seed)
    assert torch.equal(plain.width, torch.full_like(plain.width, 1.8))


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (
            ("scenario/kind=[bus]", "scenario.kinds.bus.width_m=3.3"),
            "scenario.kinds.bus.width_m must be at most scenario.road.corridor_gap_m = 3.2, got 3.3",
        ),
        (
            ("scenario/kind=[bus]", "scenario.kinds.bus.length_m=[7.0,12.0]"),
            "scenario.kinds.bus must fit along the routes of all streets (a longer scenario.road.swerve_length_m, a "
            "wider gap), got 12 m x 2 m, which touches a parked car or a kerb ",
        ),
        (("scenario/kind=[van]", "scenario.kinds.van.width_m=[2.0,1.9]"), "scenario.kinds.van.width_m must be "),
    ],
)
def test_a_kind_that_does_not_fit_is_refused(overrides: tuple[str, ...], line: str) -> None:
    with pytest.raises(UserError, match=f"^{re.escape(line)}"):
        compose_config(overrides)


def test_a_city_bus_fits_where_routes_are_longer() -> None:
    compose_config(
        [
            "scenario/kind=[bus]", "scenario.kinds.bus.length_m=12.0", "scenario.kinds.bus.width_m=2.55",
            "scenario.road.swerve_length_m=20.0", "scenario.road.swerve_margin_m=6.0",
            "scenario.ego_start_distance_m=[30.0,30.0]",
        ]
    )  # fmt: skip


def test_bounds_and_numbers_of_one_size() -> None:
    one, many = compose_config([]).scenario.sizes, compose_config([ALL]).scenario.sizes
    assert (one.ego, one.smallest, one.largest) == (Size(4.5, 1.8),) * 3
    assert one.is_one
    assert not many.is_one
    assert (many.smallest, many.largest) == (Size(1.8, 0.7), Size(7.4, 2.02))
    two = torch.tensor([4.5, 7.5])
    assert one.of(two, two) == Size(4.5, 1.8)
    assert many.of(two, two).length is two
    assert torch.equal(torch.as_tensor(many.longer_m(two)), torch.tensor([0.0, 1.5]))
    assert one.longer_m(two) == 0.0


def test_perception_has_the_sizes_of_the_others() -> None:
    config, game = built(*FOUR)
    task = draw_tasks(config, 6)
    seen = game.perceive(game.simulator.reset(task))
    others = other_columns(4)
    assert torch.equal(seen.other_length, task.length[:, others])
    assert torch.equal(seen.of(2).other_width[:, 0], task.width[:, others[2]])
    assert torch.equal(seen.of(2).width[:, 0], task.width[:, 2])
    assert torch.equal(seen.of_each(torch.full((6,), 3)).length[:, 0], task.length[:, 3])


@pytest.mark.parametrize("population", ["styles", "mixed"])
def test_numbers_and_tensors_give_the_same_drives(population: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is computed with one number for all is the same, computed with a number for each."""
    options = ["planner=reversing", f"population={population}", "policy=cnn_inf", "scenario.n_social=2"]
    config = compose_config(options)
    task = build_game(config).cast.assign(draw_tasks(config, 12))
    ends = []
    for is_one in (True, False):
        monkeypatch.setattr(Sizes, "is_one", property(lambda self, one=is_one: one))
        game = build_game(config)
        world = game.simulator.reset(task)
        for _ in range(24):
            world = game.drive(world, game.choose(world, torch.full((12,), 6.0))).world
        ends.append((world.vehicles.position, world.has_collided, game.see(world)))
    assert torch.equal(ends[0][1], ends[1][1])
    torch.testing.assert_close(ends[0][0], ends[1][0], atol=1e-3, rtol=0)
    assert float((ends[0][2] != ends[1][2]).float().mean()) < 1e-4


def test_a_batch_is_its_single_worlds() -> None:
    config, game = built(*FOUR, "planner=reversing", "population=mixed", "policy=cnn_inf")
    task = game.cast.assign(draw_tasks(config, 6))
    together = run(game, task, 24)
    for index in (0, 5):
        alone = run(game, map_tensors(lambda field, i=index: field[i : i + 1], task), 24)
        torch.testing.assert_close(alone, together[index : index + 1], atol=1e-3, rtol=0)


def test_mirrored_tasks_are_mirrored_drives() -> None:
    """Ego and oncoming vehicle with their sizes exchanged drive the same, turned around."""
    config, game = built("scenario/kind=[bus,cyclist]", "scenario.kinds.cyclist.desired_speed_mps=null")
    task = draw_tasks(config, 16)
    turned = replace(
        task,
        start_distance=task.start_distance.flip(1),
        length=task.length.flip(1),
        width=task.width.flip(1),
    )
    horizon = torch.tensor([[2.0, 6.0]]).repeat(16, 1)
    one = drive(game, game.simulator.reset(task), horizon, 40)[-1]
    other = drive(game, game.simulator.reset(turned), horizon.flip(1), 40)[-1]
    apart = (one.vehicles.position + other.vehicles.position.flip(1)).abs().amax((1, 2))
    assert int((apart > 2e-2).sum()) <= 1  # equal costs may be decided otherwise by rounding
    assert torch.equal(one.has_collided, other.has_collided.flip(1))


def run(game: Game, task: Task, n_steps: int) -> torch.Tensor:
    """[E, V, 2] m: where the vehicles are after a while; the ego's horizon changes."""
    world = game.simulator.reset(task)
    for step in range(n_steps):
        world = game.drive(world, game.choose(world, torch.full((len(task),), 2.0 * (step // 10)))).world
    return world.vehicles.position
