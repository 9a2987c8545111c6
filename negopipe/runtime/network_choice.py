"""Precision and memory format of a run's network, chosen once by a timing at its first start."""

import logging
import time
from collections.abc import Iterable
from dataclasses import replace
from functools import partial, reduce
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from negopipe.policy.grids import GridPolicyConfig, grid_actor_critic, recast
from negopipe.runtime.backend import keep_choices, kept_choices
from negopipe.runtime.build import device_of
from negopipe.runtime.network_passes import forward_backward, minibatch_sizes, random_observations
from negopipe.tensors.seeding import generator
from negopipe.tensors.timing import block_seconds

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

STAGES = {"train", "evaluate", "benchmark"}
"""Stages that build a network; the others need no timing."""

PREFERRED = {"precision": ("float32", "bfloat16"), "memory_format": ("channels_last", "channels_first")}
"""Values that `auto` may stand for, by key of the policy: the first, unless the second is `GAIN` times as fast."""
GAIN = 1.05
"""Smallest ratio of speeds that decides. With a smaller one, runs of one config would differ by chance."""

N_ROUNDS, ENOUGH_S = 5, 1.5
"""Largest number of rounds of a timing, and the time after which no further round begins, s."""

N_GRIDS = 128
"""Largest number of grids that are timed on a CPU: the ratio of the variants is that of larger batches."""

HOPELESS = 4.0
"""Ratio of warm-up times, to the fastest, above which a variant is not timed: a processor without bfloat16 takes
seconds for every pass."""


class Variant(NamedTuple):
    """A precision and a memory format of the network."""

    precision: str
    memory_format: str


Seconds = dict[Variant, float]
"""Time of a pass by variant, s."""


def resolve_auto(config: "RunConfig", folder: Path) -> "RunConfig":
    """The config with every `auto` of policy.precision and policy.memory_format replaced by the faster value.

    Torch must have been prepared for the config (`backend.prepare`): the timing uses its device and threads. The choice
    is kept beside the backend's in `folder`, for a resumed run. A value other than `auto` stays. A network for objects
    has neither key.
    """
    if not isinstance(config.policy, GridPolicyConfig):
        return config
    autos = [key for key in PREFERRED if getattr(config.policy, key) == "auto"]
    kept = {key: value for key, value in kept_choices(folder).items() if key in autos}
    policy = replace(config.policy, **kept)
    how = ", as when the run began" if kept else ""
    if not STAGES & set(config.stages):
        return replace(config, policy=policy)
    if len(kept) < len(autos):
        seconds = time_variants(config, variants(policy))
        chosen = fastest(seconds)
        policy = replace(policy, **chosen._asdict())
        keep_choices(folder, {key: getattr(policy, key) for key in autos})
        how = f" (forward and backward of {_n_timed(config)}: {_comparison(seconds, chosen)})"
    log.info(f"network    {policy.precision}, {policy.memory_format}{how}")
    return replace(config, policy=policy)


def variants(policy: GridPolicyConfig) -> list[Variant]:
    """Variants that the policy's config leaves open, the preferred ones first."""
    given = {key: getattr(policy, key) for key in PREFERRED}
    values = [among if given[key] == "auto" else (given[key],) for key, among in PREFERRED.items()]
    return [Variant(*pair) for pair in product(*values)]


def time_variants(config: "RunConfig", among: Iterable[Variant]) -> Seconds:
    """Shortest time of a forward and backward pass of a minibatch, s, by variant, without the hopeless variants.

    The variants take turns, so that a slow moment of the machine affects all alike.
    """
    device, shape = device_of(config), config.observation.shape
    assert isinstance(config.policy, GridPolicyConfig)
    assert len(shape) == 3
    grids = random_observations(_n_timed(config), shape, device)
    policy = grid_actor_critic(config.policy, shape, device, generator(config.seed, "timing"))
    policies = {variant: recast(policy, *variant) for variant in among}

    def turn(n: int) -> Seconds:
        return {v: block_seconds(partial(forward_backward, p, grids[:n]), 1, device) for v, p in policies.items()}

    started_s = time.perf_counter()
    forward_backward(policy, grids[:1])  # torch starts its threads
    warm_up = turn(-(-len(grids) // 8))
    policies = {v: p for v, p in policies.items() if warm_up[v] <= HOPELESS * min(warm_up.values())}
    rounds = [turn(len(grids))]
    while len(rounds) < N_ROUNDS and time.perf_counter() - started_s < ENOUGH_S:
        rounds.append(turn(len(grids)))
    return {variant: min(seconds[variant] for seconds in rounds) for variant in policies}


def fastest(seconds: Seconds) -> Variant:
    """The faster of the precisions, each with its faster memory format, by the rule of `PREFERRED`."""
    precisions = dict.fromkeys(variant.precision for variant in seconds)
    winners = [_leader(seconds, [v for v in seconds if v.precision == name]) for name in precisions]
    return _leader(seconds, winners)


def _leader(seconds: Seconds, among: list[Variant]) -> Variant:
    return reduce(lambda best, other: other if seconds[other] * GAIN <= seconds[best] else best, among)


def _n_timed(config: "RunConfig") -> int:
    n = max(minibatch_sizes(config.algorithm))
    return n if device_of(config).type == "cuda" else min(n, N_GRIDS)


def _comparison(seconds: Seconds, chosen: Variant) -> str:
    """Time of the choice, beside the best time of the other precision or, without one, of the other memory format."""
    said = f"{1e3 * seconds[chosen]:.3g} ms"
    others = [v for v in seconds if v.precision != chosen.precision] or [v for v in seconds if v != chosen]
    if not others:
        return f"{said}; the others take many times as long"
    baseline = min(others, key=lambda variant: seconds[variant])
    name = baseline.memory_format if baseline.precision == chosen.precision else baseline.precision
    return f"{said}; {name} {1e3 * seconds[baseline]:.3g} ms"
