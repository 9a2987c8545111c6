"""A made-up evaluation: plausible negotiations by simple kinematics; no simulator is needed."""

import numpy as np
import pandas as pd
import pytest

from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.trace import Trace
from negopipe.report.scene import Scene

DT_S = 0.2
N_STEPS = 128
CORRIDOR_M = 12.0
TARGET_M = 24.0
PLANNERS = ("adaptive", "fixed_0", "fixed_2", "fixed_4", "fixed_6")
SOCIAL_START_M = {"yield": (11.99, 14.02), "push": (16.33, 18.80)}
STYLE_S = {"yield": 2.0, "push": 6.0}


def make_scene() -> Scene:
    """Three parked cars on each side of a 12 m corridor."""
    cars = [(x, side * 2.55, 0.0, 3.6, 1.9) for side in (-1, 1) for x in (-4.2, 0.0, 4.2)]
    sigma = np.linspace(-46.0, 46.0, 185)
    straight = np.zeros_like(sigma)
    kerb = np.full_like(sigma, 3.5)
    keep_right = _offset(sigma + CORRIDOR_M / 2)
    return Scene(
        parked_cars=np.array(cars),
        line_m=np.stack([sigma, sigma, straight, straight], -1),
        kerbs_m=np.stack([np.stack([sigma, side * kerb], -1) for side in (-1, 1)]),
        corridors_m=[np.array([[(x, side * 3.5) for x in (-6.0, 6.0)] for side in (-1, 1)])],
        route_d_m=np.stack([keep_right, -keep_right]),
        plan_s=6.0,
    )


def ego_waits(planner: str, family: str) -> bool:
    return planner == "fixed_6" or (planner == "adaptive" and family == "yield")


def make_trace(planner: str, family: str, n_episodes: int, seed: int) -> Trace:
    """Each vehicle either drives on or waits before the corridor until the other one is through."""
    rng = np.random.default_rng(seed)
    low, high = SOCIAL_START_M[family]
    start = np.stack([np.full(n_episodes, 13.35), rng.uniform(low, high, n_episodes)], -1)
    waits = np.array([ego_waits(planner, family), STYLE_S[family] > 4])
    s, v = np.empty((2, N_STEPS + 1, n_episodes, 2))
    s[0], v[0] = -start, 4.0
    for t in range(N_STEPS):
        is_blocked = waits & (s[t][:, ::-1] < CORRIDOR_M + 8) & (s[t] < -8)
        gap = CORRIDOR_M - s[t].sum(-1, keepdims=True)
        is_near = (gap < 9) & (gap > -1) if planner == "fixed_4" else np.zeros_like(gap, dtype=bool)
        room = np.where(is_near, 0.0, np.where(is_blocked, np.maximum(-9 - s[t], 0), 1e3))
        wanted = np.minimum(5.0 + 0.1 * rng.normal(size=room.shape), np.sqrt(2 * 1.5 * room))
        v[t + 1] = np.maximum(v[t] + np.clip(wanted - v[t], -5 * DT_S, 2 * DT_S), 0)
        s[t + 1] = s[t] + v[t + 1] * DT_S
    return _finish(planner, family, start, s, v, rng)


def _finish(
    planner: str, family: str, start: np.ndarray, s: np.ndarray, v: np.ndarray, rng: np.random.Generator
) -> Trace:
    """End every episode where both arrived or touched, repeat the last state, and add what is derived."""
    n_episodes = len(start)
    is_there = s >= TARGET_M
    reached = np.where(is_there.any(0), is_there.argmax(0), -1)
    touches = (np.abs(s.sum(-1) - CORRIDOR_M) < 4.5) & (np.abs(_offset(s).sum(-1)) < 1.6)
    crash = np.where(touches.any(0), touches.argmax(0), N_STEPS + 1)
    done = np.where((reached >= 0).all(-1), reached.max(-1), N_STEPS)
    n_steps = np.minimum(np.minimum(done, crash), N_STEPS)
    at_rest = v[n_steps, np.arange(n_episodes)].max(-1) < 0.1
    outcome = np.select([crash <= done, (reached >= 0).all(-1), at_rest], [1, 0, 2], default=3)
    reached = np.where(reached > n_steps[:, None], -1, reached)
    row = np.minimum(np.arange(N_STEPS + 1)[:, None], n_steps)
    s, v = s[row, np.arange(n_episodes)], v[row, np.arange(n_episodes)]
    is_running = np.arange(N_STEPS)[:, None] < n_steps
    reward = np.where(is_running, -0.25, 0.0)
    reward[n_steps - 1, np.arange(n_episodes)] += np.array([10.0, -5.0, 0.0, 0.0])[outcome]
    horizon = np.empty((N_STEPS, n_episodes, 2))
    horizon[..., 0] = _ego_horizon(planner, family, s[:-1], rng)
    horizon[..., 1] = STYLE_S[family]
    direction = np.array([1.0, -1.0])
    slope = np.gradient(_offset(s), axis=0) / np.maximum(np.gradient(s, axis=0), 0.05)
    return Trace(
        planner=planner,
        setting=family,
        dt_s=DT_S,
        street=np.ones(len(start), dtype=np.int64),
        corridor_m=np.full(len(start), CORRIDOR_M, dtype=np.float32),
        start_distance_m=start.astype(np.float32),
        style_horizon_s=np.tile(np.float32([np.nan, STYLE_S[family]]), (n_episodes, 1)),
        length_m=np.full((n_episodes, 2), 4.5, dtype=np.float32),
        width_m=np.full((n_episodes, 2), 1.8, dtype=np.float32),
        driver=np.tile(np.array(["", "planner"]), (n_episodes, 1)),
        position_m=np.stack([direction * (s - CORRIDOR_M / 2), direction * _offset(s)], -1).astype(np.float32),
        yaw_rad=(np.arctan(slope) + np.array([0, np.pi])).astype(np.float32),
        speed_mps=v.astype(np.float32),
        progress_m=s.astype(np.float32),
        horizon_s=horizon.astype(np.float32),
        is_full_braking=np.zeros(horizon.shape, dtype=bool),
        intervention=np.zeros(horizon.shape[:2], dtype=np.int8),
        reward=reward.astype(np.float32),
        n_steps=n_steps,
        reached_step=reached,
        outcome=outcome,
    )


def _offset(s: np.ndarray) -> np.ndarray:
    """Offset to the own left of a route that keeps right outside the corridor, m."""
    outside = np.clip((np.abs(s - CORRIDOR_M / 2) - CORRIDOR_M / 2 - 2) / 8, 0, 1)
    return -1.75 * outside**2 * (3 - 2 * outside)


def _ego_horizon(planner: str, family: str, s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if planner != "adaptive":
        return np.full(s.shape[:2], float(planner.removeprefix("fixed_")))
    is_waiting = (s[..., 1] < CORRIDOR_M) & (family == "yield")
    wanted = np.where(is_waiting, 6.0, 0.0)
    return np.where(rng.random(wanted.shape) < 0.2, rng.choice([2.0, 4.0], wanted.shape), wanted)


def make_history(n_rows: int = 300, seed: int = 0) -> pd.DataFrame:
    """A made-up learning curve over three stages of the curriculum."""
    rng = np.random.default_rng(seed)
    done = np.linspace(0, 1, n_rows)
    success = np.clip(1 / (1 + np.exp(-9 * (done - 0.3))) + 0.04 * rng.normal(size=n_rows), 0, 1)
    return pd.DataFrame(
        {
            "decisions": (np.arange(n_rows) + 1) * 4096,
            "stage": np.array(["apart", "closer", "full"])[np.minimum((done * 3).astype(int), 2)],
            "success_rate": success,
            "collision_rate": (1 - success) * 0.6,
            "return_mean": -25 + 22 * success + rng.normal(size=n_rows),
            "entropy": 1.386 * (1 - 0.8 * done) + 0.03 * rng.normal(size=n_rows),
            "kl": 0.001 + 0.0004 * rng.random(n_rows),
            "value_loss": 30 * np.exp(-4 * done) + rng.random(n_rows),
            "decisions_per_s": 2500 + 100 * rng.normal(size=n_rows),
        }
    )


def make_training_episodes(n_rows: int = 2000, decisions: int = 40 * 4096, seed: int = 0) -> pd.DataFrame:
    """A made-up training that first learns to wait for those who push."""
    rng = np.random.default_rng(seed)
    done = np.sort(rng.random(n_rows))
    style = rng.choice([2.0, 6.0], n_rows)
    is_success = rng.random(n_rows) < np.where(style == 2, 3 * done, 0.2 + done)
    return pd.DataFrame(
        {
            "decisions": np.ceil(done * decisions).astype(int),
            "return": np.where(is_success, -7.0, -20.0),
            "is_success": is_success.astype(int),
            "is_collision": (~is_success & (rng.random(n_rows) < 0.5)).astype(int),
            "social_start_distance_m": np.where(style == 2, 12.0, 16.4) + 2 * rng.random(n_rows),
            "style_horizon_s": style,
        }
    )


def make_traces(n_episodes: int) -> list[Trace]:
    return [make_trace(planner, family, n_episodes, 7) for family in STYLE_S for planner in PLANNERS]


@pytest.fixture(scope="session")
def traces() -> list[Trace]:
    return make_traces(n_episodes=8)


@pytest.fixture(scope="session")
def table(traces: list[Trace]) -> pd.DataFrame:
    rows = [episodes(Drives(trace, 8.0, 6.0)) for trace in traces]
    return pd.concat(rows, ignore_index=True)


@pytest.fixture(scope="session")
def history() -> pd.DataFrame:
    return make_history(40)


@pytest.fixture(scope="session")
def driven() -> pd.DataFrame:
    return make_training_episodes()


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene()
