"""The runs of a sweep, read from their folders alone: which are chosen, what a run folder holds, what differs."""

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from negopipe.config.root import RESULT_NEUTRAL
from negopipe.errors import UserError, abbreviate
from negopipe.tracking.metrics_file import read
from negopipe.tracking.names import flatten
from negopipe.tracking.record import read_record
from negopipe.tracking.run_folder import CONFIG_NAME, METRICS_NAME

_ARCHIVED = re.compile(r"\.old\d+$")
"""Name of what a run folder held before a run that began anew (`negopipe.tracking.run_folder`)."""
_WILDCARD = re.compile(r"[*?[]")
LONGEST_HINT = 200
"""Characters of the folders that an error proposes."""


@dataclass(frozen=True)
class SweptRun:
    """Content of a run folder.

    name: `<run>`, or `<name>/<run>` among runs of several names
    config: flat, `{"algorithm.gamma": 0.99}`; a list of mappings is flat too, other lists are whole
    finished: stages that were run to their end
    commands: overrides of each command that made its results; none where that is not recorded
    """

    folder: Path
    name: str
    config: dict[str, Any]
    metrics: dict[str, Any]
    finished: tuple[str, ...]
    commands: tuple[tuple[str, ...], ...]
    sweep: str | None

    @property
    def overrides(self) -> tuple[str, ...]:
        """Overrides of the last command that made results; none where that is not recorded."""
        return self.commands[-1] if self.commands else ()

    @property
    def status(self) -> str:
        """`finished`, or the stages that are."""
        missing = [stage for stage in self.config.get("stages", []) if stage not in self.finished]
        return ("only " + ", ".join(self.finished) if self.finished else "unfinished") if missing else "finished"

    def holds(self, file_name: str) -> bool:
        return (self.folder / file_name).exists()


def find_folders(sources: Sequence[Path]) -> list[Path]:
    """The folders `<outputs>/<name>` that `sources` name or match, each once; all in one `<outputs>`.

    UserError where one holds no runs, where a pattern matches none, or where there are several `<outputs>`.
    """
    found = list(dict.fromkeys(folder for source in sources for folder in _matching(source)))
    outputs = list(dict.fromkeys(folder.parent for folder in found))
    if len(outputs) > 1:
        raise UserError(f"the folders must lie in one outputs folder, got {outputs[0]} and {outputs[1]}")
    return found


def _matching(source: Path) -> list[Path]:
    if _WILDCARD.search(source.name) and not source.exists():
        found = sorted(place for place in source.parent.glob(source.name) if _has_runs(place))
    else:
        place = source if source.name not in ("", "..") else source.resolve()
        found = [place] if _has_runs(place) else []
    if not found:
        near = [path for place in (source, source.parent) for path in place.glob(f"*/*/{CONFIG_NAME}")]
        known = sorted({str(path.parent.parent) for path in near})
        hint = f"; such are {abbreviate(', '.join(known), LONGEST_HINT)}" if known else ""
        raise UserError(f"the folder must be <outputs>/<name> with runs in it, got {source}{hint}")
    return found


def _has_runs(folder: Path) -> bool:
    return bool(_run_folders(folder))


def _run_folders(folder: Path) -> list[Path]:
    found = sorted(path.parent for path in folder.glob(f"*/{CONFIG_NAME}"))
    return [place for place in found if not _ARCHIVED.search(place.name)]


def read_runs(folders: Sequence[Path], sweep: str | None = None) -> list[SweptRun]:
    """The runs in the folders, those with the tag `sweep` only where it is given; UserError if there is none."""
    runs = [_read_run(place, len(folders) > 1) for folder in folders for place in _run_folders(folder)]
    chosen = [run for run in runs if sweep in (None, run.sweep)]
    if not chosen:
        tags = sorted({run.sweep for run in runs if run.sweep})
        raise UserError(f"--sweep must be one of {', '.join(tags) or 'none'}, got {sweep}")
    return chosen


def _read_run(folder: Path, with_parent: bool) -> SweptRun:
    record = read_record(folder)
    tags = record.tags if record else {}
    return SweptRun(
        folder=folder,
        name=f"{folder.parent.name}/{folder.name}" if with_parent else folder.name,
        config=flat(yaml.safe_load((folder / CONFIG_NAME).read_text(encoding="utf-8"))),
        metrics=read(folder / METRICS_NAME),
        finished=tuple(record.finished) if record else (),
        commands=tuple(tuple(shlex.split(text)) for text in record.commands()) if record else (),
        sweep=tags.get("sweep"),
    )


def differing_keys(runs: Sequence[SweptRun]) -> list[str]:
    """Keys of the config whose values are not all the same, without the seed and what changes no result."""
    keys = dict.fromkeys(key for run in runs for key in run.config)
    relevant = [key for key in keys if key != "seed" and key.partition(".")[0] not in RESULT_NEUTRAL]
    return [key for key in relevant if len({as_json(run.config.get(key)) for run in runs}) > 1]


def as_json(value: Any) -> str:
    """The same text for the same value of a config."""
    return json.dumps(value, sort_keys=True)


def flat(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings, and lists of mappings, as one mapping with dotted keys."""
    return flatten(_numbered(tree))


def _numbered(tree: Any) -> Any:
    """Lists of mappings as mappings from place to item."""
    if isinstance(tree, list) and tree and all(isinstance(item, Mapping) for item in tree):
        tree = dict(enumerate(tree))
    return {key: _numbered(part) for key, part in tree.items()} if isinstance(tree, Mapping) else tree
