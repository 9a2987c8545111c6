"""What a component says of its own values: which do not go with the rest of the config, and how much memory they take.

A component owns its numbers, so it checks them and counts their bytes. `negopipe.config.root` asks every component,
hands in what it needs of the others, and words what is wrong.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from negopipe.errors import abbreviate

FLOAT_BYTES = 4

N_TEMPORARIES = 16
"""Tensors of one size that are alive together while one of them is computed, roughly."""

N_COPIES = 4
"""Copies of a minibatch's numbers that are alive together: values and gradients, old and new, roughly."""

WHOLE = 1e-6
"""Control steps by which a time may miss a whole number of them, for what floats round."""


class Problem(NamedTuple):
    """A value that does not go with the others: `<key> must <rule>, got <value>`."""

    key: str
    rule: str
    value: Any


class Memory(NamedTuple):
    """Bytes that something takes at once, roughly, and the dotted keys that make it so."""

    purpose: str
    n_bytes: float
    keys: tuple[str, ...]


Times = Mapping[str, Iterable[float]]
"""Times in seconds by the key of each."""


def check_times(times_s: Times, dt_s: float) -> Iterator[Problem]:
    """Times that do not end at a control step: they would act like another time."""
    for key, values in times_s.items():
        for time_s in values:
            n_steps = round(time_s / dt_s)
            if abs(time_s / dt_s - n_steps) > WHOLE or (n_steps == 0 and time_s > 0):
                yield Problem(key, f"be a multiple of scenario.dt_s = {dt_s}", time_s)


def check_horizons(horizons_s: Times, dt_s: float, plan_s: float) -> Iterator[Problem]:
    """Prediction horizons that are no whole control steps, or longer than plans: they would act like another one.

    plan_s: length of a plan, `planner.horizon_s`
    """
    for key, values in horizons_s.items():
        longest_s = max(values, default=0.0)
        if longest_s > plan_s:
            yield Problem(key, f"be at most planner.horizon_s = {plan_s}", longest_s)
    yield from check_times(horizons_s, dt_s)


def check_names(key: str, names: Iterable[str], allowed: Iterable[str], source: str) -> Iterator[Problem]:
    """Names that are not among those of the key `source`."""
    known = list(allowed)
    for name in names:
        if name not in known:
            yield Problem(key, f"be among {abbreviate(', '.join(known)) or 'none'} of {source}", name)
