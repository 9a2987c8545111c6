"""Parked vehicles and others on the road hide what is behind them: by hand, and by another method."""

from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks, meet, place
from torch import Tensor

from negopipe.game.game import Game, build_game
from negopipe.simulation.geometry import Boxes, box_rows, boxes_from_pose, rim
from negopipe.simulation.occlusion import Occlusion, crosses
from negopipe.simulation.perception import other_columns
from negopipe.simulation.state import EGO, Task, World
from negopipe.tensors.tree import map_tensors

BOX = Boxes(*(torch.tensor(value) for value in (0.0, 0.0, 1.0, 0.0, 2.0, 1.0)))


def line(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    return (torch.tensor(x0), torch.tensor(y0)), (torch.tensor(x1), torch.tensor(y1))


@pytest.mark.parametrize(
    ("ends", "is_hidden"),
    [
        ((-5, 0, 5, 0), True),
        ((-5, 0, -3, 0), False),  # ends before the box
        ((-5, 1.01, 5, 1.01), False),
        ((-5, 0.99, 5, 0.99), True),
        ((0, 0, 0, 0.5), True),  # within
        ((-3, 0, 0, 3), False),  # past a corner
        ((-3, 0.5, 0, 2), False),
        ((-3, 0.4, -1, 1.2), True),
        ((-5, -5, -5, 5), False),
    ],
)
def test_a_line_past_a_box(ends: tuple[float, float, float, float], is_hidden: bool) -> None:
    start, end = line(*ends)
    assert bool(crosses(BOX, start, end)) == is_hidden
    assert bool(crosses(BOX, end, start)) == is_hidden


def test_random_lines_agree_with_the_sides_that_they_cross() -> None:
    random = torch.Generator().manual_seed(0)
    rows = torch.rand(3000, 5, generator=random) * torch.tensor([10.0, 10.0, 6.3, 6.0, 3.0])
    boxes = Boxes(*box_rows(rows).double().unbind(-1))
    ends = torch.rand(3000, 4, generator=random).double() * 14 - 2
    found = crosses(boxes, (ends[:, 0], ends[:, 1]), (ends[:, 2], ends[:, 3])).tolist()
    lines = zip(ends.tolist(), bodies(boxes), strict=True)
    expected = [meets((x0, y0), (x1, y1), body) for (x0, y0, x1, y1), body in lines]
    assert found == expected
    assert 0.1 < sum(found) / len(found) < 0.9


def hidden(*overrides: str) -> Game:
    return build_game(compose_config(["perception.occlusion=true", *overrides]))


def behind_parked(game: Game, y: float) -> World:
    """The ego at x = -20 m beside the left kerb of the default street, the other at x = 20 m, `y` to the left."""
    world = meet(compose_config([]), game, [[-14.0, -14.0]], [[0.0, 0.0]])
    position = torch.tensor([[[-20.0, 2.6], [20.0, y]]])
    return place(world, replace(world.vehicles, position=position, yaw=torch.tensor([[0.0, 3.14159]])))


@pytest.mark.parametrize(("y", "is_seen"), [(2.6, False), (-2.6, True)])
@pytest.mark.parametrize("tracker", [(), ("perception=noisy", "perception.dropout_probability=0.0")])
def test_parked_cars_hide_who_stands_behind_them(y: float, is_seen: bool, tracker: tuple[str, ...]) -> None:
    """The row of parked cars begins at |y| = 1.6 m: along y = 2.6 m nothing is seen past it, across the road all is."""
    for game, expected in ((hidden(*tracker), is_seen), (build_game(compose_config(list(tracker))), True)):
        world = behind_parked(game, y)
        world = replace(world, tracks=game.simulator.sensor.first_tracks(world))
        perception = game.perceive(world)
        assert perception.is_seen.flatten().tolist() == [expected, expected]
        assert perception.is_seen_history.all() == expected
        if not expected:
            assert not perception.other.position.any()


def test_a_vehicle_hides_another_one() -> None:
    config = compose_config(["perception.occlusion=true", "scenario.n_social=2"])
    game = build_game(config)
    world = meet(config, game, [[-14.0, -14.0, -40.0]], [[0.0, 0.0, 0.0]])
    inline = torch.tensor([[[-40.0, 0.0], [-20.0, 0.0], [-10.0, 0.0]]])
    beside = torch.tensor([[[-40.0, 0.0], [-20.0, 0.0], [-10.0, 3.0]]])
    states = (replace(world.vehicles, position=position, yaw=torch.zeros(1, 3)) for position in (inline, beside))
    seen = [game.perceive(place(world, state)) for state in states]
    assert seen[0].is_seen.tolist() == [[[True, False], [True, True], [False, True]]]
    assert seen[1].is_seen.all()
    assert seen[0].of(EGO).is_seen_history[..., 1].any().item() is False


@pytest.mark.parametrize("scenario", ["narrow_lane", "random_streets"])
def test_a_batch_sees_what_single_lines_see(scenario: str) -> None:
    """Random places, also off the road, line by line; batch = single worlds."""
    few = ["scenario.streets.n_training=2", "scenario.streets.n_held_out=16"]
    options = [*few, "curriculum=streets", "scenario.n_social=2", "scenario/kind=[car,van,cyclist]"]
    config = compose_config([f"scenario={scenario}", *options])
    occlusion, others, task = Occlusion(build_game(config).simulator.road), other_columns(3), draw_tasks(config, 40)
    pose = torch.rand(40, 2, 3, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([30.0, 8.0, 6.3])
    pose = pose - torch.tensor([15.0, 4.0, 0.0])
    found = occlusion.is_visible(pose, others, task)
    for i in (0, 7):
        alone = map_tensors(lambda field, at=slice(i, i + 1): field[at], task)
        assert torch.equal(occlusion.is_visible(pose[i : i + 1], others, alone), found[i : i + 1])
    n_wrong = sum(
        is_free(occlusion, pose[e, j], task, e, viewer, other) != bool(found[e, j, viewer, o])
        for e in range(40)
        for j in range(2)
        for viewer in range(3)
        for o, other in enumerate(others[viewer].tolist())
    )
    assert n_wrong <= 1  # float32, and a line along a side
    assert 0.2 < float(found.float().mean()) < 0.95


Point = tuple[float, float]


def is_free(occlusion: Occlusion, pose: Tensor, task: Task, world: int, viewer: int, other: int) -> bool:
    """Whether the viewer sees the other, line by line; pose: [3, 3]."""
    parked = occlusion.road.parked_boxes(task.direction[:, 0])
    still = Boxes(*(field[world] if field.dim() == 2 else field for field in parked))
    hiding = [body for body in bodies(still) if max(abs(x) + abs(y) for x, y in body) < 500]
    x, y, yaw = pose.double().unbind(-1)
    boxes = boxes_from_pose(x, y, yaw, task.length[world].double(), task.width[world].double())
    vehicles = bodies(boxes)
    hiding += [body for index, body in enumerate(vehicles) if index not in (viewer, other)]
    places = list(zip(x.tolist(), y.tolist(), strict=True))
    looked_for = [places[other], *vehicles[other]]
    return any(not any(meets(places[viewer], point, body) for body in hiding) for point in looked_for)


def bodies(boxes: Boxes) -> list[list[Point]]:
    """The corners of each box, in the order of its rim."""
    x, y = (field[torch.tensor([0, 2, 5, 3])].double() for field in rim(boxes))
    return [list(zip(a, b, strict=True)) for a, b in zip(x.T.tolist(), y.T.tolist(), strict=True)]


def meets(start: Point, end: Point, body: list[Point]) -> bool:
    """A line crosses a side of the polygon or begins in it."""

    def left(a: Point, b: Point, c: Point) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    sides = list(zip(body, [*body[1:], body[0]], strict=True))
    turns = {left(a, b, start) > 0 for a, b in sides}
    crossed = (
        left(start, end, a) * left(start, end, b) < 0 and left(a, b, start) * left(a, b, end) < 0 for a, b in sides
    )
    return len(turns) == 1 or any(crossed)
