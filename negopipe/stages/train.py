"""The train stage: Algorithm 1 of the paper."""

import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import torch

from negopipe.env import NegotiationEnv
from negopipe.learning.acktr import Acktr
from negopipe.learning.rollout import Rollout, RunningEpisodes, collect
from negopipe.policy.actor_critic import ActorCritic
from negopipe.seeding import generator
from negopipe.simulation.scenario import TaskSampler
from negopipe.stages.progress import ProgressLine
from negopipe.stages.setup import build, device_of, load_policy, save_policy
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, find_checkpoint

if TYPE_CHECKING:
    from negopipe.config import RunConfig
    from negopipe.tracking.store import TrackedRun

HISTORY_NAME = "history.csv"
N_RECENT_EPISODES = 200
"""Episodes that the success rate and mean return of the learning curves are taken over."""


def run(config: "RunConfig", run: "TrackedRun") -> None:
    """Train a policy; writes checkpoint.safetensors, history.csv and the `train` part of metrics.json."""
    device, algorithm = device_of(config), config.algorithm
    game, policy = build(config)
    if config.checkpoint is not None:
        load_policy(find_checkpoint(config.checkpoint, config), policy, config)
    learner = Acktr(policy, algorithm, generator(config.seed, "updates", device))
    tasks, actions = (generator(config.seed, purpose, device) for purpose in ("training tasks", "actions"))
    stages = config.curriculum.stages
    first = TaskSampler(config.scenario, stages[0].families, tasks)
    env = NegotiationEnv(game, config.reward, config.policy.horizons_s, first, algorithm.n_worlds)
    running = RunningEpisodes.start(algorithm.n_worlds, device)
    n_total = sum(stage.n_iterations for stage in stages)
    curve = LearningCurve(algorithm.n_worlds * algorithm.n_steps)
    with ProgressLine("train", n_total) as progress:
        for stage in stages:  # (K, D) of Algorithm 1
            env.sampler = TaskSampler(config.scenario, stage.families, tasks)  # T ~ D, a new one per episode
            for _ in range(stage.n_iterations):
                rollout, running = collect(env, policy, algorithm.n_steps, actions, running)
                metrics = learner.update(rollout, len(curve) / n_total)
                row = curve.add(stage.name, rollout, metrics)
                run.log_metrics(curve.scalars(row), step=row["decisions"])
                progress.advance(curve.text(row))
            _save(config, run, policy, curve)
    run.update_metrics_json({"train": curve.summary()})


class LearningCurve:
    """The training's history: a row per iteration, over the latest episodes."""

    def __init__(self, n_decisions_per_iteration: int) -> None:
        self.rows: list[dict] = []
        self._n_per_iteration = n_decisions_per_iteration
        self._recent: deque[tuple[float, bool, bool]] = deque(maxlen=N_RECENT_EPISODES)
        self._started_s = self._last_s = time.monotonic()

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, stage: str, rollout: Rollout, metrics: dict[str, float]) -> dict:
        """Append an iteration; returns its row. Means over episodes are NaN until one has ended."""
        is_done = rollout.is_terminated | rollout.is_truncated
        ended = (rollout.episode_return, rollout.is_success, rollout.is_collision)
        self._recent.extend(zip(*(field[is_done].tolist() for field in ended), strict=True))
        returns, successes, collisions = torch.tensor(list(self._recent)).reshape(-1, 3).mean(0).tolist()
        now_s = time.monotonic()
        row = {
            "decisions": (len(self.rows) + 1) * self._n_per_iteration,
            "stage": stage,
            "success_rate": successes,
            "collision_rate": collisions,
            "return_mean": returns,
            **metrics,
            "decisions_per_s": self._n_per_iteration / (now_s - self._last_s),
            "wall_s": now_s - self._started_s,
        }
        self._last_s = now_s
        self.rows.append(row)
        return row

    def scalars(self, row: dict) -> dict[str, float]:
        """The row's numbers under their names in the dashboard."""
        return {f"train/{k}": v for k, v in row.items() if isinstance(v, float) and v == v}

    def text(self, row: dict) -> str:
        """How it goes, for the progress line."""
        went = "no episode over yet"
        if self._recent:
            went = f"success {row['success_rate']:4.0%} return {row['return_mean']:5.1f}"
        return f"{row['stage']} {went} {row['decisions_per_s']:5.0f} decisions/s"

    def summary(self) -> dict[str, float]:
        """The `train` part of metrics.json."""
        decisions, wall_s = self.rows[-1]["decisions"], time.monotonic() - self._started_s
        return {"decisions": decisions, "wall_s": wall_s, "decisions_per_s": decisions / wall_s}

    def write(self, path: Path) -> None:
        pd.DataFrame(self.rows).to_csv(path, index=False)


def _save(config: "RunConfig", run: "TrackedRun", policy: ActorCritic, curve: LearningCurve) -> None:
    """Keep what a finished stage has reached."""
    row = curve.rows[-1]
    curve.write(run.folder / HISTORY_NAME)
    run.log_artifact(run.folder / HISTORY_NAME)
    save_policy(run.folder / CHECKPOINT_NAME, policy, config, row["decisions"])
    run.log_checkpoint(run.folder / CHECKPOINT_NAME, row["decisions"], curve.scalars(row))
