"""RunConfig: the root schema. What Hydra composes from `conf/` becomes one typed, checked, frozen object."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, get_args

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import Field, TypeAdapter, ValidationError

from negopipe.benchmark.speed import BenchmarkConfig
from negopipe.config.capacity import check_sizes, grid_sides
from negopipe.config.messages import explain_composition, explain_validation, misread
from negopipe.config.renamed import renamings
from negopipe.errors import UserError, abbreviate
from negopipe.evaluation.behaviour_map import BehaviourMapConfig
from negopipe.evaluation.episodes import EvaluationConfig
from negopipe.evaluation.trace import ADAPTIVE, ORACLE
from negopipe.game.curriculum import CurriculumConfig
from negopipe.game.reward import RewardConfig
from negopipe.learning.learner import AlgorithmConfig
from negopipe.observation.occupancy_grid import ObservationConfig
from negopipe.planner.frenet import PlannerConfig
from negopipe.policy.actor_critic import PolicyConfig
from negopipe.report.page import ReportConfig
from negopipe.schema import Distinct, FileName, PathText, PositiveInt, Seed, schema
from negopipe.search.oracle import OracleConfig
from negopipe.simulation.dynamics import BicycleConfig, DynamicsConfig
from negopipe.simulation.perception import PerceptionConfig
from negopipe.simulation.scenario import Families, ScenarioConfig
from negopipe.simulation.starts import check_starts
from negopipe.tracking.store import TrackingConfig

Stage = Literal["train", "evaluate", "report", "replay", "behaviour_map", "oracle", "benchmark"]

EpisodeText = Annotated[str, Field(pattern=r"^[^/]+/[^/]+/\d{1,9}$")]
"""<setting>/<planner>/<number>, columns of episodes.csv."""

N_STEPS = 1000
"""Of a plan, a delay or between two frames, at most: all are held in memory."""

WHOLE = 1e-6
"""Of control steps a time is a whole number, but for what floats round."""

LONGEST_EPISODE_S = 3600.0
"""Animations show episodes in real time, frame by frame."""


RESULT_NEUTRAL = {
    "name", "objective", "seed", "outputs", "stages", "rerun", "reuse", "n_threads", "report", "episode", "tracking",
}  # fmt: skip
"""Keys that `run_name` leaves out of its hash: where a run is kept, which part of it runs now, how its
results are shown. `n_threads` is among them because threads change rounding at most; `device` and `compile`
are not: they draw and round differently. The seed stands beside the hash, so a config's seeds share it."""


@schema
class RunConfig:
    """Everything a run depends on; `conf/config.yaml` says what each value means."""

    name: FileName
    seed: Seed
    outputs: PathText
    stages: Annotated[tuple[Stage, ...], Field(min_length=1), Distinct]
    objective: Annotated[tuple[str, ...], Field(min_length=1), Distinct]
    checkpoint: PathText | None
    episode: EpisodeText | None
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
    algorithm: AlgorithmConfig
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


def load(composed: DictConfig, typed: Sequence[str] = ()) -> RunConfig:
    """Check what Hydra composed and freeze it; UserError names every key that is wrong, in one line.

    Types are strict: a text is no number and `true` is no 1.
    typed: the overrides that it was composed with, for errors that tell how to write them
    """
    try:
        values = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        if problem := misread(values):
            raise UserError(problem)
        if old_names := renamings(values):
            raise UserError("; ".join(old_names))
        config = TypeAdapter(RunConfig).validate_json(json.dumps(values), strict=True)
    except OmegaConfBaseException as error:
        raise UserError(explain_composition(error)) from error
    except ValidationError as error:
        raise UserError(explain_validation(error, RunConfig, typed)) from error
    check_components(config)
    return config


def as_mapping(config: RunConfig) -> dict[str, Any]:
    """The config as plain mappings, lists and scalars, as `load` read it."""
    return TypeAdapter(RunConfig).dump_python(config, mode="json")


def run_name(config: RunConfig) -> str:
    """Name of the run folder, `seed<seed>-<8 hex>`: the same for everything that gives the same result.

    The group of a stage counts where that stage runs alone; among others it adds to a run, whose folder it leaves.
    """
    alone = set(config.stages) if len(config.stages) == 1 else set()
    others = set(get_args(Stage)) - alone
    relevant = {key: value for key, value in as_mapping(config).items() if key not in RESULT_NEUTRAL | others}
    canonical = json.dumps(relevant, sort_keys=True, separators=(",", ":"))
    return f"seed{config.seed}-{hashlib.sha256(canonical.encode()).hexdigest()[:8]}"


def check_components(config: RunConfig) -> None:
    """Conditions that no component can check alone; UserError names the first that does not hold."""
    _check_horizons(config)
    _check_times(config)
    _check_grids(config)
    check_sizes(config)
    _check_evaluation(config)
    _check_oracle(config)
    _check_starts(config)


def _check_horizons(config: RunConfig) -> None:
    """Nobody predicts farther than plans reach: a longer horizon would act like H_plan under another name."""
    planned = config.planner.horizon_s
    for key, values in _horizons(config).items():
        if max(values, default=0.0) > planned:
            raise UserError(f"{key} must be at most planner.horizon_s = {planned}, got {max(values)}")


def _horizons(config: RunConfig) -> dict[str, tuple[float, ...]]:
    """Prediction horizons of all that drives, s, by key."""
    horizons = {"policy.horizons_s": config.policy.horizons_s}
    for name, baseline in config.evaluation.baselines.items():
        used = baseline.prediction_horizons_s
        horizons |= {f"evaluation.baselines.{name}.{key}": values for key, values in used.items()}
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
    return horizons


def _check_times(config: RunConfig) -> None:
    """What is predicted, remembered or passed on at control steps ends at one: else it would act like another time."""
    dt, planned = config.scenario.dt_s, config.planner.horizon_s
    if not dt <= planned <= N_STEPS * dt:
        allowed = f"between scenario.dt_s = {dt} and {N_STEPS} times as much"
        raise UserError(f"planner.horizon_s must be {allowed}, got {planned}")
    n_steps = config.scenario.episode_steps
    if n_steps * dt > LONGEST_EPISODE_S:
        allowed = f"{LONGEST_EPISODE_S:g} s / scenario.dt_s = {LONGEST_EPISODE_S / dt:g}"
        raise UserError(f"scenario.episode_steps must be at most {allowed}, got {n_steps}")
    remembered = {
        "observation.frame_interval_s": config.observation.frame_interval_s,
        "perception.accel_window_s": config.perception.accel_window_s,
        "perception.delay_s": config.perception.delay_s,
    }
    if isinstance(config.dynamics, BicycleConfig):
        remembered["dynamics.actuation_delay_s"] = config.dynamics.actuation_delay_s
    for key, time in remembered.items():
        if time > (N_STEPS + 0.5) * dt:
            raise UserError(f"{key} must be at most {N_STEPS} times scenario.dt_s = {dt}, got {time}")
    times = {key: (time,) for key, time in {"planner.horizon_s": planned, **remembered}.items()}
    for name, baseline in config.evaluation.baselines.items():
        times |= {f"evaluation.baselines.{name}.{key}": (time,) for key, time in baseline.times_s.items()}
    for key, values in (times | _horizons(config)).items():
        for time in values:
            n_steps = round(time / dt)
            if abs(time / dt - n_steps) > WHOLE or (n_steps == 0 and time > 0):
                raise UserError(f"{key} must be a multiple of scenario.dt_s = {dt}, got {time}")


def _check_grids(config: RunConfig) -> None:
    """The convolutions leave something of the grid."""
    sides = grid_sides(config)
    for index, (side, conv) in enumerate(zip(sides, config.policy.conv, strict=False)):
        if conv.kernel > side:
            limit = f"{side}, what is left there of observation.n_cells = {sides[0]}"
            before = f" after stride {config.policy.conv[index - 1].stride}" if index else ""
            raise UserError(f"policy.conv.{index}.kernel must be at most {limit}, got {conv.kernel}{before}")


def _check_evaluation(config: RunConfig) -> None:
    """What is evaluated, opened with and shown exists."""
    settings = config.evaluation.settings
    for name, who in {ADAPTIVE: "the policy", ORACLE: "what evaluation.oracle brings"}.items():
        if name in config.evaluation.baselines:
            raise UserError(f"evaluation.baselines must not name one {name}, which is {who}")
    _require("evaluation.settings", settings, config.scenario.families, "scenario.families")
    _require("evaluation.leading_setting", [config.evaluation.leading_setting], settings, "evaluation.settings")
    if "replay" in config.stages and config.episode is None:
        raise UserError("episode must be <setting>/<planner>/<number> for the stage replay, got null")
    if "report" in config.stages:
        _require("report.side_by_side", config.report.side_by_side, config.evaluation.baselines, "evaluation.baselines")


def _check_oracle(config: RunConfig) -> None:
    """The oracle's tasks are among the evaluated ones, and it may give up on what takes too long."""
    if "oracle" in config.stages:
        _require("oracle.settings", config.oracle.settings, config.scenario.families, "scenario.families")
        limit = config.evaluation.n_episodes
        if config.oracle.n_episodes > limit:
            raise UserError(
                f"oracle.n_episodes must be at most evaluation.n_episodes = {limit}, got {config.oracle.n_episodes}"
            )
        _check_searched("evaluation.reward", config.evaluation.reward, "the stage oracle")
    if "train" in config.stages and config.curriculum.demonstrations is not None:
        _check_searched("reward", config.reward, "curriculum.demonstrations")


def _check_starts(config: RunConfig) -> None:
    """No task that is driven is lost before it begins."""
    searched = config.oracle.settings if "oracle" in config.stages else ()
    names = {f"scenario.families.{name}": name for name in (*config.evaluation.settings, *searched)}
    driven = {key: config.scenario.families[name] for key, name in names.items()}
    check_starts(config.scenario, driven, "scenario.ego_start_distance_m")
    if "train" in config.stages:
        config.curriculum.check_starts(config.scenario)


def _check_searched(key: str, paid: RewardConfig, user: str) -> None:
    """What takes longer is paid less, which a search relies on."""
    if paid.step > 0 or paid.collision > 0 or paid.success < 0:
        raise UserError(
            f"{key} must have step <= 0, collision <= 0 and success >= 0 for {user}, got "
            f"{paid.step}, {paid.collision}, {paid.success}"
        )


def _require(key: str, values: Iterable[str], among: Iterable[str], source: str) -> None:
    """All `values` are among those that the key `source` names."""
    allowed = list(among)
    for value in values:
        if value not in allowed:
            names = abbreviate(", ".join(allowed)) or "none"
            raise UserError(f"{key} must be among {names}, got {abbreviate(value)}; {source} has no other")
