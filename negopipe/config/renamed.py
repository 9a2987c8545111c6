"""Old names of config keys, groups, options and values, and their present names."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

RENAMED = {
    "evaluation/rival": "evaluation/baseline",
    "evaluation.rivals": "evaluation.baselines",
    "evaluation.baselines.*.horizons": "evaluation.baselines.*.horizons_s",
    "evaluation.action=most_probable": "evaluation.action=greedy",
    "experiment=shown": "experiment=demonstrations",
    "curriculum=shown": "curriculum=demonstrations",
    "algorithm.settling": "algorithm.entropy_penalty",
    "dynamics.model": "dynamics.kind",
    "planner.prediction.model": "planner.prediction.kind",
    "runs": "python -m negopipe.sweeping.compare <outputs>/<name>",
}
"""Old name -> new name. A name is a key, a key with one of its values (`=`), a group (`/`) or a group with one of its
options. `*` stands for any name."""

_PATTERNS = {
    old: re.compile(rf"{re.escape(old)}(?:[./=].*)?".replace(r"\*", r"(\w+)"), flags=re.DOTALL) for old in RENAMED
}
"""Old name -> pattern of it and of the names below it."""


def renaming(name: str) -> str | None:
    """Message for an old name or for a name below it; None for any other name."""
    for old, new in RENAMED.items():
        if found := _PATTERNS[old].fullmatch(name):
            any_name = "".join(found.groups())
            return f"{old} is now {new}".replace("*", any_name)
    return None


def renaming_in(message: str) -> str | None:
    """Message for an old name that an error of Hydra quotes; None where it quotes none."""
    return next(filter(None, map(renaming, re.findall(r"'([^']*)'", message))), None)


def renamings(values: Any) -> list[str]:
    """Messages for the old keys and old values of a composed config, given as plain mappings."""
    found = (renaming(key) or renaming(f"{key}={value}") for key, value in _entries(values))
    return list(dict.fromkeys(filter(None, found)))


def _entries(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys at every depth, with their values."""
    for name, value in values.items():
        key = f"{prefix}{name}"
        yield key, value
        if isinstance(value, Mapping):
            yield from _entries(value, f"{key}.")
