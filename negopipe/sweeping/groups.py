"""Groups of runs: the seeds of one config, or the runs that share the values of chosen keys."""

from collections.abc import Iterable, Mapping, Sequence
from string import ascii_uppercase

from negopipe.config.root import RESULT_NEUTRAL
from negopipe.errors import UserError
from negopipe.sweeping.swept_runs import SweptRun, as_json, differing_keys
from negopipe.tracking.names import without_implied

NOT_COMPARED = ("evaluation.baselines", "evaluation/baseline", "evaluation.oracle")
"""Beginnings of keys and overrides that change nothing about a policy."""
LONGEST_NAME = 28
"""Characters of a name in a table."""
ALL_RUNS, DEFAULT = "all runs", "default"
"""Name of the only group, and of the group that no override sets apart."""

Groups = Mapping[str, Sequence[SweptRun]]
"""Runs by the name of their group, in the order in which the groups were found."""


class LeftOut(Exception):
    """A part of a comparison does not apply to these runs; the message says why."""


def group_runs(runs: Sequence[SweptRun], by: Sequence[str] = ()) -> Groups:
    """Runs of one config together, named by the overrides that set it apart; with `by`, by the values of those keys.

    UserError if a key is in no config.
    """
    unknown = [key for key in by if not any(key in run.config for run in runs)]
    if unknown:
        raise UserError(f"--by must be keys of the config such as algorithm.kind, got {unknown[0]}")
    names = [_values(run, by) for run in runs] if by else _names_of_configs(runs)
    groups: dict[str, list[SweptRun]] = {}
    for name, run in zip(names, runs, strict=True):
        groups.setdefault(name, []).append(run)
    return groups


def compared_keys(runs: Sequence[SweptRun]) -> list[str]:
    """Keys in which the policies of the runs may differ."""
    return [key for key in differing_keys(runs) if not key.startswith(NOT_COMPARED)]


def short_names(names: Iterable[str]) -> dict[str, str]:
    """The names themselves where they fit a table, else letters."""
    names = list(names)
    if all(len(name) <= LONGEST_NAME for name in names):
        return {name: name for name in names}
    return {name: ascii_uppercase[i % 26] * (1 + i // 26) for i, name in enumerate(names)}


def _values(run: SweptRun, keys: Sequence[str]) -> str:
    return ", ".join(str(run.config.get(key, "-")) for key in keys)


def _names_of_configs(runs: Sequence[SweptRun]) -> list[str]:
    """A name per run, the same for runs of one config and for no others."""
    keys = compared_keys(runs)
    if not keys:
        return [ALL_RUNS] * len(runs)
    telling = without_implied(keys, [run.config for run in runs])
    shared = set.intersection(*(set(run.overrides) for run in runs))
    names: dict[str, str] = {}
    for run in runs:
        own = [text for text in run.overrides if text not in shared and _is_compared(text)]
        if not run.commands:  # the overrides are not recorded
            own = [f"{key}={run.config.get(key)}" for key in telling]
        name = " ".join(own) or DEFAULT
        config = as_json([run.config.get(key) for key in keys])
        names.setdefault(config, name if name not in names.values() else f"{name} ({len(names) + 1})")
    return [names[as_json([run.config.get(key) for key in keys])] for run in runs]


def _is_compared(override: str) -> bool:
    key = override.lstrip("+~").partition("=")[0]
    return not override.startswith(NOT_COMPARED) and key not in RESULT_NEUTRAL
