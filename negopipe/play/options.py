"""Options of the page on which a person drives."""

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from negopipe.agents.person import PedalsConfig
from negopipe.checks import Problem, check_names
from negopipe.planner.config import LimitConfig
from negopipe.schema import FileName, Label, schema
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.starts import check_starts


@schema
class StreetChoice:
    """A street that can be chosen; overrides: of the config, in which it may change the scenario."""

    label: Label
    overrides: tuple[str, ...]


@schema
class OpponentChoice:
    """An opponent that can be chosen.

    baseline: its driver in `evaluation.baselines`; None = the policy, `negopipe.agents.person.PERSON` = a second person
    """

    label: Label
    overrides: tuple[str, ...]
    baseline: FileName | None


@schema
class PlayConfig:
    """`conf/play/local.yaml` says what each value means."""

    port: Annotated[int, Field(ge=0, lt=2**16)]
    opens_browser: bool
    participant: Label
    setting: FileName
    pedals: PedalsConfig
    opponents: Annotated[dict[FileName, OpponentChoice], Field(min_length=1)]
    streets: Annotated[dict[FileName, StreetChoice], Field(min_length=1)]

    def check(self, scenario: ScenarioConfig, limits: LimitConfig) -> Iterator[Problem]:
        """limits: of the planner."""
        yield from check_names("play.setting", [self.setting], scenario.families, "scenario.families")
        yield from self.pedals.check("play.pedals", limits)
        if self.setting in scenario.families:
            families = {f"scenario.families.{self.setting}": scenario.families[self.setting]}
            yield from check_starts(scenario, families, "scenario.ego_start_distance_m")
