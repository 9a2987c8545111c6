"""The streets stage: maps of the streets that a scenario draws, as they are driven on."""

from pathlib import Path

import numpy as np
import pytest
from games import tiny_config
from matplotlib.figure import Figure
from tracked import RecordedRun

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.report.scene import scene_of
from negopipe.report.street_figures import street_maps
from negopipe.simulation.build_road import build_road
from negopipe.stages import streets

FEW = ("scenario.streets.n_training=3", "scenario.streets.n_held_out=5", "report.figure_formats=[png]")


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return tiny_config("streets", *FEW, "report.n_streets=4")


@pytest.fixture(scope="module")
def game(config: RunConfig) -> Game:
    return build_game(config)


@pytest.fixture(scope="module")
def figures(config: RunConfig, game: Game) -> dict[str, Figure]:
    return street_maps(config.scenario, game.simulator.road, config.report.n_streets)


def titles(figure: Figure) -> list[str]:
    return [title for axis in figure.axes if (title := axis.get_title("left"))]


def test_as_many_streets_are_shown_as_asked_for(figures: dict[str, Figure], game: Game) -> None:
    assert list(figures) == ["streets_training", "streets_held_out"]
    training, held_out = map(titles, figures.values())
    assert [title.partition(":")[0] for title in training] == ["street 1", "street 2", "street 3"]
    assert [title.partition(":")[0] for title in held_out] == [f"street {n}" for n in (4, 5, 6, 7)]
    length_m = float(game.simulator.road.corridor_m(game.simulator.road.ways[0]))
    assert training[0] == f"street 1: corridor {length_m:.1f} m"


def test_a_single_street_is_one_figure() -> None:
    scenario = tiny_config("streets", "scenario=narrow_lane", "curriculum=none").scenario
    figures = street_maps(scenario, build_road(scenario), 3)
    assert list(figures) == ["streets"]
    assert titles(figures["streets"]) == ["street 1: corridor 12.0 m"]


def test_waiting_places_lie_on_the_routes_before_the_corridor(figures: dict[str, Figure], game: Game) -> None:
    axis, road = figures["streets_training"].axes[0], game.simulator.road
    (places,) = [line for line in axis.lines if line.get_marker() == "o"]
    x, y = np.asarray(places.get_xdata()), np.asarray(places.get_ydata())
    assert len(x) == 2  # one of each way
    scene = scene_of(road, 1, 0.0)
    half_m = float(road.corridor_m(road.ways[0])) / 2
    assert x[0] < -half_m * 0.9 < half_m * 0.9 < x[1]  # the ego comes from the left
    near = np.hypot(*(scene.line_m[:, 1:3, None] - np.stack([x, y])).transpose(1, 0, 2)).min(0)
    assert (near < 4.0).all()


def test_the_maps_are_written_and_logged(config: RunConfig, tmp_path: Path) -> None:
    run = RecordedRun(tmp_path)
    streets.run(config, run)  # type: ignore[arg-type]
    names = ["streets_held_out.png", "streets_training.png"]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == names
    assert (tmp_path / "figures" / names[0]).read_bytes().startswith(b"\x89PNG")
