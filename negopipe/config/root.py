"""RunConfig: the root schema. Hydra's composition of `conf/` becomes one typed, checked, frozen object."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import Annotated, Any, Literal, get_args

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import Field, TypeAdapter, ValidationError

from negopipe import CONF
from negopipe.agents.population import PopulationConfig
from negopipe.benchmark.speed import BenchmarkConfig
from negopipe.checks import Foresight, Memory, Problem
from negopipe.config.messages import explain_composition, explain_validation, misread
from negopipe.config.renamed import renamings
from negopipe.deployment.options import ExportConfig
from negopipe.deployment.vehicle.options import VehicleConfig
from negopipe.errors import UserError, abbreviate
from negopipe.evaluation.behaviour_map import BehaviourMapConfig
from negopipe.evaluation.cross_play import CrossPlayConfig
from negopipe.evaluation.episodes import EvaluationConfig
from negopipe.game.curriculum import CurriculumConfig
from negopipe.game.game import CHUNKS
from negopipe.game.reward import RewardConfig
from negopipe.learning.learner import AlgorithmConfig
from negopipe.observation.kinds import ObservationConfig
from negopipe.planner.config import PlannerConfig
from negopipe.play.options import PlayConfig
from negopipe.policy.kinds import PolicyConfig, check_policy, layers_of
from negopipe.report.page import ReportConfig
from negopipe.safety.config import SafetyConfig
from negopipe.schema import FileName, PathText, PositiveInt, Seed, schema
from negopipe.search.oracle import OracleConfig
from negopipe.simulation.dynamics import DynamicsConfig
from negopipe.simulation.perception import PerceptionConfig
from negopipe.simulation.scenario import Families, ScenarioConfig
from negopipe.simulation.starts import check_starts
from negopipe.simulation.state import world_memory
from negopipe.tensors.torch_settings import one_thread
from negopipe.tracking.store import TrackingConfig

Stage = Literal[
    "preview", "train", "evaluate", "report", "replay", "behaviour_map", "cross_play", "oracle", "streets", "benchmark",
    "export",
]  # fmt: skip

EpisodeText = Annotated[str, Field(pattern=r"^[^/]+/[^/]+/\d{1,9}$")]
"""Name of an episode, `<setting>/<planner>/<number>`: three columns of episodes.csv."""

WITHOUT_POLICY = {"preview", "behaviour_map", "oracle", "streets", "benchmark"}
"""Stages that drive without the run's policy."""

RESULT_NEUTRAL = {
    "name", "objective", "seed", "outputs", "stages", "rerun", "reuse", "n_threads", "report", "episode", "encounter",
    "play", "tracking", "vehicle",
}  # fmt: skip
"""Keys that `run_name` leaves out of its hash: the place of a run, the part of it that runs now, the display of its
results. `n_threads` is among them because threads change rounding at most. `device` and `compile` are not: they draw
and round differently. The seed stands beside the hash, so a config's seeds share it."""


@schema
class RunConfig:
    """All values that a run depends on; `conf/config.yaml` explains them."""

    name: FileName
    seed: Seed
    outputs: PathText
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)]
    objective: Annotated[tuple[str, ...], Field(min_length=1)]
    checkpoint: PathText | None
    episode: EpisodeText | None
    encounter: PathText | None
    rerun: bool
    reuse: Literal["same_code", "any_code"]
    device: Literal["auto", "cpu", "cuda"]
    n_threads: PositiveInt | Literal["auto"]
    compile: Literal["auto", "on", "off"]
    scenario: ScenarioConfig
    population: PopulationConfig
    perception: PerceptionConfig
    dynamics: DynamicsConfig
    planner: PlannerConfig
    safety: SafetyConfig
    observation: ObservationConfig
    reward: RewardConfig
    policy: PolicyConfig
    algorithm: AlgorithmConfig
    curriculum: CurriculumConfig
    evaluation: EvaluationConfig
    behaviour_map: BehaviourMapConfig
    cross_play: CrossPlayConfig
    oracle: OracleConfig
    report: ReportConfig
    tracking: TrackingConfig
    benchmark: BenchmarkConfig
    export: ExportConfig
    play: PlayConfig
    vehicle: VehicleConfig

    @property
    def evaluated_families(self) -> Families:
        """The scenario's families that `evaluation.settings` names."""
        return {name: self.scenario.families[name] for name in self.evaluation.settings}


def load(composed: DictConfig, typed: Sequence[str] = ()) -> RunConfig:
    """The checked and frozen config of Hydra's composition; UserError names every wrong key in one line.

    Types are strict: a text is no number and `true` is no 1.
    typed: overrides of the command line, for error messages
    """
    try:
        values = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        if problem := misread(values):
            raise UserError(problem)
        if old_names := renamings(values):
            raise UserError("; ".join(old_names))
        _drop_weights_alone(values)
        config = TypeAdapter(RunConfig).validate_json(json.dumps(values), strict=True)
    except OmegaConfBaseException as error:
        raise UserError(explain_composition(error)) from error
    except ValidationError as error:
        raise UserError(explain_validation(error, RunConfig, typed)) from error
    check_components(config)
    return config


def _drop_weights_alone(values: Any) -> None:
    """Leave out the drivers of a population of which only a weight is left, since `population/driver` names others."""
    match values:
        case {"population": {"drivers": dict() as drivers}}:
            weights_alone = [name for name, own in drivers.items() if isinstance(own, dict) and [*own] == ["weight"]]
            for name in weights_alone:
                if (CONF / "population" / "driver" / f"{name}.yaml").is_file():
                    del drivers[name]


def as_mapping(config: RunConfig) -> dict[str, Any]:
    """The config as plain mappings, lists and scalars, as `load` read it."""
    return TypeAdapter(RunConfig).dump_python(config, mode="json")


def run_name(config: RunConfig) -> str:
    """Name of the run folder, `seed<seed>-<8 hex>`: the same for everything that gives the same result.

    The config group of a stage counts only where that stage runs alone. Beside other stages it adds to their run, which
    keeps its folder.
    """
    alone = set(config.stages) if len(config.stages) == 1 else set()
    others = set(get_args(Stage)) - alone
    relevant = {key: value for key, value in as_mapping(config).items() if key not in RESULT_NEUTRAL | others}
    canonical = json.dumps(relevant, sort_keys=True, separators=(",", ":"))
    return f"seed{config.seed}-{hashlib.sha256(canonical.encode()).hexdigest()[:8]}"


MOST_BYTES = 2**34
"""Largest estimate of memory for one purpose: 16 GiB, many times the need of the defaults. It does not depend on this
machine, so that a config is valid on every machine or on none."""


@one_thread()
def check_components(config: RunConfig) -> None:
    """Check the conditions on several values together; UserError names the first that does not hold."""
    for problem in _problems(config):
        raise UserError(f"{problem.key} must {problem.rule}, got {abbreviate(problem.value)}")
    for memory in _memory(config):
        if memory.n_bytes > MOST_BYTES:
            by = ", ".join(f"{key} = {_size_at(config, key)}" for key in memory.keys)
            allowed, asked = MOST_BYTES / 2**30, memory.n_bytes / 2**30
            raise UserError(f"{memory.purpose} must take at most {allowed:g} GiB, got about {asked:.2g} GiB by {by}")


def _problems(config: RunConfig) -> Iterator[Problem]:
    """Problems that the components find in their values."""
    scenario, evaluation, stages = config.scenario, config.evaluation, set(config.stages)
    dt_s, planner = scenario.dt_s, config.planner
    foresight = Foresight(planner.horizon_s, planner.give_way is not None)
    yield from planner.check(dt_s)
    yield from config.observation.check(dt_s)
    yield from config.perception.check(dt_s)
    yield from config.dynamics.check(dt_s)
    yield from config.vehicle.check(dt_s)
    yield from check_policy(config.policy, config.observation.layout, dt_s, foresight)
    yield from scenario.check(foresight)
    if scenario.absent_queue_share > 0 and config.perception.range_m is None:
        rule = "be a number where scenario.absent_queue_share > 0, so that nobody sees who is absent"
        yield Problem("perception.range_m", rule, None)
    remembered_s = config.observation.history_steps(dt_s) * dt_s - config.perception.accel_window_s
    yield from config.population.check(dt_s, foresight, max(0.0, remembered_s))
    for stage in sorted(WITHOUT_POLICY & stages):
        yield from config.population.check_self(f"the stage {stage}")
    yield from config.curriculum.check(dt_s, foresight)
    yield from evaluation.check(scenario, foresight)
    driven = set(evaluation.settings)
    if "replay" in stages and config.episode is None and config.encounter is None:
        yield Problem("episode", "be <setting>/<planner>/<number> for the stage replay", None)
    if config.episode is not None and config.encounter is not None:
        yield Problem("encounter", "be null where episode names what is replayed", config.encounter)
    if "report" in stages:
        yield from config.report.check(evaluation.baselines)
    if "behaviour_map" in stages:
        yield from config.behaviour_map.check(dt_s, foresight)
    if "cross_play" in stages:
        yield from config.cross_play.check(config.population)
    if "oracle" in stages:
        yield from config.oracle.check(scenario, evaluation.n_episodes, evaluation.reward)
        driven |= set(config.oracle.settings)
    families = {f"scenario.families.{name}": scenario.families[name] for name in sorted(driven)}
    yield from check_starts(scenario, families, "scenario.ego_start_distance_m")
    if "train" in stages:
        yield from config.curriculum.check_training(scenario, config.reward)


def _memory(config: RunConfig) -> Iterator[Memory]:
    """Memory estimates of the components."""
    scenario, observation, stages = config.scenario, config.observation, set(config.stages)
    dt_s, n_vehicles, n_actions = scenario.dt_s, scenario.n_vehicles, len(config.policy.horizons_s)
    n_chunk, n_steps, observed = CHUNKS["cpu"][-1], scenario.episode_steps, observation.observed
    yield config.planner.memory(scenario, n_chunk)
    yield observation.memory(scenario.most_parked + n_vehicles, n_chunk)
    remembered = config.perception.memory_steps(dt_s, observation.history_steps(dt_s))
    yield world_memory(config.algorithm.n_worlds, n_vehicles, remembered, config.dynamics.delay_steps(dt_s))
    layers = layers_of(config.policy, observation.layout)
    yield layers.memory
    n_agents = n_vehicles if config.population.has_learners else 1
    yield from config.algorithm.memory(layers, observed, n_agents)
    yield config.evaluation.memory(scenario)
    if "train" in stages:
        yield from config.curriculum.memory(n_steps, observed)
    if "behaviour_map" in stages:
        yield config.behaviour_map.memory(scenario)
    if "cross_play" in stages:
        yield config.cross_play.memory(scenario)
    if "oracle" in stages:
        yield config.oracle.memory(n_actions, n_steps)
    if "benchmark" in stages:
        yield config.benchmark.memory(observed)


def _size_at(config: RunConfig, key: str) -> str:
    """The value at a dotted key; the number of items of a list."""
    value = attrgetter(key)(config)
    return f"{len(value)} items" if isinstance(value, list | tuple | dict) else str(value)
