"""Benchmark of training: its speed, and the cost of tracking it."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from negopipe.config.root import as_mapping
from negopipe.runtime.build import device_of
from negopipe.runtime.network_passes import iteration_passes
from negopipe.tensors.timing import Stopwatch, block_seconds
from negopipe.tracking.run_folder import SNAPSHOTS_NAME
from negopipe.tracking.snapshots import Snapshots
from negopipe.tracking.store import TrackedRun, open_run
from negopipe.training.training import Training, save_stage

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig


def measure_training(config: "RunConfig", place: Path) -> dict[str, float]:
    """Metrics of `benchmark.n_iterations` iterations, after one for compilation, with a run and a store in `place`.

    train.decisions_per_s: speed of the iterations without tracking
    train.iteration_efficiency: share of an iteration's time, its entry in the run's journal included, that bare passes
        of the same network over its decisions take: one forward, and one forward and backward per epoch
    train.environment_share, train.update_share: shares of the iterations in which the environment steps (planners,
        drivers, simulator, observations) and in which the learner updates the network
    train.tracking_share: share of a whole training's time that the store, snapshots and checkpoints take
    """
    training = Training(config)
    training.iterate()
    device = device_of(config)
    parts = {
        "train.environment_share": Stopwatch(training.env, "step", device),
        "train.update_share": Stopwatch(training.learner, "update", device),
    }
    with (
        tempfile.TemporaryDirectory(dir=place) as outputs,
        open_run(replace(config, outputs=outputs), "training", as_mapping(config)) as run,
    ):
        run.begin()
        iteration_s, in_all_s, efficiency, record_s = _measure(config, training, run)
    training_s = training.n_total * iteration_s
    return {
        "train.decisions_per_s": training.curve.n_per_iteration / iteration_s,
        "train.iteration_efficiency": efficiency,
        "train.tracking_share": record_s / (training_s + record_s),
    } | {name: watch.seconds / in_all_s for name, watch in parts.items()}


def _measure(config: "RunConfig", training: Training, run: TrackedRun) -> tuple[float, float, float, float]:
    """Duration of an iteration and of all that were made (s), share of an iteration that bare passes take, duration of
    all tracking in a training (s).

    Iterations and bare passes alternate, so that a slow moment of the machine affects both.
    """
    device, layout = device_of(config), config.observation.layout
    bare = iteration_passes(training.policy, config.algorithm, layout, device)
    bare()
    iterations, notes, shares = [], [], []
    for _ in range(config.benchmark.n_iterations):
        bare_s = block_seconds(bare, 1, device)
        iterations.append(block_seconds(training.iterate, 1, device))
        notes.append(_seconds(lambda: _note(training, run)))
        shares.append(bare_s / (iterations[-1] + notes[-1]))
    iteration_s = median(iterations)
    training_s = training.n_total * iteration_s
    snapshots = Snapshots(run.folder / SNAPSHOTS_NAME, config.tracking.n_snapshots)
    n_snapshots = training_s / config.tracking.snapshot_period_s
    n_sent = min(training.n_total, training_s / config.tracking.flush_period_s)
    record_s = (
        training.n_total * median(notes)
        + n_sent * _seconds(run.deliver)
        + n_snapshots * (_seconds(run.sync) + _seconds(lambda: training.save_to(snapshots)))
        + len(config.curriculum.stages) * _seconds(lambda: save_stage(config, run, training))
    )
    return iteration_s, sum(iterations), median(shares), record_s


def _note(training: Training, run: TrackedRun) -> None:
    row = training.curve.rows[-1]
    run.log_metrics(training.curve.scalars(row), step=row["decisions"])


def _seconds(call: Callable[[], object]) -> float:
    started_s = time.perf_counter()
    call()
    return time.perf_counter() - started_s
