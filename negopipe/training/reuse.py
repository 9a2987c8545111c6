"""Reuse of a training that another run in the same outputs folder has finished."""

import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

from negopipe.tracking.checkpoint import CHECKPOINT_NAME
from negopipe.tracking.csv_file import read_csv
from negopipe.tracking.metrics_file import read
from negopipe.tracking.record import RECORD_NAME, read_record
from negopipe.tracking.run_folder import HISTORY_NAME, METRICS_NAME, TRAINING_EPISODES_NAME
from negopipe.tracking.training_files import HISTORY
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

PRODUCTS = (CHECKPOINT_NAME, HISTORY_NAME, TRAINING_EPISODES_NAME)
"""Files of a finished training, beside its part of metrics.json."""

log = logging.getLogger("negopipe")


def take_over_training(config: "RunConfig", run: "TrackedRun", key: str) -> bool:
    """Copy the files of a training with this `key` from another run folder; False where there is none."""
    for path in sorted(Path(config.outputs).absolute().glob(f"*/*/{RECORD_NAME}")):
        folder = path.parent
        record = read_record(folder) if folder != run.folder else None
        if record is None or not record.has_finished("train", key, run.accepted):
            continue
        if all((folder / name).is_file() for name in PRODUCTS):
            _copy(folder, run)
            run.set_tags({"train.taken_from": f"{folder.parent.name}/{folder.name}"})
            run.mark_finished("train", key, record.finished["train"]["source"])
            log.info(f"train      taken over from {folder}, which trained with the same config")
            return True
    return False


def _copy(folder: Path, run: "TrackedRun") -> None:
    for name in PRODUCTS:
        write_whole(run.folder / name, (folder / name).read_bytes())
    run.update_metrics_json({"train": read(folder / METRICS_NAME)["train"]})
    for row in read_csv(run.folder / HISTORY_NAME, HISTORY, ("decisions",)).to_dict("records"):
        scalars = {f"train/{k}": v for k, v in row.items() if isinstance(v, float) and not math.isnan(v)}
        run.log_metrics(scalars, step=row["decisions"])
