"""Tasks: which vehicles start where, how fast, and in which driving style."""

from dataclasses import replace
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

from negopipe.errors import UserError
from negopipe.schema import Interval, NonNegativeFloat, PositiveFloat, PositiveInt, schema
from negopipe.simulation.road import RoadConfig
from negopipe.simulation.state import EGO, Task


@schema
class VehicleConfig:
    """Footprint of every vehicle, m."""

    length_m: PositiveFloat
    width_m: PositiveFloat


Styles = Annotated[list[NonNegativeFloat], Field(min_length=1)]
"""Prediction horizons of a social vehicle's planner, s."""


@schema
class StyleSwitchConfig:
    """When a social vehicle changes its style, once per episode; of two causes the first to come counts.

    style_horizon_s: the styles switched to, each equally likely (the one it had may come again)
    at_s: uniform interval of the time in the episode; null = not by the clock
    stuck_s: uniform interval of the time at rest without a break (`World.rest_steps`); null = not for being stuck
    """

    style_horizon_s: Styles
    at_s: Interval | None
    stuck_s: Interval | None

    @model_validator(mode="after")
    def _has_a_cause(self) -> "StyleSwitchConfig":
        if self.at_s is None and self.stuck_s is None:
            raise ValueError("must have an interval for at_s or stuck_s, both are null")
        return self


@schema
class FamilyConfig:
    """A family of tasks: the social vehicle's start distances and styles.

    weight: share of the family among the tasks drawn, relative to the other families
    start_distance_m: uniform interval, of the first social vehicle to its mouth of the corridor
    style_horizon_s: styles of the social vehicles, each equally likely
    style_switch: null = a vehicle keeps its style
    """

    weight: PositiveFloat
    start_distance_m: Interval
    style_horizon_s: Styles
    style_switch: StyleSwitchConfig | None


Families = dict[str, FamilyConfig]


@schema
class ScenarioConfig:
    """One scenario; `conf/scenario/narrow_lane.yaml` says what each value means."""

    dt_s: PositiveFloat
    episode_steps: PositiveInt
    n_social: PositiveInt
    social_spacing_m: PositiveFloat
    road: RoadConfig
    vehicle: VehicleConfig
    ego_start_distance_m: Interval
    start_speed_mps: Interval
    desired_speed_mps: Interval
    pairing: Literal["ego_behaviour", "literal"]
    families: Annotated[Families, Field(min_length=1)]


def pair_styles(families: Families, pairing: str) -> Families:
    """Settle whose behaviour `push` and `yield` name (Reading: start positions).

    `ego_behaviour` leaves the families as configured; `literal` reads the paper's labels as the style of the
    social vehicle, which swaps the styles of the two families and their switches. Other families are not touched.
    """
    if pairing == "ego_behaviour" or not {"push", "yield"} <= families.keys():
        return families
    push, yield_ = families["push"], families["yield"]
    swapped = {
        "push": replace(push, style_horizon_s=yield_.style_horizon_s, style_switch=yield_.style_switch),
        "yield": replace(yield_, style_horizon_s=push.style_horizon_s, style_switch=push.style_switch),
    }
    return {**families, **swapped}


class TaskSampler:
    """Draws tasks from a mixture of families with a generator of its own.

    Every draw takes the same number of random values whatever it draws, so a sampler's stream can be compared
    between configurations.
    """

    def __init__(self, scenario: ScenarioConfig, families: Families, generator: torch.Generator) -> None:
        if not families:
            raise UserError("families must name at least one task family, got none")
        self.scenario = scenario
        self.families = pair_styles(families, scenario.pairing)
        self.generator = generator

    def draw(self, n: int) -> Task:
        """`n` tasks, on the generator's device."""
        scenario, families = self.scenario, list(self.families.values())
        switches = [family.style_switch for family in families]
        n_vehicles = 1 + scenario.n_social
        weights = torch.tensor([family.weight for family in families], device=self.generator.device)
        family = torch.multinomial(weights, n, replacement=True, generator=self.generator)
        low, high = torch.tensor([f.start_distance_m for f in families], device=family.device)[family].T
        first = low + (high - low) * self._uniform(n)
        behind = torch.arange(scenario.n_social, device=family.device) * scenario.social_spacing_m
        ego = self._between(scenario.ego_start_distance_m, n, 1)
        direction = -torch.ones(n, n_vehicles, device=family.device)
        direction[:, EGO] = 1
        return Task(
            start_distance=torch.cat([ego, first[:, None] + behind], dim=1),
            start_speed=self._between(scenario.start_speed_mps, n, n_vehicles),
            desired_speed=self._between(scenario.desired_speed_mps, n, n_vehicles),
            style_horizon=self._styles(family, [f.style_horizon_s for f in families]),
            next_style_horizon=self._styles(family, [s.style_horizon_s if s else [torch.nan] for s in switches]),
            switch_time=self._times(family, [s.at_s if s else None for s in switches]),
            patience=self._times(family, [s.stuck_s if s else None for s in switches]),
            direction=direction,
            noise_seed=torch.randint(2**31, (n,), generator=self.generator, device=family.device),
            family=family,
        )

    def _styles(self, family: Tensor, styles_s: list[list[float]]) -> Tensor:
        """[n, V] float32, s: one of its family's styles per social vehicle, NaN for the ego."""
        n = family.shape[0]
        chance = self._uniform(n, self.scenario.n_social)
        style = torch.full((n, 1 + self.scenario.n_social), torch.nan, device=family.device)
        for index, values in enumerate(styles_s):
            styles = torch.tensor(values, device=family.device)
            choice = styles[(chance * len(styles)).long().clamp(max=len(styles) - 1)]
            style[:, EGO + 1 :] = torch.where((family == index)[:, None], choice, style[:, EGO + 1 :])
        return style

    def _times(self, family: Tensor, intervals: list[tuple[float, float] | None]) -> Tensor:
        """[n, V] float32, s: a time per social vehicle from its family's interval, inf for none and for the ego."""
        n = family.shape[0]
        chance = self._uniform(n, self.scenario.n_social)
        low, high = torch.tensor([interval or (torch.inf, 0.0) for interval in intervals], device=family.device).T
        time = torch.full((n, 1 + self.scenario.n_social), torch.inf, device=family.device)
        drawn = low[family, None] + (high - low)[family, None] * chance
        time[:, EGO + 1 :] = torch.where(low[family, None] < torch.inf, drawn, torch.inf)
        return time

    def _between(self, interval: tuple[float, float], *shape: int) -> Tensor:
        low, high = interval
        return low + (high - low) * self._uniform(*shape)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.generator.device)
