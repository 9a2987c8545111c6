"""What is searched: the sweeps of a command line as distributions of Optuna, in Hydra's own syntax.

algorithm.learning_rate=interval(0.05,0.5)      any number between, both ends included
algorithm.kl_clip=tag(log,interval(1e-4,1e-2))  the same on a logarithmic scale
algorithm.n_steps=int(interval(8,32))           whole numbers, also tag(int,log,interval(1,1000))
algorithm.n_steps=range(8,33,step=8)            8, 16, 24, 32: the end is left out, as in every Hydra sweep
reward=paper,strict                             one of them; so is choice(paper,strict), and glob(*)
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep

from negopipe.errors import UserError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

_TAGS = {"log", "int"}
_DIGITS = 12
"""A float is given to a run with so many digits: what is recorded is what was run."""


def split_overrides(overrides: Sequence[Override]) -> tuple[list[str], dict[str, "BaseDistribution"]]:
    """What all trials have in common, and the distribution of each key that is searched.

    The last word about a key counts. UserError where a sweep makes no distribution.
    """
    last = {override.get_key_element(): override for override in overrides}
    space = {key: distribution(override) for key, override in last.items() if override.is_sweep_override()}
    fixed = [override for override in last.values() if not override.is_sweep_override()]
    return [_fixed_text(override) for override in fixed], space


def distribution(override: Override) -> "BaseDistribution":
    """The distribution of one sweep override; the values of a choice are the texts of the command line."""
    from optuna.distributions import CategoricalDistribution

    sweep, key = override.value(), override.get_key_element()
    tags: set[str] = getattr(sweep, "tags", set())
    if unknown := tags - _TAGS:
        raise UserError(f"{key} must be tagged log, int or both, got {', '.join(sorted(unknown))}")
    if isinstance(sweep, IntervalSweep):
        return _interval(key, sweep)
    if tags:
        raise UserError(f"{key} must be an interval to be tagged, got {override.get_value_string()}")
    values = list(override.sweep_iterator())
    if not values:
        raise UserError(f"{key} must have values to search among, got {override.get_value_string()}")
    if isinstance(sweep, RangeSweep):
        return _range(values, sweep.step)
    return CategoricalDistribution(tuple(dict.fromkeys(override.sweep_string_iterator())))


def as_overrides(params: Mapping[str, Any]) -> list[str]:
    """Parameters of a trial as they stand on a command line."""
    return [f"{key}={_text(value)}" for key, value in params.items()]


def first_point(space: Mapping[str, Any]) -> dict[str, Any]:
    """Some values that lie in the space, the same ones at every call."""
    return {key: part.choices[0] if hasattr(part, "choices") else part.low for key, part in space.items()}


def _interval(key: str, sweep: IntervalSweep) -> "BaseDistribution":
    from optuna.distributions import FloatDistribution, IntDistribution

    low, high, is_log = sweep.start, sweep.end, "log" in sweep.tags
    assert low is not None  # Hydra's grammar demands both
    assert high is not None
    is_int = "int" in sweep.tags or (isinstance(low, int) and isinstance(high, int))
    if low > high:
        raise UserError(f"{key} must be an interval(low,high) with low <= high, got interval({low:g},{high:g})")
    if is_log and (low < 1 if is_int else low <= 0):
        limit = "at least 1" if is_int else "greater than 0"
        raise UserError(f"{key} must begin {limit} on a logarithmic scale, got {low:g}")
    if not is_int:
        return FloatDistribution(float(low), float(high), log=is_log)
    if low != int(low) or high != int(high):
        raise UserError(f"{key} must have whole ends to be searched as int, got interval({low:g},{high:g})")
    return IntDistribution(int(low), int(high), log=is_log)


def _range(values: list[Any], step: float) -> "BaseDistribution":
    from optuna.distributions import FloatDistribution, IntDistribution

    low, high = min(values), max(values)
    if all(isinstance(value, int) for value in values):
        return IntDistribution(low, high, step=abs(int(step)))
    return FloatDistribution(rounded(low), rounded(high), step=rounded(abs(step)))


def _fixed_text(override: Override) -> str:
    if override.is_delete():
        return override.input_line or ""
    return f"{override.get_key_element()}={override.get_value_element_as_str()}"


def _text(value: Any) -> str:
    return repr(rounded(value)) if isinstance(value, float) else str(value)


def rounded(value: float) -> float:
    """As it is given to a run."""
    return float(f"{value:.{_DIGITS}g}")
