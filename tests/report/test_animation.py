"""Animations run in real time, show the chosen episodes, and draw what the planner foresees to scale."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from measured import FIXED_S
from PIL import Image

from negopipe.evaluation.replay import PolicyTrace
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.report.animation import HOLD_S, _Film, animate, choose_episodes, still, worst_episode
from negopipe.report.scene import Scene
from negopipe.report.style import ADAPTIVE_COLOR, horizon_color


def ranked(trace: Trace, returns: list[float], outcomes: list[str]) -> Trace:
    """The trace with these returns and outcomes."""
    n = len(returns)
    reward = np.zeros((len(trace.reward), n), dtype=np.float32)
    reward[0] = returns
    return replace(trace, reward=reward, outcome=np.array([OUTCOMES.index(name) for name in outcomes]))


def test_the_median_success_is_chosen(traces: list[Trace]) -> None:
    outcomes = ["success", "collision", "success", "success", "success", "success"]
    trace = ranked(traces[0], [5.0, 99.0, 1.0, 2.0, 3.0, 4.0], outcomes)
    assert choose_episodes(trace, 1) == [4]  # returns 1 2 3 4 5 -> 3
    assert choose_episodes(trace, 4) == [3, 4, 5, 0]
    assert choose_episodes(trace, 9) == [2, 3, 4, 5, 0]  # there are only five
    assert choose_episodes(trace, 0) == []


def test_without_a_success_all_episodes_are_ranked(traces: list[Trace]) -> None:
    trace = ranked(traces[0], [-3.0, -1.0, -2.0], ["collision", "deadlock", "timeout"])
    assert choose_episodes(trace, 1) == [2]


def test_the_worst_has_the_lowest_return(traces: list[Trace]) -> None:
    assert worst_episode(ranked(traces[0], [-3.0, -9.0, -9.0], ["success"] * 3)) == 1


@pytest.mark.parametrize("fps", [1, 3])
def test_a_gif_runs_in_real_time(traces: list[Trace], scene: Scene, fps: int) -> None:
    gif = Image.open(BytesIO(animate(traces[:1], 0, scene, fps, FIXED_S)))
    total_ms = 0
    for frame in range(gif.n_frames):
        gif.seek(frame)
        total_ms += gif.info["duration"]
    duration_s = traces[0].n_steps[0] * traces[0].dt_s
    assert total_ms / 1000 - HOLD_S == pytest.approx(duration_s, abs=1 / fps)
    assert gif.info["loop"] == 0


def test_a_gif_is_small_and_the_same_each_time(traces: list[Trace], scene: Scene) -> None:
    assert len(animate([traces[0], traces[2], traces[4]], 0, scene, 10, FIXED_S)) < 1_500_000
    assert animate(traces[:1], 0, scene, 1, FIXED_S) == animate(traces[:1], 0, scene, 1, FIXED_S)


def test_side_by_side_has_one_panel_per_planner(traces: list[Trace], scene: Scene) -> None:
    one, three = (Image.open(BytesIO(still(shown, 0, scene, 1.0, FIXED_S))) for shown in (traces[:1], traces[:3]))
    assert one.width == three.width
    assert three.height > 2.5 * one.height


def test_vehicles_are_drawn_in_their_colours(traces: list[Trace], scene: Scene) -> None:
    image = np.asarray(Image.open(BytesIO(still(traces[:1], 0, scene, 0.0, FIXED_S))))
    ego = (image == [int(ADAPTIVE_COLOR[i : i + 2], 16) for i in (1, 3, 5)]).all(-1)
    pixel_m = 2 * (np.abs(traces[0].position_m[0, 0, :, 0]).max() + 4) / image.shape[1]
    # the windscreen takes 16 % of the length and 80 % of the width
    area_m2 = float(traces[0].length_m[0, 0] * traces[0].width_m[0, 0]) * (1 - 0.16 * 0.8)
    assert ego.sum() * pixel_m**2 == pytest.approx(area_m2, rel=0.15)
    assert np.flatnonzero(ego.any(0)).mean() < image.shape[1] / 2  # it comes from the left


@pytest.mark.parametrize("horizon_s", [0.0, 2.0, 6.0])
def test_the_ribbon_is_as_long_as_the_prediction(traces: list[Trace], scene: Scene, horizon_s: float) -> None:
    trace = replace(traces[0], horizon_s=np.full_like(traces[0].horizon_s, horizon_s))
    panel = _Film([trace], 0, scene, FIXED_S).panels[0]
    panel.artists_at(1.0)
    outline = panel.view.ribbons[0].get_xy()
    assert np.ptp(outline[:, 0]) == pytest.approx(horizon_s * trace.speed_mps[5, 0, 1], abs=1e-4)
    if horizon_s:
        assert outline[:, 0].min() < trace.position_m[5, 0, 1, 0] - 1  # ahead of a vehicle that comes towards us
        half = outline[outline[:, 0].argmin(), 1]
        assert abs(half) <= 1.75 + trace.width_m[0, 1] / 2  # on its route
    assert panel.view.ribbons[0].get_facecolor()[:3] == pytest.approx(
        [int(horizon_color(horizon_s)[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    )


def test_between_decisions_vehicles_move_on_evenly(traces: list[Trace], scene: Scene) -> None:
    panel = _Film(traces[:1], 0, scene, FIXED_S).panels[0]
    centers = []
    for time_s in (0.4, 0.5, 0.6):
        panel.artists_at(time_s)
        centers.append(panel.view.bodies[0].get_xy()[:4].mean(0))
    np.testing.assert_allclose(centers[1], (centers[0] + centers[2]) / 2, atol=1e-6)
    np.testing.assert_allclose(centers[2], traces[0].position_m[3, 0, 0], atol=1e-5)


def test_the_end_is_told_and_stays(traces: list[Trace], scene: Scene) -> None:
    crashed = next(trace for trace in traces if OUTCOMES[trace.outcome[0]] == "collision")
    panel = _Film([crashed], 0, scene, FIXED_S).panels[0]
    panel.artists_at(0.0)
    assert not panel.view.crash.get_visible()
    panel.artists_at(1e3)
    assert panel.view.crash.get_visible()
    assert panel.view.status.get_text() == f"collision after {crashed.n_steps[0] * crashed.dt_s:.1f} s"


def test_the_grids_and_probabilities_of_the_policy_are_drawn(traces: list[Trace], scene: Scene) -> None:
    n_steps = int(traces[0].n_steps[0])
    grids = np.zeros((n_steps, 4, 84, 84), dtype=np.uint8)
    grids[5, 0, 0, 0] = 1  # farthest ahead, farthest to the left
    probability = np.tile(np.float32([0.1, 0.2, 0.3, 0.4]), (n_steps, 1))
    probability[5] = (0.7, 0.1, 0.1, 0.1)
    policy_trace = PolicyTrace(grids, probability, (0.0, 2.0, 4.0, 6.0), 1.0)
    film = _Film(traces[:1], 0, scene, FIXED_S, policy_trace)
    (row,) = film.policy_rows
    row.artists_at(5 * traces[0].dt_s)
    assert [bar.get_width() for bar in row.bars] == pytest.approx([0.7, 0.1, 0.1, 0.1])
    assert row.shares[0].get_text() == "70 %"
    shown = np.asarray(row.images[0].get_array())
    assert np.argwhere(shown).tolist() == [[0, 83]]  # ahead is to the right, left is up
    row.artists_at(1e3)
    assert row.bars[3].get_width() == pytest.approx(0.4)  # of the last decision
    assert film.draw(0.0).height > _Film(traces[:1], 0, scene, FIXED_S).draw(0.0).height


def test_without_grids_the_probabilities_are_drawn(traces: list[Trace], scene: Scene) -> None:
    probability = np.tile(np.float32([0.1, 0.2, 0.3, 0.4]), (int(traces[0].n_steps[0]), 1))
    film = _Film(traces[:1], 0, scene, FIXED_S, PolicyTrace(None, probability, (0.0, 2.0, 4.0, 6.0), 1.0))
    (row,) = film.policy_rows
    row.artists_at(0.0)
    assert row.images == []
    assert [bar.get_width() for bar in row.bars] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert film.draw(0.0).height > _Film(traces[:1], 0, scene, FIXED_S).draw(0.0).height


def test_an_intervention_of_the_safety_layer_is_told(traces: list[Trace], scene: Scene) -> None:
    intervention = np.zeros_like(traces[0].intervention)
    intervention[2] = 2
    film = _Film([replace(traces[0], intervention=intervention)], 0, scene, FIXED_S, None)
    texts = []
    for step in (1, 2, 3):
        film.draw((step + 0.5) * traces[0].dt_s)
        texts.append(film.panels[0].view.horizon.get_text())
    assert texts[1] == "safety: planned stop"
    assert "safety" not in texts[0] + texts[2]
