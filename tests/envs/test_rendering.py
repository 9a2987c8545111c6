"""Pictures of the environments are the films' drawing of the present state, as arrays and in a window."""

import copy
import pickle
import sys
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo

from negopipe.envs.gymnasium import NarrowLaneEnv, NarrowLaneVectorEnv
from negopipe.envs.rendering import HEIGHT_PX
from negopipe.errors import UserError
from negopipe.report.street_view import WIDTH_PX

SHORT = ("scenario.episode_steps=6",)
SHAPE = (HEIGHT_PX, WIDTH_PX, 3)


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A display on which windows can be opened."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    before = matplotlib.get_backend()
    matplotlib.use("module://fake_window")
    yield sys.modules["fake_window"].FigureCanvas
    matplotlib.use(before)


@pytest.fixture(scope="module")
def env() -> NarrowLaneEnv:
    return NarrowLaneEnv(SHORT, "rgb_array")


def test_pictures_follow_the_drive_to_its_end(env: NarrowLaneEnv) -> None:
    env.reset(seed=1)
    pictures = [env.render()]
    is_over = False
    while not is_over:
        _, _, terminated, truncated, _ = env.step(3)  # type: ignore[arg-type]
        is_over = terminated or truncated
        pictures.append(env.render())
    assert all(picture is not None and picture.shape == SHAPE and picture.dtype == np.uint8 for picture in pictures)
    assert all(not np.array_equal(*pair) for pair in pairwise(pictures))
    assert len(pictures) == 7  # the last one shows the end, not the start of the next episode
    env.reset()
    assert not np.array_equal(env.render(), pictures[-1])
    env.reset(seed=1)
    assert np.array_equal(env.render(), pictures[0])


def test_pictures_per_second_are_the_control_steps(env: NarrowLaneEnv) -> None:
    assert env.metadata["render_fps"] == 5
    assert NarrowLaneVectorEnv(1, SHORT).metadata["render_fps"] == 5


def test_nothing_is_drawn_without_a_mode() -> None:
    env, envs = NarrowLaneEnv(SHORT), NarrowLaneVectorEnv(2, SHORT)
    for each in (env, envs):
        each.reset(seed=1)  # type: ignore[attr-defined]
        assert each.render() is None  # type: ignore[attr-defined]


def test_every_world_has_its_picture(env: NarrowLaneEnv) -> None:
    envs = NarrowLaneVectorEnv(2, SHORT, "rgb_array")
    envs.reset(seed=1)
    pictures = envs.render()
    assert pictures is not None
    assert [picture.shape for picture in pictures] == [SHAPE] * 2
    for world in range(2):
        env.reset(seed=1 + world)
        assert np.array_equal(env.render(), pictures[world])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_go_on_drawing(env: NarrowLaneEnv, duplicate: Any) -> None:
    env.reset(seed=1)
    env.render()
    other = duplicate(env)
    for each in (env, other):
        each.step(0)
    assert np.array_equal(env.render(), other.render())


@pytest.mark.slow
def test_streets_of_many_shapes_have_pictures_of_one_shape() -> None:
    env = NarrowLaneEnv((), "rgb_array", ("+experiment=streets", "evaluation.settings=[mixture]"))
    pictures = []
    for street in (1, 2):
        env.reset(seed=1, options={"task": {"street": street}})
        pictures.append(env.render())
    assert all(picture is not None and picture.shape == SHAPE for picture in pictures)
    assert not np.array_equal(*pictures)


def test_a_window_shows_every_state(window: Any) -> None:
    env = NarrowLaneEnv((*SHORT, "scenario.dt_s=0.2"), "human")
    window.n_drawn = 0
    env.reset(seed=1)
    env.step(0)  # type: ignore[arg-type]
    assert env.render() is None
    assert window.n_drawn == 2
    copied = copy.deepcopy(env)
    copied.step(0)
    assert window.n_drawn == 3
    copied.close()
    env.close()
    env.close()


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("matplotlib.pyplot.get_backend", lambda: "agg")
    with pytest.raises(UserError, match=r"^render_mode must be rgb_array or None without a display, got 'human' .agg"):
        NarrowLaneEnv(SHORT, "human")


def test_other_modes_are_refused() -> None:
    with pytest.raises(UserError, match=r"^render_mode must be one of human, rgb_array or None, got 'ansi'$"):
        NarrowLaneEnv(SHORT, "ansi")
    for mode in ("human", "ansi"):
        with pytest.raises(UserError, match=f"^render_mode must be rgb_array or None, got '{mode}'$"):
            NarrowLaneVectorEnv(1, SHORT, mode)


OBJECTS = pytest.param(("observation=objects", "policy=objects"), marks=pytest.mark.slow)


@pytest.mark.parametrize("kinds", [(), OBJECTS], ids=["grids", "objects"])
def test_the_checker_finds_nothing(window: Any, kinds: tuple[str, ...]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(
            "negopipe/NarrowLane-v0", disable_env_checker=True, render_mode="rgb_array", overrides=kinds
        )
        check_env(env.unwrapped)


def test_videos_are_recorded_where_moviepy_is(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env = RecordVideo(gymnasium.make("negopipe/NarrowLane-v0", render_mode="rgb_array", overrides=SHORT), str(tmp_path))
    env.reset(seed=1)
    for _ in range(6):
        env.step(0)
    env.close()
    assert list(tmp_path.glob("*.mp4"))
