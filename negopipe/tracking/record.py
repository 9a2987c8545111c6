"""What a run folder says of itself, so that the same command goes on where it stopped and repeats nothing."""

import json
import logging
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

RECORD_NAME = "record.json"

log = logging.getLogger("negopipe")


@dataclass(frozen=True)
class RunRecord:
    """The run in a folder.

    run_id: its id in the store
    source: hash of the code that made it (`negopipe.identity.source_hash`)
    finished: stages that are finished, each with the hash of the config that it depends on
    """

    run_id: str
    source: str
    finished: dict[str, str] = field(default_factory=dict)


def read_record(folder: Path) -> RunRecord | None:
    """The record of a folder; None where there is none, or none that can be read (a line says so)."""
    path = folder / RECORD_NAME
    if not path.exists():
        return None
    try:
        return RunRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        log.warning(f"record     left out: {path} is no record of a run: {error}")
        return None


def write_record(folder: Path, record: RunRecord) -> None:
    """Write it whole or not at all."""
    draft = folder / f".{RECORD_NAME}.{os.getpid()}"
    draft.write_text(json.dumps(asdict(record), indent=2) + "\n", encoding="utf-8")
    os.replace(draft, folder / RECORD_NAME)
