"""The benchmark's figures of training: how fast it is, and what keeping a record of it costs."""

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
from negopipe.tensors.timing import block_seconds
from negopipe.tracking.run_folder import SNAPSHOTS_NAME
from negopipe.tracking.snapshots import Snapshots
from negopipe.tracking.store import TrackedRun, open_run
from negopipe.training.training import Training, save_stage

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig


def measure_training(config: "RunConfig", place: Path) -> dict[str, float]:
    """Train for `benchmark.n_iterations`, after one in which all is compiled, with a run and a store in `place`.

    train.decisions_per_s: of the iterations, the record of them left out
    train.iteration_efficiency: of an iteration's time, noting it in the run's journal included, what bare passes of
        the same network over its decisions take: one forward, and one forward and backward per epoch
    train.tracking_share: of a whole training's time, what goes into telling the store, snapshots and checkpoints
    """
    training = Training(config)
    training.iterate()
    with (
        tempfile.TemporaryDirectory(dir=place) as outputs,
        open_run(replace(config, outputs=outputs), "training", as_mapping(config)) as run,
    ):
        run.begin()
        iteration_s, efficiency, record_s = _measure(config, training, run)
    training_s = training.n_total * iteration_s
    return {
        "train.decisions_per_s": training.curve.n_per_iteration / iteration_s,
        "train.iteration_efficiency": efficiency,
        "train.tracking_share": record_s / (training_s + record_s),
    }


def _measure(config: "RunConfig", training: Training, run: TrackedRun) -> tuple[float, float, float]:
    """Seconds of an iteration, share of it that bare passes take, seconds of all that is recorded in a whole training.

    Iterations and bare passes take turns, so that a slow moment of the machine hits both alike.
    """
    device, shape = device_of(config), training.env.game.observation_shape
    bare = iteration_passes(training.policy, config.algorithm, shape, device)
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
    return iteration_s, median(shares), record_s


def _note(training: Training, run: TrackedRun) -> None:
    row = training.curve.rows[-1]
    run.log_metrics(training.curve.scalars(row), step=row["decisions"])


def _seconds(call: Callable[[], object]) -> float:
    started_s = time.perf_counter()
    call()
    return time.perf_counter() - started_s
