"""Checks that a component makes of its own values: problems with the rest of the config, and memory.

A component owns its numbers, so it checks them and counts their bytes. `negopipe.config.root` calls every component
with the values of others that it needs, and makes the error messages.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from negopipe.errors import abbreviate

FLOAT_BYTES = 4
"""Bytes of a float32."""

N_TEMPORARIES = 16
"""Estimated number of tensors of one size in memory at once while one of them is computed."""

N_COPIES = 4
"""Estimated number of copies of a minibatch's numbers in memory at once: values and gradients, old and new."""

WHOLE = 1e-6
"""Tolerance of a whole number of control steps, in control steps, for the rounding of floats."""


class Problem(NamedTuple):
    """A value that does not fit the others: `<key> must <rule>, got <value>`."""

    key: str
    rule: str
    value: Any


class Memory(NamedTuple):
    """Estimated bytes that a purpose needs at once, and the dotted keys that they depend on."""

    purpose: str
    n_bytes: float
    keys: tuple[str, ...]


class Observed(NamedTuple):
    """Size of one observation: its numbers, their bytes, and the dotted keys that these depend on."""

    n_numbers: int
    n_bytes: int
    keys: tuple[str, ...]


Times = Mapping[str, Iterable[float]]
"""Times in seconds, by key."""


def check_times(times_s: Times, dt_s: float) -> Iterator[Problem]:
    """Problems with times that are no whole number of control steps: they would act like another time."""
    for key, values in times_s.items():
        for time_s in values:
            n_steps = round(time_s / dt_s)
            if abs(time_s / dt_s - n_steps) > WHOLE or (n_steps == 0 and time_s > 0):
                yield Problem(key, f"be a multiple of scenario.dt_s = {dt_s}", time_s)


class Foresight(NamedTuple):
    """What a planner can do with prediction horizons.

    plan_s: length of a plan, s, `planner.horizon_s`
    gives_way: an infinite horizon has its rule, `planner.give_way`
    """

    plan_s: float
    gives_way: bool


def check_horizons(horizons_s: Times, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
    """Problems with prediction horizons that the planner cannot obey or that are no whole number of control steps."""
    finite = {key: [value for value in values if value < math.inf] for key, values in horizons_s.items()}
    for key, values in horizons_s.items():
        longest_s, rule = max(finite[key], default=0.0), f"be at most planner.horizon_s = {foresight.plan_s}"
        if longest_s > foresight.plan_s:
            yield Problem(key, rule, longest_s)
        if math.inf in values and not foresight.gives_way:
            way = "where planner.give_way is null (planner=consistent_stops sets it)"
            yield Problem(key, f"{rule} {way}", math.inf)
    yield from check_times(finite, dt_s)


def check_names(key: str, names: Iterable[str], allowed: Iterable[str], source: str) -> Iterator[Problem]:
    """Problems with names that are not among those of the key `source`."""
    known = list(allowed)
    for name in names:
        if name not in known:
            yield Problem(key, f"be among {abbreviate(', '.join(known)) or 'none'} of {source}", name)
