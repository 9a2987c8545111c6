"""A live encounter: the world of one person and one opponent, stepped command by command."""

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import torch
from torch import Tensor

from negopipe.agents.driver import Driver
from negopipe.config.root import as_mapping
from negopipe.envs.episode_record import EpisodeRecord
from negopipe.errors import UserError, abbreviate
from negopipe.evaluation.encounter import CONTROLS, Encounter, horizon_text, is_command, named, person
from negopipe.evaluation.episodes import decide
from negopipe.game.reward import reward
from negopipe.play.arena import Arena, Chooser
from negopipe.play.scenery import DIGITS
from negopipe.runtime.identity import source_hash
from negopipe.safety.layer import INTERVENTIONS
from negopipe.simulation.state import EGO, NEAREST, World
from negopipe.tensors.torch_settings import own_settings

Frame = dict[str, Any]
"""What the page draws of one instant, as JSON values; `LiveEncounter.frames` says what is in it."""


class LiveEncounter:
    """One encounter from its task to its end.

    frames: one per state, the first before any decision. step: decisions until then; time_s; vehicles: x, y (m), yaw
        (rad), speed (m/s) of each in the world, the ego first, the person second; horizon: of the ego's last plan, as
        text, or null; probability: of each horizon at that decision, or []; plan: places x, y (m) of the ego's last
        plan, one per control step from this state on, or [] where there is none or a second person drives;
        is_full_braking, intervention: of the ego; command: of the person; outcome: of the encounter where it is over,
        else null
    """

    def __init__(self, arena: Arena, control: str, seed: int) -> None:
        if control not in CONTROLS:
            raise UserError(f"control must be one of {', '.join(CONTROLS)}, got {abbreviate(control)}")
        self.arena, self.control = arena, control
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self.commands: list[str] = []
        self.opponent_commands: list[str] | None = [] if arena.has_second_person else None
        with own_settings():
            self.task = arena.task(seed)
            self._world = arena.game.simulator.reset(self.task)
            self._record = EpisodeRecord(arena.game, 1)
            self._record.start(arena.game, self._world, torch.zeros(1, dtype=torch.int64).numpy())
            self._chooser: Chooser | None = None
            if self.opponent_commands is not None:
                ego: Driver = self._person(self.opponent_commands)
            else:
                ego, self._chooser = arena.ego(self.task)
        self._seats = {EGO: ego, NEAREST: self._person(self.commands)}
        self.frames = [self._frame(None)]

    def _person(self, commands: list[str]) -> Driver:
        """Driver by the latest of the commands."""

        def latest() -> Iterator[str]:
            while True:
                yield commands[-1]

        return person(self.arena.game, self.arena.config.play.pedals, self.control, latest())

    @property
    def outcome(self) -> str | None:
        """Outcome of the encounter; None while it goes on."""
        return self.frames[-1]["outcome"]

    @own_settings()
    def step(self, command: Any, opponent_command: Any = None) -> Frame:
        """The state one control step later; UserError for what is no command, or where the encounter is over.

        opponent_command: of the second person; None where there is none
        """
        self._take(command, opponent_command)
        game, before = self.arena.game, self._world
        self._world, events, motion, intervention = decide(game, self._seats, before)
        paid = reward(self.arena.config.evaluation.reward, events.is_collision, events.is_success)
        self._record.add(game, self._world, motion, {"intervention": intervention.numpy(), "reward": paid.numpy()})
        is_over = bool((events.is_terminated | events.is_truncated)[0])
        outcome = self._record.outcome(game, self._world, events, 0) if is_over else None
        horizon_s = float(motion.horizon[0, EGO])
        decision = {
            "horizon": None if math.isnan(horizon_s) else horizon_text(horizon_s),
            "probability": [] if self._chooser is None else self._chooser.probability,
            "plan": self._plan(before, horizon_s) if self._follows_plan(horizon_s, intervention) else [],
            "is_full_braking": bool(motion.is_full_braking[0, EGO]),
            "intervention": INTERVENTIONS[int(intervention[0])],
            "command": command,
        }
        self.frames.append(self._frame(outcome) | decision)
        return self.frames[-1]

    def _take(self, command: Any, opponent_command: Any) -> None:
        """Keep the commands of a decision."""
        given = [("command", command, self.commands)]
        if self.opponent_commands is not None:
            given.append(("opponent_command", opponent_command, self.opponent_commands))
        elif opponent_command is not None:
            raise UserError(
                f"opponent_command must be null without a second person, got {abbreviate(opponent_command)}"
            )
        for name, value, _ in given:
            if not is_command(value, self.control, self.arena.horizons_s):
                raise UserError(f"{name} must be one of those of the control {self.control}, got {abbreviate(value)}")
        if self.outcome is not None:
            raise UserError(f"step must be asked for before the encounter is over, got {len(self.commands)}")
        for _, value, kept in given:
            kept.append(value)

    def _follows_plan(self, horizon_s: float, intervention: Tensor) -> bool:
        """Whether the page may show a plan that is driven; two people before one page shall see the same."""
        return self.opponent_commands is None and not math.isnan(horizon_s) and not intervention.any()

    def _plan(self, world: World, horizon_s: float) -> list[list[float]]:
        """Places of the ego's plan from a state on, in the world (m)."""
        game = self.arena.game
        states, _ = game.planner.trajectory(game.perceive(world).of(EGO), torch.tensor([[horizon_s]]))
        return states.position[0, 0].double().round(decimals=DIGITS).tolist()

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
            "plan": [],
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
            opponent_commands=self.opponent_commands,
            task=self.task,
            drive=named(replace(trace, planner=self.arena.opponent, setting=self.arena.street)),
            config=as_mapping(self.arena.config),
        )
