"""RunConfig: the root schema. What Hydra composes from `conf/` becomes one typed, checked, frozen object."""

import hashlib
import json
from collections.abc import Iterable
from typing import Annotated, Any, Literal, get_args

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import Field, TypeAdapter, ValidationError

from negopipe.config_errors import explain_composition, explain_validation
from negopipe.errors import UserError
from negopipe.evaluation.behaviour_map import BehaviourMapConfig
from negopipe.evaluation.episodes import EvaluationConfig
from negopipe.evaluation.oracle import OracleConfig
from negopipe.evaluation.planners import fixed_name
from negopipe.evaluation.speed import BenchmarkConfig
from negopipe.learning.acktr import AcktrConfig
from negopipe.learning.curriculum import CurriculumConfig
from negopipe.observation.occupancy_grid import ObservationConfig
from negopipe.planner.frenet import PlannerConfig
from negopipe.policy.actor_critic import PolicyConfig
from negopipe.report.page import ReportConfig
from negopipe.reward import RewardConfig
from negopipe.schema import NonNegativeInt, PositiveInt, schema
from negopipe.simulation.dynamics import BicycleConfig, DynamicsConfig
from negopipe.simulation.perception import PerceptionConfig
from negopipe.simulation.scenario import Families, ScenarioConfig
from negopipe.tracking.store import TrackingConfig

Stage = Literal["train", "evaluate", "report", "behaviour_map", "oracle", "benchmark"]
FolderName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]

RESULT_NEUTRAL = {"name", "seed", "outputs", "stages", "rerun", "reuse", "n_threads", "report", "tracking"}
"""Keys that `run_name` leaves out of its hash: where a run is kept, which part of it runs now, how its
results are shown. `n_threads` is among them because threads change rounding at most; `device` and `compile`
are not: they draw and round differently. The seed stands beside the hash, so a config's seeds share it."""


@schema
class RunConfig:
    """Everything a run depends on; `conf/config.yaml` says what each value means."""

    name: FolderName
    seed: NonNegativeInt
    outputs: Annotated[str, Field(min_length=1)]
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)]
    checkpoint: str | None
    rerun: bool
    reuse: Literal["same_code", "any_code"]
    device: Literal["auto", "cpu", "cuda"]
    n_threads: PositiveInt | Literal["auto"]
    compile: Literal["auto", "on", "off"]
    scenario: ScenarioConfig
    perception: PerceptionConfig
    dynamics: DynamicsConfig
    planner: PlannerConfig
    observation: ObservationConfig
    reward: RewardConfig
    policy: PolicyConfig
    algorithm: AcktrConfig
    curriculum: CurriculumConfig
    evaluation: EvaluationConfig
    behaviour_map: BehaviourMapConfig
    oracle: OracleConfig
    report: ReportConfig
    tracking: TrackingConfig
    benchmark: BenchmarkConfig

    @property
    def evaluated_families(self) -> Families:
        """The scenario's families that `evaluation.settings` names."""
        return {name: self.scenario.families[name] for name in self.evaluation.settings}


def load(composed: DictConfig) -> RunConfig:
    """Check what Hydra composed and freeze it; UserError names every key that is wrong, in one line.

    Types are strict: a text is no number and `true` is no 1.
    """
    try:
        values = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise UserError(explain_composition(error)) from error
    try:
        config = TypeAdapter(RunConfig).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise UserError(explain_validation(error, RunConfig)) from error
    check_components(config)
    return config


def as_mapping(config: RunConfig) -> dict[str, Any]:
    """The config as plain mappings, lists and scalars, as `load` read it."""
    return TypeAdapter(RunConfig).dump_python(config, mode="json")


def run_name(config: RunConfig) -> str:
    """Name of the run folder, `seed<seed>-<8 hex>`: the same for everything that gives the same result."""
    idle = set(get_args(Stage)) - set(config.stages)  # the group of a stage acts only where the stage runs
    relevant = {key: value for key, value in as_mapping(config).items() if key not in RESULT_NEUTRAL | idle}
    canonical = json.dumps(relevant, sort_keys=True, separators=(",", ":"))
    return f"seed{config.seed}-{hashlib.sha256(canonical.encode()).hexdigest()[:8]}"


def check_components(config: RunConfig) -> None:
    """Conditions that no component can check alone; UserError names the first that does not hold."""
    _check_horizons(config)
    _check_times(config)
    _check_grids(config)
    _check_evaluation(config)
    _check_oracle(config)


def _check_horizons(config: RunConfig) -> None:
    """Nobody predicts farther than plans reach: a longer horizon would act like H_plan under another name."""
    horizons = {"policy.horizons_s": config.policy.horizons_s}
    horizons["evaluation.fixed_horizons_s"] = tuple(config.evaluation.fixed_horizons_s)
    places = {"scenario": config.scenario.families}
    places |= {f"curriculum.stages.{i}": stage.families for i, stage in enumerate(config.curriculum.stages)}
    for place, families in places.items():
        for name, family in families.items():
            key = f"{place}.families.{name}"
            horizons[f"{key}.style_horizon_s"] = tuple(family.style_horizon_s)
            if family.style_switch is not None:
                horizons[f"{key}.style_switch.style_horizon_s"] = tuple(family.style_switch.style_horizon_s)
    if "behaviour_map" in config.stages:
        horizons["behaviour_map.horizons_s"] = tuple(config.behaviour_map.horizons_s)
        horizons["behaviour_map.styles_s"] = tuple(config.behaviour_map.styles_s)
    planned = config.planner.horizon_s
    for key, values in horizons.items():
        if max(values, default=0.0) > planned:
            raise UserError(f"{key} must be at most planner.horizon_s = {planned}, got {max(values)}")


def _check_times(config: RunConfig) -> None:
    """What is remembered or passed on at control steps happens at control steps."""
    dt = config.scenario.dt_s
    times = {
        "observation.frame_interval_s": config.observation.frame_interval_s,
        "perception.accel_window_s": config.perception.accel_window_s,
        "perception.delay_s": config.perception.delay_s,
    }
    if isinstance(config.dynamics, BicycleConfig):
        times["dynamics.actuation_delay_s"] = config.dynamics.actuation_delay_s
    for key, time in times.items():
        n_steps = round(time / dt)
        if abs(time - n_steps * dt) > 1e-6 or (n_steps == 0 and time > 0):
            raise UserError(f"{key} must be a multiple of scenario.dt_s = {dt}, got {time}")


def _check_grids(config: RunConfig) -> None:
    """The convolutions leave something of the grid."""
    side = config.observation.n_cells
    for index, conv in enumerate(config.policy.conv):
        if conv.kernel > side:
            limit = f"{side}, what is left there of observation.n_cells = {config.observation.n_cells}"
            raise UserError(f"policy.conv.{index}.kernel must be at most {limit}, got {conv.kernel}")
        side = (side - conv.kernel) // conv.stride + 1


def _check_evaluation(config: RunConfig) -> None:
    """What is evaluated, opened with and shown exists."""
    settings = config.evaluation.settings
    planners = [fixed_name(horizon) for horizon in config.evaluation.fixed_horizons_s]
    _require("evaluation.settings", settings, among=config.scenario.families)
    _require("evaluation.leading_setting", [config.evaluation.leading_setting], among=settings)
    if "report" in config.stages:
        _require("report.side_by_side", config.report.side_by_side, among=planners)


def _check_oracle(config: RunConfig) -> None:
    """The oracle's tasks are among the evaluated ones, and it may give up on what takes too long."""
    if "oracle" not in config.stages:
        return
    _require("oracle.settings", config.oracle.settings, among=config.scenario.families)
    limit, paid = config.evaluation.n_episodes, config.evaluation.reward
    if config.oracle.n_episodes > limit:
        raise UserError(
            f"oracle.n_episodes must be at most evaluation.n_episodes = {limit}, got {config.oracle.n_episodes}"
        )
    if paid.step > 0 or paid.collision > 0 or paid.success < 0:
        raise UserError(
            "evaluation.reward must have step <= 0, collision <= 0 and success >= 0 for the stage oracle, got "
            f"{paid.step}, {paid.collision}, {paid.success}"
        )


def _require(key: str, values: Iterable[str], among: Iterable[str]) -> None:
    allowed = list(among)
    for value in values:
        if value not in allowed:
            raise UserError(f"{key} must be among {', '.join(allowed) or 'none'}, got {value}")
