"""Names of planners, in files and in words. A name is free: what a planner does is known from its config alone."""

from collections.abc import Mapping

FixedHorizons = Mapping[str, float]
"""The one horizon, s, of each planner that keeps to one, by its name; see `EvaluationConfig.fixed_horizons_s`."""


def fixed_name(horizon_s: float) -> str:
    """Name of a fixed horizon in tables and files, e.g. `fixed_2`."""
    return f"fixed_{horizon_s:g}"


def in_words(planner: str, fixed_s: FixedHorizons) -> str:
    """The name in words: a fixed horizon with its unit (`fixed 2 s`, or `bold (2 s)` where it is named otherwise),
    all without underscores.
    """
    words = planner.replace("_", " ")
    if planner not in fixed_s:
        return words
    horizon_s = fixed_s[planner]
    return f"{words} s" if planner == fixed_name(horizon_s) else f"{words} ({horizon_s:g} s)"
