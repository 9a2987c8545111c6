"""Headlines of a run: the first lines of the page and of the run's description."""

from collections.abc import Mapping, Sequence
from typing import Any

from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.trace import ADAPTIVE, ORACLE
from negopipe.report.labels import planner_label, setting_label

Measures = Mapping[str, Any]
"""Measures of one planner in one setting, by the names in `evaluation.measures`."""
Difference = Mapping[str, Any]
"""Difference on the same tasks: value, low, high and n_tasks."""
Versus = Mapping[str, Difference]
"""Differences of one planner to the policy in one setting, by measure (`evaluation.comparison.versus_adaptive`)."""


def headlines(
    evaluation: Mapping[str, Mapping[str, Measures]],
    versus: Mapping[str, Mapping[str, Versus]],
    fixed_s: FixedHorizons,
) -> list[tuple[str, str]]:
    """Verdicts with their numbers: over all settings, if there are several, then setting by setting.

    evaluation: setting -> planner -> measures, the first setting first
    versus: setting -> planner other than the policy -> differences to it
    """
    by_setting = [headline(setting, measures, versus[setting], fixed_s) for setting, measures in evaluation.items()]
    baselines = _baselines(evaluation)
    if len(evaluation) < 2 or not baselines:
        return by_setting
    return [_overall(evaluation, versus, baselines, fixed_s), *by_setting]


def standing(evaluation: Mapping[str, Mapping[str, Measures]], versus: Mapping[str, Mapping[str, Versus]]) -> str:
    """Standing relative to the best baseline: ahead | level | behind; alone without baselines.

    Every planner is represented by its weakest setting. If both have the same one, the difference on the same tasks
    decides; else the policy is ahead if its interval lies above the baseline's.
    """
    baselines = _baselines(evaluation)
    if not baselines:
        return "alone"
    best = _best(evaluation, baselines)
    (setting, ours), (their_setting, theirs) = (_weakest(evaluation, planner) for planner in (ADAPTIVE, best))
    if setting == their_setting:
        difference = versus[setting][best]["success"]
        if _includes_zero(difference):
            return "level"
        return "behind" if difference["value"] > 0 else "ahead"
    if ours["success_low"] > theirs["success_high"]:
        return "ahead"
    return "behind" if ours["success_high"] < theirs["success_low"] else "level"


RELIABILITY = {"ahead": "more reliably than", "level": "as reliably as", "behind": "less reliably than"}


def _baselines(evaluation: Mapping[str, Mapping[str, Measures]]) -> list[str]:
    """Planners that drove in all settings, without the oracle, which has full knowledge."""
    first, *others = evaluation.values()
    drove = [planner for planner in first if all(planner in measures for measures in others)]
    return [planner for planner in drove if planner not in (ADAPTIVE, ORACLE)]


def _weakest(evaluation: Mapping[str, Mapping[str, Measures]], planner: str) -> tuple[str, Measures]:
    """The setting in which a planner has its lowest success rate, and its measures there."""
    setting = min(evaluation, key=lambda setting: evaluation[setting][planner]["success_rate"])
    return setting, evaluation[setting][planner]


def _best(evaluation: Mapping[str, Mapping[str, Measures]], baselines: Sequence[str]) -> str:
    def rank(planner: str) -> tuple[float, float]:
        measures = _weakest(evaluation, planner)[1]
        return measures["success_rate"], measures["reward"]

    return max(baselines, key=rank)


def _overall(
    evaluation: Mapping[str, Mapping[str, Measures]],
    versus: Mapping[str, Mapping[str, Versus]],
    baselines: Sequence[str],
    fixed_s: FixedHorizons,
) -> tuple[str, str]:
    """Verdict over all settings."""
    best = _best(evaluation, baselines)
    weakest = {planner: _weakest(evaluation, planner) for planner in (ADAPTIVE, best)}
    figures = (
        f"{planner_label(planner, fixed_s)} succeeds in {100 * measures['success_rate']:.1f} % of the episodes of "
        f"{setting_label(setting).lower()}"
        for planner, (setting, measures) in weakest.items()
    )
    rewards = ", ".join(
        f"{each[ADAPTIVE]['reward']:.2f} against {each[best]['reward']:.2f} ({setting_label(setting).lower()})"
        for setting, each in evaluation.items()
    )
    baseline = f"{planner_label(best, fixed_s)}, the best baseline"
    verdict = f"Over all settings the adaptive planner succeeds {RELIABILITY[standing(evaluation, versus)]} {baseline}."
    if not any(measures["success_rate"] for _, measures in weakest.values()):
        verdict = f"In their weakest settings neither the adaptive planner nor {baseline}, ever succeeds."
    return verdict, f"In their weakest settings, {'; '.join(figures)}. Reward: {rewards}."


def headline(
    setting: str, measures: Mapping[str, Measures], versus: Mapping[str, Versus], fixed_s: FixedHorizons
) -> tuple[str, str]:
    """The adaptive planner against the best baseline, by success rate, then by reward."""
    baselines = _baselines({setting: measures})
    if not baselines:
        return f"{setting_label(setting)}: {_achievement(ADAPTIVE, measures[ADAPTIVE])}.", ""
    best = max(baselines, key=lambda planner: (measures[planner]["success_rate"], measures[planner]["reward"]))
    ours, theirs = measures[ADAPTIVE], measures[best]
    baseline = planner_label(best, fixed_s)
    never = f"neither the adaptive planner nor {baseline} ever succeeds"
    succeeded = ours["success_rate"] or theirs["success_rate"]
    verdict = f"{setting_label(setting)}: {_verdict(versus[best], baseline) if succeeded else never}."
    parts = (_achievement(ADAPTIVE, ours), f"{_achievement(baseline, theirs)} (the best baseline)")
    n_tasks = versus[best]["success"]["n_tasks"]
    told = [*parts, *_rewarded(versus[best]["reward"])]
    return verdict, f"{'; '.join(told).capitalize()}. Differences on the same {n_tasks} tasks, with 95 % intervals."


def _rewarded(difference: Difference) -> list[str]:
    """Difference of the rewards, if its interval excludes zero."""
    if _includes_zero(difference):
        return []
    which = "lower" if difference["value"] > 0 else "higher"
    return [f"the adaptive planner's reward is {_interval(difference, 1, 2)} {which}"]


def _verdict(versus: Versus, baseline: str) -> str:
    """Comparison by success rate if its paired interval excludes zero, else by driving time."""
    success, time = (versus[measure] for measure in ("success", "driving_time_s"))
    if not _includes_zero(success):
        verb = "loses to" if success["value"] > 0 else "beats"
        return f"the adaptive planner {verb} {baseline} by {_interval(success, 100, 1)} points of success rate"
    if not time["n_tasks"]:
        return f"the adaptive planner and {baseline} succeed equally often"
    if _includes_zero(time):
        return f"the adaptive planner succeeds as often as {baseline} and is as fast"
    pace = "faster" if time["value"] > 0 else "slower"
    return f"the adaptive planner succeeds as often as {baseline} and is {_interval(time, 1, 2)} s {pace}"


def _includes_zero(difference: Mapping[str, Any]) -> bool:
    """True also without an interval."""
    return difference["low"] is None or difference["low"] <= 0 <= difference["high"]


def _interval(difference: Mapping[str, Any], factor: float, decimals: int) -> str:
    """`1.50 [1.20, 1.80]`, without the sign."""
    low, high = sorted(abs(factor * difference[bound]) for bound in ("low", "high"))
    return f"{abs(factor * difference['value']):.{decimals}f} [{low:.{decimals}f}, {high:.{decimals}f}]"


def _achievement(label: str, measures: Measures) -> str:
    time_s = measures["driving_time_s"]
    pace = "the ego never arrives" if time_s is None else f"driving time {time_s:.1f} s"
    success, collision = (100 * measures[key] for key in ("success_rate", "collision_rate"))
    return f"{label}: {success:.1f} % success, {collision:.1f} % collisions, {pace}"
