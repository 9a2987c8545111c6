"""Memory that values of the config make together: what does not fit is refused before there is a run."""

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from negopipe.errors import UserError
from negopipe.game.game import CHUNKS
from negopipe.learning.acktr import AcktrConfig
from negopipe.learning.acktr_adam import AcktrAdamConfig

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

MOST_BYTES = 2**34
"""At once, for one purpose, roughly: 16 GiB, hundreds of times what the defaults need. It does not ask what this
machine has, so that a config is valid on every machine or on none."""
FLOAT_BYTES = 4
N_TEMPORARIES = 16
"""Tensors of a size that are alive together while one is computed."""
RECORD_BYTES = 100
"""Of one vehicle's step in a `Trace`, while it is put together."""


class _Need(NamedTuple):
    """Roughly how many bytes something takes at once, and the keys that make it so."""

    what: str
    n_bytes: float
    keys: str


def check_sizes(config: "RunConfig") -> None:
    """What values make together fits in memory: a process that asks for too much is killed without a word."""
    for need in (*_game_needs(config), *_network_needs(config), *_stage_needs(config)):
        if need.n_bytes > MOST_BYTES:
            by = ", ".join(f"{key} = {_size_at(config, key)}" for key in need.keys.split())
            allowed, asked = MOST_BYTES / 2**30, need.n_bytes / 2**30
            raise UserError(f"{need.what} must take at most {allowed:g} GiB, got about {asked:.2g} GiB by {by}")


def _size_at(config: "RunConfig", key: str) -> str:
    """The value at a dotted key; of a list, how many items it has."""
    value: Any = config
    for part in key.split("."):
        value = value[int(part)] if part.isdigit() else getattr(value, part)
    return f"{len(value)} items" if isinstance(value, list | tuple) else str(value)


def _game_needs(config: "RunConfig") -> Iterator[_Need]:
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


def _network_needs(config: "RunConfig") -> Iterator[_Need]:
    """Weights, each kept several times over; what a minibatch makes of them; their factors."""
    policy, learner, sides = config.policy, config.algorithm, grid_sides(config)
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


def _stage_needs(config: "RunConfig") -> Iterator[_Need]:
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


def grid_sides(config: "RunConfig") -> list[int]:
    """Cells along a side of the grid and of what each convolution makes of it."""
    sides = [config.observation.n_cells]
    for conv in config.policy.conv:
        sides.append((sides[-1] - conv.kernel) // conv.stride + 1)
    return sides
