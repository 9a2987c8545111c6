"""Names of planners in files and in words. Names are free; the configs alone tell which planners are fixed horizons."""

import math
from collections.abc import Mapping

from negopipe.schema import INFINITE

FixedHorizons = Mapping[str, float]
"""Name of each planner with a fixed horizon -> the horizon, s; see `EvaluationConfig.fixed_horizons_s`."""


def fixed_name(horizon_s: float) -> str:
    """Name of a fixed horizon in tables and files, e.g. `fixed_2`, `fixed_inf`."""
    return f"fixed_{horizon_s:g}"


def in_words(planner: str, fixed_s: FixedHorizons) -> str:
    """The name in words, without underscores; a fixed horizon with its unit: `fixed 2 s`, or `bold (2 s)` under a name
    of its own. Infinity has no unit: `fixed inf`.
    """
    words = planner.replace("_", " ")
    if planner not in fixed_s:
        return words
    horizon_s = fixed_s[planner]
    if planner != fixed_name(horizon_s):
        return f"{words} ({horizon_in_words(horizon_s)})"
    return words if horizon_s == math.inf else f"{words} s"


def horizon_in_words(horizon_s: float) -> str:
    """`2 s`, or `inf`."""
    return INFINITE if horizon_s == math.inf else f"{horizon_s:g} s"
