"""The train stage: Algorithm 1 of the paper."""

import logging
import signal
import time
from typing import TYPE_CHECKING, NoReturn

from negopipe.errors import UserError
from negopipe.report.description import run_description
from negopipe.runtime import backend
from negopipe.runtime.build import save_policy
from negopipe.runtime.interruption import DeferredInterrupt
from negopipe.runtime.progress import ProgressLine
from negopipe.tensors.ranks import ALONE, Ranks
from negopipe.tracking.checkpoint import CHECKPOINT_NAME
from negopipe.tracking.run_folder import SNAPSHOTS_NAME
from negopipe.tracking.snapshots import Snapshots
from negopipe.training.training import Training, save_stage

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


def run(config: "RunConfig", tracked: "TrackedRun", ranks: Ranks = ALONE) -> None:
    """Train a policy.

    Writes checkpoint.safetensors, history.csv, training_episodes.csv and the `train` part of metrics.json.
    A stopped run resumes from its newest snapshot, with the same results as an uninterrupted one.
    ranks: processes that train together, of which this is the first
    """
    tracked.set_description(run_description(config))
    ranks.call(config)
    training = Training(config, tracked.folder, ranks)
    snapshots = Snapshots(tracked.folder / SNAPSHOTS_NAME, config.tracking.n_snapshots)
    training.resume(snapshots)
    last_snapshot_s = time.monotonic()
    with ProgressLine("train", training.n_total, n_done=training.n_done) as progress, DeferredInterrupt() as interrupt:
        while training.n_done < training.n_total:
            row = training.iterate()  # select the task distribution, collect, estimate advantages, update
            if training.not_finite():
                _stop_at_last_good(config, tracked, training)
            progress.advance(training.curve.text(row))
            is_due = time.monotonic() - last_snapshot_s >= config.tracking.snapshot_period_s
            with training.curve.tracking():
                tracked.log_metrics(training.curve.scalars(row), step=row["decisions"])
                if training.is_at_stage_end:
                    save_stage(config, tracked, training)
                is_stopped, is_due = ranks.any(interrupt(), is_due)
                if is_due or is_stopped:
                    tracked.sync()  # decisions before the snapshot are not logged again
                    training.save_to(snapshots)
                    last_snapshot_s = time.monotonic()
            if is_stopped:
                _stop(interrupt)
    ranks.close()
    tracked.update_metrics_json({"train": training.curve.summary()})
    snapshots.remove()


def follow(ranks: Ranks) -> None:
    """Train as another rank than the first, which gives the config; return at once if it gives none."""
    config: RunConfig | None = ranks.first(lambda: None)
    if config is None:
        return
    backend.prepare(config)
    training = Training(config, None, ranks)
    training.resume(None)
    with DeferredInterrupt() as interrupt:
        while training.n_done < training.n_total:
            training.iterate()
            if training.not_finite():
                raise SystemExit(1)  # the first rank says why
            is_stopped, is_due = ranks.any(interrupt(), False)
            if is_due or is_stopped:
                training.save_to(None)
            if is_stopped:
                _stop(interrupt)
    ranks.close()


def _stop(interrupt: DeferredInterrupt) -> NoReturn:
    """End this rank as its signal asks for, or as SIGTERM where only another rank has had one."""
    interrupt.raise_if_requested()
    raise SystemExit(128 + signal.SIGTERM)


def _stop_at_last_good(config: "RunConfig", run: "TrackedRun", training: Training) -> NoReturn:
    """Keep the policy from before the diverged iteration, and raise UserError."""
    name, path = training.not_finite()[0], run.folder / CHECKPOINT_NAME
    training.policy.load_state_dict(training.weights_before)
    save_policy(path, training.policy, config, (training.n_done - 1) * training.curve.n_per_iteration)
    raise UserError(
        f"algorithm={config.algorithm.kind} with these values of algorithm and reward makes "
        f"training diverge: {name} is not finite after iteration {training.n_done} of {training.n_total}; the "
        f"policy before it is kept in {path}"
    )
