"""The safety layer: a plan of the ego is driven only if, one step later, the ego can still come to rest safely.

A plan is a step and the stop that could follow it: full braking along one of a few paths. It passes if

- the step is one that the vehicle can drive (`MotionLimitConfig`),
- the stop is clear of kerbs and parked cars,
- until the ego is at rest, the stop is clear of everywhere the others could be, whatever they do within their limits
  (passive safety: Macek 2009; reachable sets: Althoff & Dolan 2014), and
- the ego comes to rest where an oncoming vehicle that responds late and then brakes can stop before it (RSS for
  vehicles in opposite directions: Shalev-Shwartz 2017).

The path of a plan that passed is kept: it is there for the next decision, whose plan may not pass (fail-safe planning:
Pek & Althoff 2018). The last plan is followed on it at the speed or with the deceleration that it had. The layer knows
nothing of the policy, nor how the planner chose.

Axes here: E worlds, C stops that are compared, N = E egos. N is the last axis within a check.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.lateral import LateralCandidates
from negopipe.planner.roadside import Roadside
from negopipe.planner.situation import Situation
from negopipe.safety.config import RssConfig
from negopipe.safety.limits import is_drivable, is_finite
from negopipe.safety.reach import Reach
from negopipe.safety.stops import N_PATH, StopPaths, braked, sweep
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import Motion
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.tree import map_tensors, tree_where

INTERVENTIONS = ("none", "last_plan", "planned_stop", "full_braking")
"""What is driven, by its number: the plan; else the last plan that passed, a stop for the street, or full braking."""

N_KEPT = N_PATH + 1
"""Numbers that are kept for the next decision: a path, and the control steps since a plan passed."""

LEAST_MPS2 = 1e-3
"""Deceleration of an ego that keeps its speed, m/s2."""

N_SPANS = 4
"""J, spans of time in which a stop is compared with the others."""

OUT_M = -1e3
"""Margin of a stop that cannot be driven, m."""


class Guarded(NamedTuple):
    """Result of the layer for E egos.

    motion: Motion [E, 1] to drive
    kept: [E, N_KEPT] float32, path on which a stop may follow it, and its age
    intervention: [E] int64, index into `INTERVENTIONS`
    """

    motion: Motion
    kept: Tensor
    intervention: Tensor


class SafetyLayer:
    """The layer for a road, sizes and control step; a function of tensors.

    lateral: paths on which the ego may come to rest
    roadside: kerbs and parked cars beside them
    passage: places before the narrow ones at which it waits
    """

    def __init__(self, config: RssConfig, road: Road, sizes: Sizes, dt_s: float, passage: Passage) -> None:
        self.config, self.road, self.sizes, self.dt_s, self.passage = config, road, sizes, dt_s, passage
        device = road.device
        self.lateral = LateralCandidates(config.stops, self.road, device)
        self.roadside = Roadside(self.road, self.sizes, torch.full((N_SPANS + 1,), config.parked_m, device=device))
        self._reach = Reach(config, self.road, self.dt_s)

    @staticmethod
    def of(config: RssConfig, simulator: Simulator) -> "SafetyLayer":
        passage = Passage.of(simulator.collisions, simulator.sizes)
        return SafetyLayer(config, simulator.road, simulator.sizes, simulator.scenario.dt_s, passage)

    def guard(self, perception: Perception, motion: Motion, kept: Tensor) -> Guarded:
        """What the ego drives instead of `motion` [E, 1], which is itself where it passes.

        perception: of the egos, S = 1
        kept: of the decision before; NaN in the first of an episode
        """
        now = Situation.of(self.road, self.sizes, perception, torch.zeros_like(perception.direction))
        state = map_tensors(lambda field: field[:, 0], motion.state)
        own = map_tensors(lambda field: field[:, 0], perception.own)
        is_sound = is_finite(state) & is_drivable(self.config.limits, own, state, self.dt_s)
        after = self.road.to_route(tree_where(is_finite(state), state, own), now.direction)
        path, age = kept.split([N_PATH, 1], -1)
        starts, paths = self._candidates(now, own.accel, after, path)
        margin = self.check(now, starts, paths)
        has_last = (age[:, 0] + 1) * self.dt_s <= self.config.hold_s + self.dt_s / 2  # false for NaN
        chosen, intervention = self._choose(margin, is_sound & self._stands(now, after), is_sound, has_last)
        column = chosen[None]
        start = RouteState(*(field.gather(0, column)[0] for field in starts))
        braking = self.road.to_world(start, now.direction)
        is_replaced = intervention > 0
        driven = map_tensors(lambda field: field[:, None], tree_where(is_replaced, braking, state))
        no_plan = motion.is_full_braking | (intervention == INTERVENTIONS.index("full_braking"))[:, None]
        packed = paths.pack()
        kept = packed.gather(0, column[..., None].expand(-1, -1, packed.shape[-1]))[0]
        kept = torch.cat([kept, torch.where(is_replaced[:, None], age + 1, 0.0)], -1)
        return Guarded(replace(motion, state=driven, is_full_braking=no_plan), kept, intervention)

    def check(self, now: Situation, starts: RouteState, paths: StopPaths) -> Tensor:
        """[C, N] m: margins of full braking along `paths` from states `starts` [C, N], one control step after `now`.

        It is positive where the stop is clear of everything.
        """
        limits = self.config.limits
        swept = sweep(self.road, now.direction, starts, paths, limits.decel_max_mps2, N_SPANS)
        beside = -self.roadside.excess(swept.s, now.direction, swept.d, swept.d_prime, now.size).amax(1)
        margin = torch.minimum(beside, self._reach.margin(now, swept))
        return torch.where(swept.curvature.abs().amax(1) <= limits.curvature_max_1pm, margin, OUT_M)

    def _candidates(
        self, now: Situation, accel: Tensor, after: RouteState, kept: Tensor
    ) -> tuple[RouteState, StopPaths]:
        """Starts [C, N], one step from now, and paths of the stops: L after the plan's step, then 1 + L after a step of
        gentle braking and 1 + L after one of full braking.

        The first of the 1 + L is on the path of the last plan; without one it is a copy of the first fresh path. The
        gentle step there is that of the last plan: its deceleration is held.

        accel: [N] m/s2, of the ego along its path
        """
        planned, fresh = (StopPaths.fresh(self.lateral, each, now.direction) for each in (after, now.route))
        last = StopPaths.unpack(torch.where(kept.isnan(), fresh.pack()[0], kept))
        stops = last.joined(fresh)
        shape = stops.start_s.shape
        held = (-accel).clamp(LEAST_MPS2, self.config.comfortable_mps2)
        gentle = torch.cat([held[None], self._gentle(now).expand(self.lateral.n_candidates, -1)])
        full = now.route.s.new_full(shape, self.config.limits.decel_max_mps2)
        steps = [braked(self.road, now.direction, now.route, stops, decel, self.dt_s) for decel in (gentle, full)]
        expanded = RouteState(*(field.expand(self.lateral.n_candidates, -1) for field in after))
        starts = RouteState(*(torch.cat(fields) for fields in zip(expanded, *steps, strict=True)))
        return starts, planned.joined(stops, stops)

    def _gentle(self, now: Situation) -> Tensor:
        """[N] m/s2: deceleration of a stop at the waiting place ahead, the comfortable one where that is not enough."""
        left = self.passage.waiting_s(now.route.s, now.direction, now.size.length) - now.route.s
        wanted = now.route.s_dot**2 / (2 * left.clamp(min=0.1))
        comfortable = self.config.comfortable_mps2
        return torch.where((left > 0) & (wanted < comfortable), wanted, comfortable).clamp(min=0.1)

    def _choose(self, margin: Tensor, stands: Tensor, is_sound: Tensor, has_last: Tensor) -> tuple[Tensor, Tensor]:
        """Index of the stop [N] in the margins [C, N], and the intervention [N]."""
        n = self.lateral.n_candidates
        of_plan, gentle, full = margin[:n], margin[n : 2 * n + 1], margin[2 * n + 1 :]
        passes = (is_sound & (of_plan.amax(0) > 0)) | stands
        last, planned = has_last & (gentle[0] > 0), gentle[1:].amax(0) > 0
        braking = full.argmax(0) + 2 * n + 1
        chosen = torch.where(planned, gentle[1:].argmax(0) + n + 1, braking)
        chosen = torch.where(last, n, chosen)
        intervention = torch.where(last, 1, torch.where(planned, 2, 3))
        return torch.where(passes, of_plan.argmax(0), chosen), torch.where(passes, 0, intervention)

    def _stands(self, now: Situation, after: RouteState) -> Tensor:
        """[N] bool: the ego is at rest and stays so. Nobody need run into it."""
        return (now.route.s_dot == 0) & (after.s_dot == 0)


def nothing_kept(n_worlds: int, device: torch.device | str) -> Tensor:
    """[E, N_KEPT]: the path that is kept at the start of an episode, none."""
    return torch.full((n_worlds, N_KEPT), torch.nan, device=device)
