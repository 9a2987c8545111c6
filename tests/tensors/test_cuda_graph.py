import pytest
import torch
from composed import compose_config
from games import draw_tasks

from negopipe.game.game import build_game
from negopipe.tensors.cuda_graph import GraphedFunction
from negopipe.tensors.tree import map_tensors, tensors

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


def test_a_graph_gives_what_the_function_gives_for_every_number_of_rows() -> None:
    graphed = GraphedFunction(lambda x: (2 * x + 1, x.sum(1, keepdim=True)))
    for n_rows in (3, 7, 3):
        given = torch.randn(n_rows, 4, device="cuda")
        first, second = graphed(given)
        graphed(torch.zeros_like(given))  # leaves the results of before as they are
        assert torch.equal(first, 2 * given + 1)
        assert torch.equal(second, given.sum(1, keepdim=True))


@pytest.mark.parametrize("overrides", [[], ["+experiment=generalist", "scenario.streets.n_training=4"]])
def test_a_recorded_game_is_the_same_as_the_eager_one(overrides: list[str]) -> None:
    config = compose_config(overrides)
    eager, recorded = (build_game(config, "cuda", is_compiled) for is_compiled in (False, True))
    on_cpu = build_game(config).simulator.reset(draw_tasks(config, 40))
    world = map_tensors(lambda field: field.cuda(), on_cpu)
    horizon = torch.full((40, config.scenario.n_vehicles), 4.0, device="cuda")
    for _ in range(10):
        expected, found = eager.drive(world, horizon), recorded.drive(world, horizon)
        for a, b in zip(tensors(expected[0]), tensors(found[0]), strict=True):
            assert torch.equal(torch.nan_to_num(a.float()), torch.nan_to_num(b.float()))
        world = expected[0]
