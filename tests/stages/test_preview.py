"""The preview stage: a film of the shortest and the longest horizon, before there is a policy."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from games import tiny_config
from PIL import Image, ImageSequence
from tracked import RecordedRun

from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import build_game
from negopipe.report import animation
from negopipe.runtime.identity import stage_key
from negopipe.simulation.state import EGO
from negopipe.stages import preview


def test_it_films_the_first_task_with_both_ends_of_the_horizons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Any] = []
    animate = animation.animate
    monkeypatch.setattr(animation, "animate", lambda *given: shown.append(given) or animate(*given))
    config, tracked = tiny_config("yield"), RecordedRun(tmp_path)
    preview.run(config, tracked)  # type: ignore[arg-type]
    (pushed, waited), episode, *_ = shown[0]
    assert (pushed.planner, waited.planner, pushed.setting, episode) == ("fixed_0", "fixed_6", "yield", 0)
    for trace, horizon_s in ((pushed, 0.0), (waited, 6.0)):
        assert trace.horizon_s.shape[1] == 1
        assert (trace.horizon_s[: trace.n_steps[0], 0, EGO] == horizon_s).all()
    starts_m = held_out_tasks(config, build_game(config), "yield").start_distance[:1]
    for trace in (pushed, waited):
        np.testing.assert_array_equal(trace.start_distance_m, starts_m)
    film = Image.open(BytesIO((tmp_path / preview.PREVIEW_NAME).read_bytes()))
    assert len(list(ImageSequence.Iterator(film))) > 10
    assert tracked.artifacts == [("preview.gif", "")]


def test_it_depends_on_the_setting_that_it_shows() -> None:
    key, other = (
        stage_key(tiny_config("yield", f"evaluation.leading_setting={name}"), "preview") for name in ("yield", "push")
    )
    assert key != other
