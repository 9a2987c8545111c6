"""Traces survive the disk, and a wrong file says so in one line."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from negopipe.errors import UserError
from negopipe.evaluation.trace import Trace, load_traces, save_traces


def make_trace(planner: str, seed: int) -> Trace:
    """Random contents, the right shapes: T = 5, E = 3, V = 2."""
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return Trace(
        planner=planner,
        setting="push",
        dt_s=0.2,
        street=np.ones(3, dtype=np.int64),
        corridor_m=floats(3),
        start_distance_m=floats(3, 2),
        style_horizon_s=np.array([[np.nan, 2.0]] * 3, dtype=np.float32),
        length_m=np.full((3, 2), 4.5, dtype=np.float32),
        width_m=np.full((3, 2), 1.8, dtype=np.float32),
        driver=np.array([["", "planner"]] * 3),
        position_m=floats(6, 3, 2, 2),
        yaw_rad=floats(6, 3, 2),
        speed_mps=floats(6, 3, 2),
        progress_m=floats(6, 3, 2),
        horizon_s=floats(5, 3, 2),
        is_full_braking=rng.random((5, 3, 2)) < 0.5,
        intervention=rng.integers(0, 4, (5, 3), dtype=np.int8),
        reward=floats(5, 3),
        n_steps=rng.integers(1, 6, 3),
        reached_step=rng.integers(-1, 6, (3, 2)),
        outcome=rng.integers(0, 4, 3),
    )


def test_traces_are_the_same_after_a_round_trip(tmp_path: Path) -> None:
    traces = [make_trace("adaptive", 0), make_trace("fixed_2", 1)]
    save_traces(tmp_path / "traces.npz", traces)
    loaded = load_traces(tmp_path / "traces.npz")
    assert [trace.planner for trace in loaded] == ["adaptive", "fixed_2"]
    for trace, original in zip(loaded, traces, strict=True):
        for field in fields(Trace):
            value, expected = getattr(trace, field.name), getattr(original, field.name)
            np.testing.assert_array_equal(value, expected)
            assert type(value) is type(expected)
            assert getattr(value, "dtype", None) == getattr(expected, "dtype", None)


def test_a_missing_file_names_the_stage_that_writes_it(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"traces\.npz: no such file; the stage `evaluate`"):
        load_traces(tmp_path / "traces.npz")


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    text, foreign, array = tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "c.npz"
    text.write_text("not an archive")
    np.savez(foreign, x=np.zeros(3))
    with array.open("wb") as file:
        np.save(file, np.zeros(3))
    for path in (text, foreign, array):
        with pytest.raises(UserError, match="not a file of traces"):
            load_traces(path)


def test_a_file_of_another_format_names_the_stage_that_writes_it_anew(tmp_path: Path) -> None:
    with (tmp_path / "traces.npz").open("wb") as file:
        np.savez(file, format=np.array("negopipe traces 1"), n_traces=np.array(0))
    with pytest.raises(UserError, match="format 'negopipe traces 5'; run the stage `evaluate` anew"):
        load_traces(tmp_path / "traces.npz")
