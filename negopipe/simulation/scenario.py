"""Tasks: which vehicles start where, how fast, and in which driving style."""

from typing import Annotated, Literal

import torch
from pydantic import Field
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


@schema
class FamilyConfig:
    """A family of tasks: the social vehicle's start distances and styles.

    weight: share of the family among the tasks drawn, relative to the other families
    start_distance_m: uniform interval, of the first social vehicle to its mouth of the corridor
    style_horizon_s: prediction horizons of the social vehicles' planner, each equally likely
    """

    weight: PositiveFloat
    start_distance_m: Interval
    style_horizon_s: Annotated[list[NonNegativeFloat], Field(min_length=1)]


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
    social vehicle, which swaps the styles of the two families. Other families are not touched.
    """
    if pairing == "ego_behaviour" or not {"push", "yield"} <= families.keys():
        return families
    push, yield_ = families["push"], families["yield"]
    swapped = {
        "push": FamilyConfig(push.weight, push.start_distance_m, yield_.style_horizon_s),
        "yield": FamilyConfig(yield_.weight, yield_.start_distance_m, push.style_horizon_s),
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
            style_horizon=self._styles(family, families),
            direction=direction,
            family=family,
        )

    def _styles(self, family: Tensor, families: list[FamilyConfig]) -> Tensor:
        """[n, V] float32, s: a style per social vehicle, NaN for the ego."""
        n = family.shape[0]
        chance = self._uniform(n, self.scenario.n_social)
        style = torch.full((n, 1 + self.scenario.n_social), torch.nan, device=family.device)
        for index, config in enumerate(families):
            styles = torch.tensor(config.style_horizon_s, device=family.device)
            choice = styles[(chance * len(styles)).long().clamp(max=len(styles) - 1)]
            style[:, EGO + 1 :] = torch.where((family == index)[:, None], choice, style[:, EGO + 1 :])
        return style

    def _between(self, interval: tuple[float, float], *shape: int) -> Tensor:
        low, high = interval
        return low + (high - low) * self._uniform(*shape)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.generator.device)
