"""Checks that a component makes of its own values: problems with the rest of the config, and memory.

A component owns its numbers, so it checks them and counts their bytes. `negopipe.config.root` calls every component
with the values of others that it needs, and makes the error messages.
"""

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


Times = Mapping[str, Iterable[float]]
"""Times in seconds, by key."""


def check_times(times_s: Times, dt_s: float) -> Iterator[Problem]:
    """Problems with times that are no whole number of control steps: they would act like another time."""
    for key, values in times_s.items():
        for time_s in values:
            n_steps = round(time_s / dt_s)
            if abs(time_s / dt_s - n_steps) > WHOLE or (n_steps == 0 and time_s > 0):
                yield Problem(key, f"be a multiple of scenario.dt_s = {dt_s}", time_s)


def check_horizons(horizons_s: Times, dt_s: float, plan_s: float) -> Iterator[Problem]:
    """Problems with prediction horizons that are longer than a plan or no whole number of control steps.

    plan_s: length of a plan, `planner.horizon_s`
    """
    for key, values in horizons_s.items():
        longest_s = max(values, default=0.0)
        if longest_s > plan_s:
            yield Problem(key, f"be at most planner.horizon_s = {plan_s}", longest_s)
    yield from check_times(horizons_s, dt_s)


def check_names(key: str, names: Iterable[str], allowed: Iterable[str], source: str) -> Iterator[Problem]:
    """Problems with names that are not among those of the key `source`."""
    known = list(allowed)
    for name in names:
        if name not in known:
            yield Problem(key, f"be among {abbreviate(', '.join(known)) or 'none'} of {source}", name)
