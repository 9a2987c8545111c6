"""Encounters of a person with an opponent: the file of one, and its drive again. docs/play.md describes the format.

The file holds all that the drive depends on (config, task, the person's commands, the ego's horizons) and the drive.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from negopipe.agents.driver import Driver, HorizonDriver
from negopipe.agents.horizon_drivers import sequence_planner
from negopipe.agents.person import PEDALS, PERSON, PedalsConfig, horizon_driver, pedal_driver
from negopipe.errors import UserError, abbreviate
from negopipe.evaluation.episodes import drive_seats
from negopipe.evaluation.trace import EPISODE_AXIS, Trace
from negopipe.game.game import Game
from negopipe.schema import INFINITE
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import EGO, NEAREST, Casting, Task
from negopipe.tensors.tree import named_tensors, with_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

FORMAT = "negopipe encounter 1"
"""Written into every file; the number changes when a field changes its meaning."""

CONTROLS = ("pedals", "horizon")
"""How a person drives: by pedals along the route, or by the prediction horizon of a planner."""


@dataclass(frozen=True)
class Encounter:
    """One encounter that is over.

    number: of the encounter in its folder, from 1; the column `episode` of episodes.csv
    opponent, street: names in `play.opponents` and `play.streets`; the columns `planner` and `setting`
    control: one of `CONTROLS`
    baseline: name of the ego's driver in `evaluation.baselines`; None = the policy of the config's checkpoint;
        `PERSON` = a second person
    participant: name of the person, as `play.participant` gives it
    started: time of the start, ISO 8601, UTC
    made_by: versions and hash of the code
    commands: of the person, decision by decision: one of `PEDALS`, or a horizon in s
    opponent_commands: those of the second person; None where there is none
    task: of the one episode
    drive: record of the one episode, as long as it was
    config: the whole config, as `negopipe.config.root.as_mapping` gives it
    """

    number: int
    opponent: str
    street: str
    control: str
    baseline: str | None
    participant: str
    started: str
    made_by: Mapping[str, str]
    commands: Sequence[str]
    opponent_commands: Sequence[str] | None
    task: Task
    drive: Trace
    config: Mapping[str, Any]


def is_command(command: object, control: str, horizons_s: Sequence[float]) -> bool:
    """Whether a text is a command of a person with this control; horizons_s: those that the person may choose."""
    if not isinstance(command, str):
        return False
    allowed = PEDALS if control == "pedals" else tuple(horizon_text(horizon_s) for horizon_s in horizons_s)
    return command in allowed


def horizon_text(horizon_s: float) -> str:
    """A prediction horizon as a command: `2`, `0.5`, `inf`."""
    return INFINITE if horizon_s == math.inf else f"{horizon_s:g}"


def person(game: Game, pedals: PedalsConfig, control: str, commands: Iterator[str]) -> Driver:
    """Driver of one world by a person's commands, one per decision."""
    device = game.simulator.road.device
    if control == "pedals":
        return pedal_driver(
            pedals, game.simulator, lambda: torch.tensor([[PEDALS.index(next(commands))]], device=device)
        )
    return horizon_driver(game.plan, lambda: torch.tensor([[float(next(commands))]], device=device))


Watch = Callable[[Perception], None]
"""Called with the ego's perception before every decision."""


def drive_again(config: "RunConfig", game: Game, encounter: Encounter, watch: Watch | None = None) -> Trace:
    """The record of the encounter, driven anew from its task, its commands and the horizons of the ego.

    config, game: of the encounter's config. An ego without horizons drives by its rule again.
    """
    pedals, control = config.play.pedals, encounter.control
    opponent = _ego(config, game, encounter, watch)
    seats = {EGO: opponent, NEAREST: person(game, pedals, control, iter(encounter.commands))}
    names = (encounter.opponent, encounter.street)
    return named(cut(drive_seats(game, seats, encounter.task, config.evaluation.reward, names)))


def _ego(config: "RunConfig", game: Game, encounter: Encounter, watch: Watch | None) -> Driver:
    """Driver of the ego of `drive_again`."""
    if encounter.opponent_commands is not None:
        return person(game, config.play.pedals, encounter.control, iter(encounter.opponent_commands))
    horizon_s, key = encounter.drive.horizon_s[:, :, EGO], encounter.task.noise_seed
    if encounter.baseline is not None and np.isnan(horizon_s).any():
        return config.evaluation.baselines[encounter.baseline].driver(game, key)
    choose = sequence_planner(torch.from_numpy(horizon_s).to(key.device))

    def choose_watched(perception: Perception) -> Tensor:
        if watch is not None:
            watch(perception)
        return choose(perception)

    return HorizonDriver(choose_watched, game.plan)


def named(trace: Trace) -> Trace:
    """The trace with the person as the driver of the nearest social vehicle."""
    driver = np.asarray(trace.driver, dtype=object).copy()
    driver[:, NEAREST] = PERSON
    return replace(trace, driver=driver)


def cut(trace: Trace) -> Trace:
    """The trace of one episode without what follows its end."""
    n = int(trace.n_steps[0])
    n_states = {"position_m", "yaw_rad", "speed_mps", "progress_m"}
    rows = {name: getattr(trace, name)[: n + (name in n_states)] for name, axis in EPISODE_AXIS.items() if axis == 1}
    return replace(trace, **rows)


def difference(then: Trace, now: Trace) -> str | None:
    """Name of the first field of two traces that is not the same to the last bit; None where all are."""
    for name in EPISODE_AXIS:
        a, b = (np.asarray(getattr(trace, name)) for trace in (then, now))
        if not np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
            return name
    return None


def encounter_text(encounter: Encounter) -> str:
    """Content of the file of an encounter: JSON, whose numbers give the same floats when they are read."""
    values = {field.name: getattr(encounter, field.name) for field in fields(Encounter)}
    values["task"] = {name: _plain(tensor.cpu().numpy()[0]) for name, tensor in named_tensors(encounter.task).items()}
    values["drive"] = {"dt_s": encounter.drive.dt_s} | {
        name: _plain(np.take(getattr(encounter.drive, name), 0, axis)) for name, axis in EPISODE_AXIS.items()
    }
    lines = (f"{json.dumps(name)}: {json.dumps(value)}" for name, value in ({"format": FORMAT} | values).items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def read_encounter(path: Path) -> Encounter:
    """The encounter of a file; UserError where it is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"encounter must be a file that negopipe.play writes, got {path}: {_reason(error)}") from error
    said = content.get("format") if isinstance(content, dict) else None
    if said != FORMAT:
        raise UserError(f"encounter must be a file of the format {FORMAT!r}, got {path} with {abbreviate(said)}")
    try:
        return _encounter(content)
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise UserError(f"encounter must be a whole file of negopipe.play, got {path}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {abbreviate(' '.join(str(error).split()))}"


def _encounter(content: Mapping[str, Any]) -> Encounter:
    task = {name: _array(values, name in WHOLE_TASK)[None] for name, values in content["task"].items()}
    drive = {
        name: np.expand_dims(_array(content["drive"][name], name in WHOLE_DRIVE), axis)
        for name, axis in EPISODE_AXIS.items()
    }
    typed: dict[str, Any] = {name: values.astype(TYPES[name]) for name, values in drive.items() if name in TYPES}
    opponent, street, dt_s = content["opponent"], content["street"], content["drive"]["dt_s"]
    content = {"opponent_commands": None, **content}  # which files of older code do not have
    return Encounter(
        **{field.name: content[field.name] for field in fields(Encounter) if field.name not in ("task", "drive")},
        task=with_tensors(_any_task(), {name: torch.from_numpy(values) for name, values in task.items()}),
        drive=Trace(planner=opponent, setting=street, dt_s=dt_s, **drive | typed),
    )


WHOLE_TASK = {"noise_seed", "family", "casting/driver", "casting/redraw_steps", "casting/reaction_steps"}
"""Fields of a task that are whole numbers; all others are float32."""
WHOLE_DRIVE = {"street", "n_steps", "reached_step", "outcome"}
"""Fields of a trace that are int64; the others are float32, but for those of `TYPES`."""
TYPES: Mapping[str, type] = {"is_full_braking": bool, "intervention": np.int8, "driver": object}


def _any_task() -> Task:
    """Some task, for the structure."""
    none = torch.zeros(1, 2)
    shared = {field.name: none for field in fields(Task) if field.name != "casting"}
    return Task(**shared, casting=Casting.of_nobody(none))


def _plain(values: np.ndarray) -> Any:
    """Nested lists of JSON values: null for NaN, `inf` for infinity."""
    if values.dtype.kind != "f":
        return values.tolist()
    if np.isfinite(values).all():
        return values.astype(np.float64).tolist()
    return np.vectorize(_plain_number, otypes=[object])(values).tolist()


def _plain_number(value: float) -> float | str | None:
    if math.isnan(value):
        return None
    return INFINITE if value == math.inf else float(value)


def _array(values: Any, is_whole: bool) -> np.ndarray:
    """The array that `_plain` wrote."""
    if is_whole:
        return np.array(values, dtype=np.int64)
    raw = np.array(values, dtype=object)
    texts = [value for value in raw.flat if isinstance(value, str)]
    if texts and set(texts) != {INFINITE}:
        return raw
    return np.vectorize(_number, otypes=[np.float32])(raw) if raw.size else raw.astype(np.float32)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
