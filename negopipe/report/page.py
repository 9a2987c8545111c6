"""report.html: one self-contained file that says in plain words what a run has shown."""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jinja2
from pydantic import Field

from negopipe.evaluation.trace import ADAPTIVE
from negopipe.report.figures import planner_label, setting_label
from negopipe.schema import NonNegativeInt, PositiveInt, schema

Measures = Mapping[str, Any]
"""The measures of one planner in one setting, as `evaluation.metrics.summary` names them."""


@schema
class ReportConfig:
    """What the report stage makes; `conf/report/html.yaml` says what each value means."""

    figure_formats: tuple[Literal["png", "svg", "pdf"], ...]
    n_animations: NonNegativeInt
    animation_fps: Annotated[PositiveInt, Field(le=50)]  # a GIF's frames last hundredths of a second, two at least
    side_by_side: tuple[str, ...]


@dataclass(frozen=True)
class Exhibit:
    """A figure or an animation on the page.

    title: short name
    reading: one or two sentences on how to read it
    image: bytes of an SVG, PNG or GIF
    still: bytes of a PNG that stands in for an animation where the reader wants no motion
    """

    title: str
    reading: str
    image: bytes
    still: bytes | None = None


@dataclass(frozen=True)
class Section:
    """A heading, a text (may be empty) and what is shown under it."""

    title: str
    text: str
    exhibits: Sequence[Exhibit]


@dataclass(frozen=True)
class Provenance:
    """How the page was made: the command line, the seed, the config as YAML, versions by package name."""

    command: str
    seed: int
    config_yaml: str
    versions: Mapping[str, str]


@dataclass(frozen=True)
class _Row:
    """A line of the results table: label, key of the measure, factor, decimals, and which end is good."""

    label: str
    key: str
    factor: float = 1.0
    decimals: int = 1
    best: Literal["max", "min"] | None = None


_ROWS = (
    _Row("success [%]", "success_rate", 100, 1, "max"),
    _Row("collision [%]", "collision_rate", 100, 1, "min"),
    _Row("timeout [%]", "timeout_rate", 100),
    _Row("of these deadlock [%]", "deadlock_rate", 100),
    _Row("ego arrived [%]", "arrival_rate", 100, 1, "max"),
    _Row("driving time of arrivals [s]", "driving_time_s", 1, 1),
    _Row("suspensions [count]", "suspend_count", 1, 2),
    _Row("time at rest [s]", "suspend_time_s", 1, 1),
    _Row("reward (Eq. 3)", "reward", 1, 1, "max"),
    _Row("episodes", "n_episodes", 1, 0),
)


def build_page(
    name: str,
    leading: str,
    evaluation: Mapping[str, Mapping[str, Measures]],
    sections: Sequence[Section],
    provenance: Provenance,
) -> str:
    """The HTML text of the report.

    leading: the setting that comes first
    evaluation: setting -> planner -> measures
    """
    settings = settings_in_order(evaluation, leading)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data_uri"] = data_uri
    return environment.get_template("template.html.j2").render(
        name=name,
        headlines=headlines({setting: evaluation[setting] for setting in settings}),
        tables=[_table(setting, evaluation[setting]) for setting in settings],
        sections=sections,
        provenance=provenance,
    )


def settings_in_order(evaluation: Mapping[str, Any], leading: str) -> list[str]:
    """The leading setting first, the others as they come."""
    return sorted(evaluation, key=lambda setting: setting != leading)


def headlines(evaluation: Mapping[str, Mapping[str, Measures]]) -> list[tuple[str, str]]:
    """The result over all settings, if there are several, then setting by setting."""
    by_setting = [headline(setting, measures) for setting, measures in evaluation.items()]
    planners = list(next(iter(evaluation.values())))
    if len(evaluation) < 2 or len(planners) < 2:
        return by_setting
    return [_overall(evaluation, [planner for planner in planners if planner != ADAPTIVE]), *by_setting]


def _overall(evaluation: Mapping[str, Mapping[str, Measures]], rivals: Sequence[str]) -> tuple[str, str]:
    """Who gets through whatever comes: every planner is taken by its weakest setting."""

    def weakest(planner: str) -> str:
        return min(evaluation, key=lambda setting: evaluation[setting][planner]["success_rate"])

    def measured(planner: str) -> Measures:
        return evaluation[weakest(planner)][planner]

    best = max(rivals, key=lambda planner: measured(planner)["success_rate"])
    ours, theirs = measured(ADAPTIVE), measured(best)
    is_ahead = ours["success_rate"] - theirs["success_rate"] > 2 * _standard_error(ours, theirs)
    verdict = "beats" if is_ahead else "does not beat"
    figures = (
        f"{planner_label(planner)} succeeds in at least "
        f"{100 * measured(planner)['success_rate']:.1f} % of the episodes ({setting_label(weakest(planner)).lower()})"
        for planner in (ADAPTIVE, best)
    )
    text = f"{'; '.join(figures).capitalize()}, the best of the others."
    return f"Over all settings the adaptive planner {verdict} every other one.", text


def headline(setting: str, measures: Mapping[str, Measures]) -> tuple[str, str]:
    """The result in one setting in plain words: the verdict and the figures behind it.

    The adaptive planner is set against the best of the others, by success rate, then by reward. It is level
    with it when the success rates differ by less than two standard errors; then the driving times are told.
    """
    rivals = [planner for planner in measures if planner != ADAPTIVE]
    if not rivals:
        return f"{setting_label(setting)}: {_achievement(ADAPTIVE, measures[ADAPTIVE])}.", ""
    best = max(rivals, key=lambda planner: (measures[planner]["success_rate"], measures[planner]["reward"]))
    ours, theirs = measures[ADAPTIVE], measures[best]
    verdict = f"{setting_label(setting)}: {_verdict(ours, theirs, planner_label(best))}."
    parts = (_achievement(ADAPTIVE, ours), f"{_achievement(best, theirs)} (the best of the others)")
    return verdict, f"{'; '.join(parts).capitalize()}. {ours['n_episodes']} episodes each."


def _verdict(ours: Measures, theirs: Measures, rival: str) -> str:
    ahead = ours["success_rate"] - theirs["success_rate"]
    if abs(ahead) > 2 * _standard_error(ours, theirs):
        n_points = 100 * abs(ahead)
        points = f"{n_points:.{0 if n_points >= 10 else 1}f} points of success rate"
        return f"the adaptive planner {'beats' if ahead > 0 else 'loses to'} {rival} by {points}"
    if not (ours["driving_time_s"] and theirs["driving_time_s"]):
        return f"the adaptive planner and {rival} succeed equally often"
    slower = ours["driving_time_s"] - theirs["driving_time_s"]
    pace = "as fast" if abs(slower) < 0.05 else f"{abs(slower):.1f} s {'slower' if slower > 0 else 'faster'}"
    return f"the adaptive planner succeeds as often as {rival} and is {pace}"


def _standard_error(ours: Measures, theirs: Measures) -> float:
    """Of the difference of two success rates, if both were the same."""
    n_ours, n_theirs = ours["n_episodes"], theirs["n_episodes"]
    pooled = (ours["success_rate"] * n_ours + theirs["success_rate"] * n_theirs) / (n_ours + n_theirs)
    return math.sqrt(pooled * (1 - pooled) * (1 / n_ours + 1 / n_theirs))


def _achievement(planner: str, measures: Measures) -> str:
    time_s = measures["driving_time_s"]
    pace = "the ego never arrives" if time_s is None else f"driving time {time_s:.1f} s"
    success, collision = (100 * measures[key] for key in ("success_rate", "collision_rate"))
    return f"{planner_label(planner)}: {success:.1f} % success, {collision:.1f} % collisions, {pace}"


def _table(setting: str, measures: Mapping[str, Measures]) -> dict[str, Any]:
    """What the template needs of one setting: planner names and rows of formatted numbers."""
    values = {row: [measures[planner][row.key] for planner in measures] for row in _ROWS}
    rows = [
        {
            "label": row.label,
            "cells": [
                {"text": _number(row, value), "is_best": is_best}
                for value, is_best in zip(values[row], _best(row, values[row]), strict=True)
            ],
        }
        for row in _ROWS
    ]
    return {
        "setting": setting_label(setting),
        "planners": [planner_label(planner) for planner in measures],
        "rows": rows,
    }


def _number(row: _Row, value: float | None) -> str:
    return "none" if value is None else f"{row.factor * value:.{row.decimals}f}".replace("-", "\N{MINUS SIGN}")


def _best(row: _Row, values: Sequence[float | None]) -> list[bool]:
    """Which values are the best of their row as printed; none if all are the same."""
    texts = [_number(row, value) for value in values]
    known = [value for value in values if value is not None]
    if row.best is None or not known or len(set(texts)) == 1:
        return [False] * len(values)
    best = _number(row, max(known) if row.best == "max" else min(known))
    return [text == best for text in texts]


def data_uri(image: bytes) -> str:
    """The image as a `data:` URI; its kind is read off its first bytes."""
    kinds = {b"\x89PNG": "png", b"GIF8": "gif", b"<?xm": "svg+xml"}
    return f"data:image/{kinds[image[:4]]};base64,{base64.b64encode(image).decode('ascii')}"
