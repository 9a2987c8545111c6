"""Labels of planners, settings and outcomes in figures and tables."""

import re

from negopipe.evaluation.names import FixedHorizons, in_words


def planner_label(planner: str, fixed_s: FixedHorizons) -> str:
    """The name in words; no line breaks between a horizon and its unit."""
    return re.sub(r"(?<=\d) s\b", "\N{NO-BREAK SPACE}s", in_words(planner, fixed_s))


def outcome_label(outcome: str) -> str:
    """`social_collision` -> `social collision`."""
    return outcome.replace("_", " ")


def setting_label(setting: str) -> str:
    """`mixture_switching` -> `Mixture switching`."""
    return setting[:1].upper() + setting[1:].replace("_", " ")
