"""Taking over a training that another run of the same outputs folder has finished."""

import logging
import math
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from negopipe.tracking.checkpoint import CHECKPOINT_NAME
from negopipe.tracking.metrics_file import read
from negopipe.tracking.record import RECORD_NAME, read_record
from negopipe.tracking.store import HISTORY_NAME, METRICS_NAME

if TYPE_CHECKING:
    from negopipe.config import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


def take_over_training(config: "RunConfig", run: "TrackedRun", key: str, source: str | None) -> bool:
    """Copy what a training with this `key` left in another run folder; False where there is none.

    source: hash of the code that must have made it; None = any
    """
    for path in sorted(Path(config.outputs).absolute().glob(f"*/*/{RECORD_NAME}")):
        record = read_record(path.parent) if path.parent != run.folder else None
        is_same = record is not None and record.finished.get("train") == key and source in (None, record.source)
        if record is not None and is_same and (path.parent / CHECKPOINT_NAME).is_file():
            _copy(path.parent, run)
            run.set_tags({"train.taken_from": record.run_id})
            log.info(f"train      taken over from {path.parent}: same config, same code")
            return True
    return False


def _copy(folder: Path, run: "TrackedRun") -> None:
    for name in (CHECKPOINT_NAME, HISTORY_NAME):
        draft = run.folder / f".{name}.draft"
        shutil.copyfile(folder / name, draft)
        os.replace(draft, run.folder / name)
    run.update_metrics_json({"train": read(folder / METRICS_NAME)["train"]})
    for row in pd.read_csv(run.folder / HISTORY_NAME).to_dict("records"):
        scalars = {f"train/{k}": v for k, v in row.items() if isinstance(v, float) and not math.isnan(v)}
        run.log_metrics(scalars, step=row["decisions"])
