"""Record of a run in its folder, from which the same command resumes it without repeating finished stages."""

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from pydantic import TypeAdapter

from negopipe.tracking.whole_file import write_whole

RECORD_NAME = "record.json"
OVERRIDES = "overrides"
"""Tag and entry of a finished stage: the arguments of `python -m negopipe`, quoted for a shell."""
ONLY_SHOW = ("report", "replay")
"""Stages without results: their command is not the run's."""

log = logging.getLogger("negopipe")


@dataclass(frozen=True)
class RunRecord:
    """Record of the run in a folder.

    key: the run's own id, the same in every store (`negopipe.tracking.sync.delivery.KEY_TAG`)
    source: hash of the code that worked on it last (`negopipe.runtime.identity.source_hash`)
    tags: of the run in the store, beside its config
    finished: by stage the hashes `config` (of what it depends on) and `source` (of the code that made it), and the
        `overrides` of the command that made it
    """

    key: str
    source: str
    tags: dict[str, str] = field(default_factory=dict)
    finished: dict[str, dict[str, str]] = field(default_factory=dict)

    def has_finished(self, stage: str, key: str, source: str | None) -> bool:
        """Whether the stage was finished with the config of hash `key`, by the code of hash `source`; None = any."""
        made = self.finished.get(stage)
        return made is not None and made["config"] == key and source in (None, made["source"])

    def with_finished(self, stage: str, key: str, source: str, overrides: str | None) -> "RunRecord":
        """This record with a finished stage; overrides: of this command, None = not known."""
        known = {} if overrides is None else {OVERRIDES: overrides}
        made = {"config": key, "source": source, **known}
        tags = self.tags if stage in ONLY_SHOW else {**self.tags, **known}
        return replace(self, finished={**self.finished, stage: made}, tags=tags)

    def with_tags(self, tags: Mapping[str, str]) -> "RunRecord":
        """This record with a later command's tags; existing results keep the command that made them."""
        kept = {OVERRIDES: self.tags[OVERRIDES]} if self._results() and OVERRIDES in self.tags else {}
        return replace(self, tags={**self.tags, **tags, **kept})

    def commands(self) -> list[str]:
        """Overrides of the commands that made the results, in their order and each once; none where not recorded."""
        made = [part[OVERRIDES] for part in self._results().values() if OVERRIDES in part]
        return list(dict.fromkeys(made)) or [text for tag, text in self.tags.items() if tag == OVERRIDES]

    def _results(self) -> dict[str, dict[str, str]]:
        return {stage: made for stage, made in self.finished.items() if stage not in ONLY_SHOW}


def as_command(overrides: str) -> str:
    """The command with these overrides, to paste into a shell."""
    return f"python -m negopipe {overrides}".rstrip()


def read_record(folder: Path) -> RunRecord | None:
    """Record of a folder; None where there is none, or, with a line in the log, where it cannot be read."""
    path = folder / RECORD_NAME
    if not path.exists():
        return None
    try:
        return TypeAdapter(RunRecord).validate_json(path.read_bytes())
    except ValueError as error:
        log.warning(f"record     ignored: {path} is no record of a run: {str(error).splitlines()[0]}")
        return None


def write_record(folder: Path, record: RunRecord) -> None:
    write_whole(folder / RECORD_NAME, (json.dumps(asdict(record), indent=2) + "\n").encode())
