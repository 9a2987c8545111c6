"""The runs of a sweep as a table: what differs between them, what came of it. Read from the run folders alone."""

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from negopipe.config.root import RESULT_NEUTRAL
from negopipe.errors import UserError
from negopipe.sweeping.objective import objective
from negopipe.tracking.metrics_file import read
from negopipe.tracking.names import flatten
from negopipe.tracking.record import read_record
from negopipe.tracking.run_folder import CONFIG_NAME, METRICS_NAME

OBJECTIVE, SPREAD, SEEDS, STATUS, RUNS = "objective", "objective_std", "seeds", "status", "runs"
"""Columns of a table after those of the config."""

_SET_ASIDE = re.compile(r"\.old\d+$")
"""Name of what a run folder held before a run that began anew (`negopipe.tracking.run_folder`)."""


@dataclass(frozen=True)
class SweptRun:
    """What a run folder holds.

    config: flat, `{"algorithm.gamma": 0.99}`; a list of mappings is flat too, other lists are whole
    finished: stages that were run to their end
    commands: overrides of each command that made its results; none where that is not recorded
    """

    name: str
    config: dict[str, Any]
    metrics: dict[str, Any]
    finished: tuple[str, ...]
    commands: tuple[tuple[str, ...], ...]
    sweep: str | None

    @property
    def overrides(self) -> tuple[str, ...]:
        """Of the last command that made results; none where that is not recorded."""
        return self.commands[-1] if self.commands else ()

    @property
    def status(self) -> str:
        """`finished`, or what is."""
        missing = [stage for stage in self.config.get("stages", []) if stage not in self.finished]
        return ("only " + ", ".join(self.finished) if self.finished else "unfinished") if missing else "finished"


def read_runs(folder: Path, sweep: str | None = None) -> list[SweptRun]:
    """The runs in `outputs/<name>`, those with the tag `sweep` only where it is given; UserError if there is none."""
    folders = [path.parent for path in sorted(folder.glob(f"*/{CONFIG_NAME}"))]
    runs = [_read_run(place) for place in folders if not _SET_ASIDE.search(place.name)]
    chosen = [run for run in runs if sweep in (None, run.sweep)]
    if not runs:
        raise UserError(f"the folder must be outputs/<name> with runs in it, got {folder}")
    if not chosen:
        tags = sorted({run.sweep for run in runs if run.sweep})
        raise UserError(f"--sweep must be one of {', '.join(tags) or 'none'}, got {sweep}")
    return chosen


def differing_keys(runs: Sequence[SweptRun]) -> list[str]:
    """Keys of the config whose values are not all the same, without the seed and what changes no result."""
    keys = dict.fromkeys(key for run in runs for key in run.config)
    relevant = [key for key in keys if key != "seed" and key.partition(".")[0] not in RESULT_NEUTRAL]
    return [key for key in relevant if len({_text(run.config.get(key)) for run in runs}) > 1]


def tabulate(runs: Sequence[SweptRun], keys: Sequence[str], minimize: bool = False) -> pd.DataFrame:
    """A row per config, the best first: what differs, mean and spread of the objective over its seeds.

    keys: of metrics.json, their mean is the objective
    Columns are `differing_keys(runs)`, OBJECTIVE (NaN where no seed has one), SPREAD (standard deviation, NaN for
    fewer than two), SEEDS (number with an objective), STATUS and RUNS (names of folders, the best first).
    """
    differing = differing_keys(runs)
    groups: dict[str, list[SweptRun]] = {}
    for run in runs:
        groups.setdefault(_text([run.config.get(key) for key in differing]), []).append(run)
    rows = [_row(group, differing, keys, minimize) for group in groups.values()]
    table = pd.DataFrame(rows, columns=[*differing, OBJECTIVE, SPREAD, SEEDS, STATUS, RUNS], dtype=object)
    numbers = {name: pd.to_numeric(table[name]) for name in (OBJECTIVE, SPREAD, SEEDS)}
    return table.assign(**numbers).sort_values(OBJECTIVE, ascending=minimize, kind="stable", ignore_index=True)


def _row(group: list[SweptRun], differing: list[str], keys: Sequence[str], minimize: bool) -> list[Any]:
    values = {run.name: objective(run.metrics, keys) for run in group}
    known = pd.Series({name: value for name, value in values.items() if value is not None}, dtype=float)
    best_first = [*known.sort_values(ascending=minimize).index, *(name for name in values if name not in known)]
    statuses = [run.status for run in group]
    is_mixed = len(set(statuses)) > 1
    status = f"{statuses.count('finished')} of {len(group)} finished" if is_mixed else statuses[0]
    config = [group[0].config.get(key) for key in differing]
    return [*config, known.mean(), known.std(), len(known), status, " ".join(best_first)]


def _read_run(folder: Path) -> SweptRun:
    record = read_record(folder)
    tags = record.tags if record else {}
    return SweptRun(
        name=folder.name,
        config=flat(yaml.safe_load((folder / CONFIG_NAME).read_text(encoding="utf-8"))),
        metrics=read(folder / METRICS_NAME),
        finished=tuple(record.finished) if record else (),
        commands=tuple(tuple(shlex.split(text)) for text in record.commands()) if record else (),
        sweep=tags.get("sweep"),
    )


def flat(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings, and lists of mappings, as one mapping with dotted keys."""
    return flatten(_numbered(tree))


def _numbered(tree: Any) -> Any:
    """Lists of mappings as mappings from place to item."""
    if isinstance(tree, list) and tree and all(isinstance(item, Mapping) for item in tree):
        tree = dict(enumerate(tree))
    return {key: _numbered(part) for key, part in tree.items()} if isinstance(tree, Mapping) else tree


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
