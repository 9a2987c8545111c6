"""A live encounter: the world of one person and one opponent, stepped command by command."""

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import torch

from negopipe.config.root import as_mapping
from negopipe.envs.episode_record import EpisodeRecord
from negopipe.errors import UserError, abbreviate
from negopipe.evaluation.encounter import CONTROLS, Encounter, horizon_text, is_command, named, person
from negopipe.evaluation.episodes import motion_of
from negopipe.game.reward import reward
from negopipe.play.arena import Arena
from negopipe.runtime.identity import source_hash
from negopipe.safety.layer import INTERVENTIONS
from negopipe.simulation.state import EGO, NEAREST
from negopipe.tensors.torch_settings import own_settings

Frame = dict[str, Any]
"""What the page draws of one instant, as JSON values; `LiveEncounter.frames` says what is in it."""


class LiveEncounter:
    """One encounter from its task to its end.

    frames: one per state, the first before any decision. step: decisions until then; time_s; vehicles: x, y (m), yaw
        (rad), speed (m/s) of each in the world, the ego first, the person second; horizon: of the ego's last plan, as
        text, or null; probability: of each horizon at that decision, or []; is_full_braking, intervention: of the ego;
        command: of the person; outcome: of the encounter where it is over, else null
    """

    def __init__(self, arena: Arena, control: str, seed: int) -> None:
        if control not in CONTROLS:
            raise UserError(f"control must be one of {', '.join(CONTROLS)}, got {abbreviate(control)}")
        self.arena, self.control = arena, control
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self.commands: list[str] = []
        with own_settings():
            self.task = arena.task(seed)
            self._world = arena.game.simulator.reset(self.task)
            self._record = EpisodeRecord(arena.game, 1)
            self._record.start(arena.game, self._world, torch.zeros(1, dtype=torch.int64).numpy())
            ego, self._chooser = arena.ego(self.task)
            commands = person(arena.game, arena.config.play.pedals, control, self._latest())
        self._seats = {EGO: ego, NEAREST: commands}
        self.frames = [self._frame(None)]

    def _latest(self) -> Iterator[str]:
        while True:
            yield self.commands[-1]

    @property
    def outcome(self) -> str | None:
        """Outcome of the encounter; None while it goes on."""
        return self.frames[-1]["outcome"]

    @own_settings()
    def step(self, command: Any) -> Frame:
        """The state one control step later; UserError for what is no command, or where the encounter is over."""
        if not is_command(command, self.control, self.arena.horizons_s):
            raise UserError(f"command must be one of those of the control {self.control}, got {abbreviate(command)}")
        if self.outcome is not None:
            raise UserError(f"step must be asked for before the encounter is over, got {len(self.commands)}")
        self.commands.append(command)
        game = self.arena.game
        world, motion, intervention = motion_of(game, self._seats, self._world)
        self._world, events = game.step(world, motion)
        paid = reward(self.arena.config.evaluation.reward, events.is_collision, events.is_success)
        self._record.add(game, self._world, motion, {"intervention": intervention.numpy(), "reward": paid.numpy()})
        is_over = bool((events.is_terminated | events.is_truncated)[0])
        outcome = self._record.outcome(game, self._world, events, 0) if is_over else None
        horizon_s = float(motion.horizon[0, EGO])
        decision = {
            "horizon": None if math.isnan(horizon_s) else horizon_text(horizon_s),
            "probability": [] if self._chooser is None else self._chooser.probability,
            "is_full_braking": bool(motion.is_full_braking[0, EGO]),
            "intervention": INTERVENTIONS[int(intervention[0])],
            "command": command,
        }
        self.frames.append(self._frame(outcome) | decision)
        return self.frames[-1]

    def _frame(self, outcome: str | None) -> Frame:
        vehicles = self._world.vehicles
        rows = torch.cat([vehicles.position, vehicles.yaw[..., None], vehicles.speed[..., None]], -1)[0]
        step = len(self.commands)
        return {
            "step": step,
            "time_s": step * self.arena.config.scenario.dt_s,
            "vehicles": rows.tolist(),
            "has_reached": self._world.has_reached[0].tolist(),
            "horizon": None,
            "probability": [],
            "is_full_braking": False,
            "intervention": INTERVENTIONS[0],
            "command": None,
            "outcome": outcome,
        }

    def encounter(self, number: int) -> Encounter:
        """The record of the encounter, which is over."""
        assert self.outcome is not None
        trace = self._record.trace(0, self.outcome)
        return Encounter(
            number=number,
            opponent=self.arena.opponent,
            street=self.arena.street,
            control=self.control,
            baseline=self.arena.baseline,
            participant=self.arena.config.play.participant,
            started=self.started,
            made_by={name: version(name) for name in ("negopipe", "torch")} | {"source": source_hash()},
            commands=self.commands,
            task=self.task,
            drive=named(replace(trace, planner=self.arena.opponent, setting=self.arena.street)),
            config=as_mapping(self.arena.config),
        )
