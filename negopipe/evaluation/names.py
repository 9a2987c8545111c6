"""Names of planners in files and in words. Names are free; the configs alone tell which planners are fixed horizons."""

from collections.abc import Mapping

FixedHorizons = Mapping[str, float]
"""Name of each planner with a fixed horizon -> the horizon, s; see `EvaluationConfig.fixed_horizons_s`."""


def fixed_name(horizon_s: float) -> str:
    """Name of a fixed horizon in tables and files, e.g. `fixed_2`."""
    return f"fixed_{horizon_s:g}"


def in_words(planner: str, fixed_s: FixedHorizons) -> str:
    """The name in words, without underscores; a fixed horizon with its unit: `fixed 2 s`, or `bold (2 s)` under a name
    of its own.
    """
    words = planner.replace("_", " ")
    if planner not in fixed_s:
        return words
    horizon_s = fixed_s[planner]
    return f"{words} s" if planner == fixed_name(horizon_s) else f"{words} ({horizon_s:g} s)"
