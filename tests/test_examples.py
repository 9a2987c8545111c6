"""The programs of examples/ run at a small size, and each fits on a page."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_maps import commonroad_map, written
from PIL import Image

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
N_LINES = 60


def main_of(name: str) -> Any:
    """The function `main` of an example."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_fits_on_a_page_and_says_what_it_shows(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= N_LINES
    assert text.startswith('"""')
    assert f"python examples/{path.name}" in text


@pytest.mark.parametrize("kind", ["grids", "objects"])
def test_stable_baselines3_trains_on_both_observations(kind: str) -> None:
    pytest.importorskip("stable_baselines3")
    assert 0 <= main_of("sb3_ppo")(kind, 32, n_worlds=2, n_steps=16) <= 1


def test_ppo_on_one_page_trains() -> None:
    assert len(main_of("single_file_ppo")(64, n_worlds=2, n_steps=16)) == 2


def test_an_own_driver_is_evaluated_in_a_case_of_unseen() -> None:
    rates = main_of("own_driver")("driver_idm", 3)
    assert rates.keys() == {"own", "fixed_6"}
    assert all(0 <= rate <= 1 for rate in rates.values())


def test_a_model_of_others_is_evaluated() -> None:
    measured = main_of("other_model")(lambda seen: np.full(len(seen), 3), 3)
    assert measured.keys() == {"push", "yield"}
    assert measured["push"]["n_episodes"] == 3


def test_an_own_street_is_filmed(tmp_path: Path) -> None:
    street, film = written(commonroad_map(200.0), tmp_path / "drawn.xml"), tmp_path / "film.gif"
    row = "scenario.map.rows=[{side:left,from_m:90.0,to_m:110.0,kerb_gap_m:0.2}]"
    assert main_of("own_street")(str(street), str(film), (row, "scenario.episode_steps=5")) == "timeout"
    with Image.open(film) as read:
        assert read.n_frames == 6  # type: ignore[attr-defined]


def test_the_planner_alone_draws_its_plans(tmp_path: Path) -> None:
    reached = main_of("planner")(str(tmp_path / "plans.png"))
    assert reached[0] > 10  # pushes through the corridor
    assert reached[3] < -6  # waits before it
    with Image.open(tmp_path / "plans.png") as read:
        assert read.format == "PNG"


def test_one_policy_plays_both_sides() -> None:
    pytest.importorskip("stable_baselines3")
    rows = list(main_of("self_play")(128, n_agents=4, n_steps=6, overrides=("scenario.episode_steps=12",)))
    assert [(tasks, decisions, episodes) for tasks, decisions, _, episodes, _ in rows] == [
        ("held", 0, 4), ("training", 96, 8), ("training", 192, 8), ("held", 192, 4),
    ]  # fmt: skip
    assert all(0 <= share <= 1 for *_, share in rows)


def test_torchrl_trains() -> None:
    pytest.importorskip("torchrl")
    shares = list(main_of("torchrl_ppo")(64, n_worlds=2, n_steps=16, overrides=("scenario.episode_steps=12",)))
    assert len(shares) == 2
    assert all(0 <= share <= 1 for share in shares)
