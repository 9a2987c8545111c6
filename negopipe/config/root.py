"""RunConfig: the root schema. What Hydra composes from `conf/` becomes one typed, checked, frozen object."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple, get_args

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import Field, TypeAdapter, ValidationError

from negopipe.benchmark.speed import BenchmarkConfig
from negopipe.config.messages import abbreviate, explain_composition, explain_validation, misread
from negopipe.errors import UserError
from negopipe.evaluation.behaviour_map import BehaviourMapConfig
from negopipe.evaluation.episodes import EvaluationConfig
from negopipe.evaluation.trace import ADAPTIVE, ORACLE
from negopipe.game.curriculum import CurriculumConfig
from negopipe.game.game import CHUNKS
from negopipe.game.reward import RewardConfig
from negopipe.learning.acktr import AcktrConfig
from negopipe.learning.acktr_adam import AcktrAdamConfig
from negopipe.learning.learner import AlgorithmConfig
from negopipe.observation.occupancy_grid import ObservationConfig
from negopipe.planner.frenet import PlannerConfig
from negopipe.policy.actor_critic import PolicyConfig
from negopipe.report.page import ReportConfig
from negopipe.schema import Distinct, FileName, Label, PathText, PositiveInt, Seed, schema
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

MOST_BYTES = 2**34
"""At once, for one purpose, roughly: 16 GiB, hundreds of times what the defaults need. It does not ask what this
machine has, so that a config is valid on every machine or on none."""

FLOAT_BYTES = 4
N_TEMPORARIES = 16
"""Tensors of a size that are alive together while one is computed."""

RECORD_BYTES = 100
"""Of one vehicle's step in a `Trace`, while it is put together."""

RESULT_NEUTRAL = {
    "name", "objective", "seed", "outputs", "stages", "rerun", "reuse", "n_threads", "report", "episode", "runs",
    "tracking",
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
    runs: Label | None
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
    relevant |= {} if config.runs is None else {"runs": config.runs}  # a report on other runs has a folder of its own
    canonical = json.dumps(relevant, sort_keys=True, separators=(",", ":"))
    return f"seed{config.seed}-{hashlib.sha256(canonical.encode()).hexdigest()[:8]}"


def check_components(config: RunConfig) -> None:
    """Conditions that no component can check alone; UserError names the first that does not hold."""
    _check_horizons(config)
    _check_times(config)
    _check_grids(config)
    _check_sizes(config)
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
    horizons |= {
        f"evaluation.baselines.{name}": baseline.horizons_s for name, baseline in config.evaluation.baselines.items()
    }
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
    sides = _sides(config)
    for index, (side, conv) in enumerate(zip(sides, config.policy.conv, strict=False)):
        if conv.kernel > side:
            limit = f"{side}, what is left there of observation.n_cells = {sides[0]}"
            before = f" after stride {config.policy.conv[index - 1].stride}" if index else ""
            raise UserError(f"policy.conv.{index}.kernel must be at most {limit}, got {conv.kernel}{before}")


def _sides(config: RunConfig) -> list[int]:
    """Cells along a side of the grid and of what each convolution makes of it."""
    sides = [config.observation.n_cells]
    for conv in config.policy.conv:
        sides.append((sides[-1] - conv.kernel) // conv.stride + 1)
    return sides


class _Need(NamedTuple):
    """Roughly how many bytes something takes at once, and the keys that make it so."""

    what: str
    n_bytes: float
    keys: str


def _check_sizes(config: RunConfig) -> None:
    """What values make together fits in memory: a process that asks for too much is killed without a word."""
    for need in (*_game_needs(config), *_network_needs(config), *_stage_needs(config)):
        if need.n_bytes > MOST_BYTES:
            by = ", ".join(f"{key} = {_size_at(config, key)}" for key in need.keys.split())
            allowed, asked = MOST_BYTES / 2**30, need.n_bytes / 2**30
            raise UserError(f"{need.what} must take at most {allowed:g} GiB, got about {asked:.2g} GiB by {by}")


def _size_at(config: RunConfig, key: str) -> str:
    """The value at a dotted key; of a list, how many items it has."""
    value: Any = config
    for part in key.split("."):
        value = value[int(part)] if part.isdigit() else getattr(value, part)
    return f"{len(value)} items" if isinstance(value, list | tuple) else str(value)


def _game_needs(config: RunConfig) -> Iterator[_Need]:
    """What is computed for a chunk of worlds at once, and what every world remembers."""
    scenario, planner, seen = config.scenario, config.planner, config.observation
    along, aside, clearance = planner.longitudinal, planner.lateral, planner.clearance
    n_vehicles, n_times = 1 + scenario.n_social, planner.horizon_s / scenario.dt_s
    n_stops = len(along.stop_distances_m) + len(along.stop_positions_m)
    n_along = len(along.keep_fractions) * len(along.keep_durations_s) + n_stops * len(along.stop_durations_s)
    n_aside = len(aside.offsets_m) * len(aside.lengths_m)
    size, paths = scenario.vehicle, CHUNKS["cpu"] * n_vehicles * n_aside * FLOAT_BYTES * N_TEMPORARIES
    beside = clearance.beside_m + clearance.beside_s * planner.limits.speed_max_mps
    around = 2 * (size.length_m + size.width_m + clearance.ahead_m + beside) / clearance.conflict_station_m
    ahead = planner.limits.speed_max_mps * planner.horizon_s / clearance.station_m
    n_past = seen.n_frames * seen.frame_interval_s + config.perception.delay_s + config.perception.accel_window_s
    memory = n_past / scenario.dt_s * n_vehicles**2 * 4 * FLOAT_BYTES
    words = seen.n_frames * (seen.n_cells**2 / 28 + seen.n_cells) * (2 * scenario.road.n_parked_per_side + n_vehicles)
    lists = "planner.longitudinal.keep_fractions planner.lateral.offsets_m scenario.n_social scenario.dt_s"
    yield _Need("the planner's candidates", paths * scenario.n_social * n_times * n_along, lists)
    close = (
        "planner.clearance.conflict_station_m planner.clearance.beside_s planner.limits.speed_max_mps scenario.n_social"
    )
    yield _Need("the planner's checks", paths * scenario.n_social * n_times * around, close)
    far = "planner.clearance.station_m planner.limits.speed_max_mps planner.horizon_s scenario.n_social"
    yield _Need("the planner's paths", paths * ahead, far)
    past = "algorithm.n_worlds scenario.n_social scenario.dt_s observation.n_frames observation.frame_interval_s"
    past += " perception.delay_s perception.accel_window_s"
    yield _Need("the worlds' past", config.algorithm.n_worlds * memory * N_TEMPORARIES, past)
    grids = "observation.n_cells observation.n_frames scenario.n_social scenario.road.n_parked_per_side"
    yield _Need("a chunk's grids", CHUNKS["cpu"] * words * FLOAT_BYTES * N_TEMPORARIES, grids)


def _network_needs(config: RunConfig) -> Iterator[_Need]:
    """Weights, each kept several times over; what a minibatch makes of them; their factors."""
    policy, learner, sides = config.policy, config.algorithm, _sides(config)
    channels = [config.observation.n_frames, *(conv.channels for conv in policy.conv)]
    heads = [policy.encoder_width, *policy.head_widths, len(policy.horizons_s)]
    fans = [(c * conv.kernel**2, conv.channels) for c, conv in zip(channels, policy.conv, strict=False)]
    fans += [(channels[-1] * sides[-1] ** 2, policy.encoder_width), *2 * list(pairwise(heads))]
    n_weights = sum(n_in * n_out for n_in, n_out in fans)
    cells = [c * side**2 for c, side in zip(channels, sides, strict=True)]
    n_samples = min(learner.minibatch_size, learner.n_worlds * learner.n_steps)
    widths = "policy.encoder_width policy.head_widths policy.conv observation.n_cells observation.n_frames"
    layers = "".join(f" policy.conv.{index}.channels" for index in range(len(policy.conv)))
    yield _Need("the network", n_weights * FLOAT_BYTES * N_TEMPORARIES, widths + layers)
    patches = 0
    if isinstance(learner, AcktrConfig | AcktrAdamConfig):
        n_factors = sum(n_in * min(n_in, learner.kfac.max_factor_size) + n_out**2 for n_in, n_out in fans)
        factors = "algorithm.kfac.max_factor_size policy.encoder_width policy.head_widths observation.n_cells"
        yield _Need("the network's factors", n_factors * FLOAT_BYTES * N_TEMPORARIES, factors + layers)
        n_patches = max((fan[0] * side**2 for fan, side in zip(fans, sides[1:], strict=False)), default=0)
        patches = min(learner.kfac.n_statistics, n_samples) * n_patches
    batch = "algorithm.minibatch_size algorithm.n_worlds algorithm.n_steps observation.n_cells observation.n_frames"
    yield _Need("a minibatch", (n_samples * sum(cells) + patches) * FLOAT_BYTES * 4, batch + layers)


def _stage_needs(config: RunConfig) -> Iterator[_Need]:
    """What the stages that run keep of what they drive; the evaluation's tasks are drawn by most."""
    scenario, learner, seen = config.scenario, config.algorithm, config.observation
    grids = learner.n_worlds * learner.n_steps * seen.n_frames * seen.n_cells**2
    rollout = "algorithm.n_worlds algorithm.n_steps observation.n_frames observation.n_cells"
    yield _Need("a rollout", grids * 2, rollout)
    if "benchmark" in config.stages:
        measured = max(config.benchmark.n_worlds) * seen.n_frames * seen.n_cells**2
        yield _Need("the benchmark", measured * 4, "benchmark.n_worlds observation.n_frames observation.n_cells")
    record = scenario.episode_steps * (1 + scenario.n_social) * RECORD_BYTES
    one = "scenario.episode_steps scenario.n_social"
    n_planners = 1 + len(config.evaluation.baselines)
    driven = config.evaluation.n_episodes * n_planners * len(config.evaluation.settings) * record
    tasks = "evaluation.n_episodes evaluation.settings evaluation.baselines"
    yield _Need("the evaluation", driven, f"{tasks} {one}")
    if "behaviour_map" in config.stages:
        yield _Need("the map", config.behaviour_map.n_episodes * record, f"behaviour_map.n_episodes {one}")
    shown = config.curriculum.demonstrations
    if "train" in config.stages and shown is not None:
        n_drives = shown.n_tasks * len(config.curriculum.stages[-1].families)
        n_grids = n_drives * scenario.episode_steps + shown.n_decisions
        keys = f"curriculum.demonstrations.n_tasks curriculum.demonstrations.n_decisions {one}"
        grid = seen.n_frames * seen.n_cells**2
        yield _Need("what is demonstrated", n_grids * grid * 2, f"{keys} observation.n_frames observation.n_cells")
        n_played = n_drives * max(shown.population, len(config.policy.horizons_s) ** 2)
        searched = f"curriculum.demonstrations.n_tasks curriculum.demonstrations.population policy.horizons_s {one}"
        yield _Need("the search for demonstrations", n_played * record, searched)
    if "oracle" in config.stages:
        n_sequences = max(config.oracle.population, len(config.policy.horizons_s) ** 3)
        search = config.oracle.n_episodes * n_sequences * record
        yield _Need("the search", search, f"oracle.n_episodes oracle.population policy.horizons_s {one}")


def _check_evaluation(config: RunConfig) -> None:
    """What is evaluated, opened with and shown exists."""
    settings = config.evaluation.settings
    for name, who in {ADAPTIVE: "the policy", ORACLE: "what evaluation.oracle brings"}.items():
        if name in config.evaluation.baselines:
            raise UserError(f"evaluation.baselines must not name one {name}, which is {who}")
    _require("evaluation.settings", settings, config.scenario.families, "scenario.families")
    _require("evaluation.leading_setting", [config.evaluation.leading_setting], settings, "evaluation.settings")
    if config.runs is not None and config.stages != ("report",):
        raise UserError(f"stages must be [report] where runs names what is compared, got {list(config.stages)}")
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
