"""What the page asks for: who can be met where, encounters step by step, results. JSON values in and out."""

import secrets
import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from negopipe.errors import UserError
from negopipe.evaluation.encounter import CONTROLS
from negopipe.play.arena import Arena, open_arena
from negopipe.play.folder import EncounterFolder
from negopipe.play.live import LiveEncounter
from negopipe.play.scenery import VEHICLES, colors, scenery

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

MOST_ENCOUNTERS, MOST_ARENAS = 64, 8
"""Encounters and arenas that are kept in memory; the one that was used longest ago makes room."""


class UnknownEncounter(Exception):
    """An encounter that this server does not have, such as one of a server before it."""


class Service:
    """One server's encounters. Its methods may be called in any threads; they compute one after the other.

    base: config of the command line; overrides: those of the command line
    """

    def __init__(self, base: "RunConfig", overrides: Sequence[str]) -> None:
        self.base, self.overrides = base, tuple(overrides)
        self.folder = EncounterFolder(Path(base.outputs))
        self._lock = threading.Lock()
        self._arenas: OrderedDict[tuple[str, str], Arena] = OrderedDict()
        self._encounters: OrderedDict[str, tuple[LiveEncounter, dict[str, Any]]] = OrderedDict()

    def menu(self) -> dict[str, Any]:
        """Opponents, streets, controls, colours, and the results so far."""
        play = self.base.play
        with self._lock:
            return {
                "opponents": [{"name": name, "label": each.label} for name, each in play.opponents.items()],
                "streets": [{"name": name, "label": each.label} for name, each in play.streets.items()],
                "controls": list(CONTROLS),
                "colors": colors(),
                "folder": str(self.folder.folder),
                "results": self.folder.results(),
            }

    def begin(self, opponent: Any, street: Any, control: Any) -> dict[str, Any]:
        """A new encounter: its id, its scenery and its first frame."""
        with self._lock:
            live = LiveEncounter(self._arena(str(opponent), str(street)), control, secrets.randbelow(2**31))
            shown = {"opponent": opponent, "street_name": street, "control": control, "vehicle": VEHICLES}
            shown |= {"id": secrets.token_urlsafe(9)} | scenery(live.arena, live.task)
            _put(self._encounters, shown["id"], (live, shown), MOST_ENCOUNTERS)
            return shown | {"frames": live.frames}

    def look(self, key: str) -> dict[str, Any]:
        """An encounter with all its frames so far, for a page that was loaded anew."""
        with self._lock:
            live, shown = self._find(key)
            return shown | {"frames": live.frames}

    def step(self, key: str, step: Any, command: Any, opponent_command: Any = None) -> dict[str, Any]:
        """The frame after decision `step`. A decision that was made already is told again, so a page may repeat itself.

        command, opponent_command: of the person and of the second one; None where there is no second one
        Where the encounter is over, its record is written and the frame has a `result`.
        """
        with self._lock:
            live, shown = self._find(key)
            n_made = len(live.commands)
            if isinstance(step, bool) or not isinstance(step, int) or not 0 <= step <= n_made:
                raise UserError(f"step must be a whole number up to {n_made}, got {str(step)[:20]}")
            frame = live.frames[step + 1] if step < n_made else live.step(command, opponent_command)
            if live.outcome is not None and "result" not in shown:
                shown["result"] = self._finish(live)
            return frame | {"result": shown["result"]} if frame["outcome"] is not None else frame

    def _finish(self, live: LiveEncounter) -> dict[str, Any]:
        """Write the record; the row of the encounter, its file and the results so far, or why it was not written."""
        try:
            path, row = self.folder.add(live)
        except OSError as error:
            return {"error": f"the encounter could not be written: {error}", "results": []}
        told = ("episode", "outcome", "passes_first", "ego_time_s", "social_time_s", "smallest_gap_m")
        cells = row[list(told)].astype(object).where(row[list(told)].notna(), None).iloc[0].to_dict()
        return {"row": cells, "file": str(path), "results": self.folder.results()}

    def _arena(self, opponent: str, street: str) -> Arena:
        arena = self._arenas.get((opponent, street)) or open_arena(self.base, self.overrides, opponent, street)
        _put(self._arenas, (opponent, street), arena, MOST_ARENAS)
        return arena

    def _find(self, key: str) -> tuple[LiveEncounter, dict[str, Any]]:
        if key not in self._encounters:
            raise UnknownEncounter
        self._encounters.move_to_end(key)
        return self._encounters[key]


def _put(kept: OrderedDict, key: Any, value: Any, n_most: int) -> None:
    kept[key] = value
    kept.move_to_end(key)
    while len(kept) > n_most:
        kept.popitem(last=False)
