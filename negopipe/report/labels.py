"""Labels of planners, settings and outcomes in figures and tables."""

import math
import re

from negopipe.evaluation.names import FixedHorizons, in_words
from negopipe.schema import INFINITE

INFINITY = "\N{INFINITY}"


def planner_label(planner: str, fixed_s: FixedHorizons) -> str:
    """The name in words; no line breaks between a horizon and its unit, an infinite one as a sign."""
    words = re.sub(r"(?<=\d) s\b", "\N{NO-BREAK SPACE}s", in_words(planner, fixed_s))
    return re.sub(rf"\b{INFINITE}\b", INFINITY, words) if fixed_s.get(planner) == math.inf else words


def horizon_number(horizon_s: float) -> str:
    """A prediction horizon at an axis in seconds: `2`, or the sign of infinity."""
    return INFINITY if horizon_s == math.inf else f"{horizon_s:g}"


def horizon_label(horizon_s: float) -> str:
    """A prediction horizon with its unit: `2 s`, or the sign of infinity alone."""
    return INFINITY if horizon_s == math.inf else f"{horizon_s:g} s"


def outcome_label(outcome: str) -> str:
    """`social_collision` -> `social collision`."""
    return outcome.replace("_", " ")


def setting_label(setting: str) -> str:
    """`mixture_switching` -> `Mixture switching`."""
    return setting[:1].upper() + setting[1:].replace("_", " ")
