"""report.html: one self-contained file with the results of a run."""

import base64
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jinja2
from pydantic import Field

from negopipe.checks import Problem, check_names
from negopipe.evaluation.hypothesis import Claim, Finding, Verdict
from negopipe.evaluation.names import FixedHorizons
from negopipe.report.headlines import Difference, Measures, Versus
from negopipe.report.labels import setting_label
from negopipe.report.tables import Table, n_episodes, tables
from negopipe.schema import NonNegativeInt, PositiveInt, schema


@schema
class ReportConfig:
    """Options of the report stage; `conf/report/html.yaml` says what each value means."""

    figure_formats: tuple[Literal["png", "svg", "pdf"], ...]
    n_animations: NonNegativeInt
    animation_fps: Annotated[PositiveInt, Field(le=50)]  # a GIF's frames last hundredths of a second, two at least
    side_by_side: tuple[str, ...]
    n_streets: PositiveInt

    def check(self, baselines: Iterable[str]) -> Iterator[Problem]:
        yield from check_names("report.side_by_side", self.side_by_side, baselines, "evaluation.baselines")


@dataclass(frozen=True)
class Results:
    """The numbers of metrics.json, settings in the order of the page.

    evaluation: setting -> planner -> measures
    versus: setting -> planner other than the policy -> differences to it
    regret: setting -> planner -> difference of the oracle to it; empty without an oracle
    """

    evaluation: Mapping[str, Mapping[str, Measures]]
    versus: Mapping[str, Mapping[str, Versus]]
    regret: Mapping[str, Mapping[str, Difference]]


@dataclass(frozen=True)
class Chapter:
    """Tables under a heading with a note, such as the number of episodes."""

    title: str
    note: str
    tables: Sequence[Table]


def chapters(results: Results, fixed_s: FixedHorizons) -> list[Chapter]:
    """One per setting."""
    return [
        Chapter(
            setting_label(setting),
            n_episodes(measures, fixed_s),
            tables(measures, results.versus[setting], results.regret[setting], fixed_s),
        )
        for setting, measures in results.evaluation.items()
    ]


OF_SEVERAL: Mapping[Verdict, str] = {
    "holds": "hold",
    "does not hold": "do not hold",
    "undecided": "undecided",
    "not tested": "not tested",
}
"""Verdict -> its form after a number of claims."""


OPENING_S = 5
"""Time within which the animation at the top tells what happened, at twice its speed at most, s."""
N_BESIDE = 3
"""Headlines beside the animation at the top: as many as are about as high as it; further ones stand below."""

LONG_WORDS = ("suspen-sions", "suspen-sion", "deceler-ation", "avoid-able", "colli-sions", "dead-lock")
"""Words in labels of columns, with a hyphen where a narrow column may break them."""


@dataclass(frozen=True)
class FigureItem:
    """A figure or an animation on the page.

    title: short name
    reading: caption, one or two sentences
    image: bytes of an SVG, PNG or GIF
    still: bytes of a PNG that replaces an animation for readers who prefer no motion
    """

    title: str
    reading: str
    image: bytes
    still: bytes | None = None


@dataclass(frozen=True)
class Section:
    """A heading, a text (may be empty) and the figures under it."""

    title: str
    text: str
    items: Sequence[FigureItem]


@dataclass(frozen=True)
class Provenance:
    """Origin of the page: the command line, the seed or seeds, the config as YAML, versions by package name."""

    command: str
    seed: str
    config_yaml: str
    versions: Mapping[str, str]


def build_page(
    name: str,
    verdicts: Sequence[tuple[str, str]],
    chapters: Sequence[Chapter],
    claims: Sequence[Claim],
    sections: Sequence[Section],
    provenance: Provenance,
    opening: FigureItem | None = None,
) -> str:
    """The HTML text of a report.

    verdicts: headlines, each with its numbers
    claims: the paper's claims; an empty sequence leaves the part out
    opening: animation above the verdicts
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"data_uri": data_uri, "figure": _figure, "hyphenated": _hyphenated}
    return environment.get_template("template.html.j2").render(
        name=name,
        headlines=verdicts,
        chapters=chapters,
        claims=claims,
        tally=_tally(claims),
        sections=sections,
        provenance=provenance,
        opening=opening,
        has_films=opening is not None or any(item.still for section in sections for item in section.items),
        fastest_s=OPENING_S,
        n_beside=N_BESIDE,
    )


def _tally(claims: Sequence[Claim]) -> str:
    """Number of claims per verdict."""
    counts = Counter(claim.verdict for claim in claims)
    told = [f"{counts[verdict]} {words}" for verdict, words in OF_SEVERAL.items() if counts[verdict]]
    return f"Of {len(claims)} claims: {', '.join(told)}."


def _figure(finding: Finding) -> str:
    """The number with its interval."""
    return f"{finding.value:.2f} ({finding.low:.2f} to {finding.high:.2f})"


def _hyphenated(label: str) -> str:
    """The label with soft hyphens in its long words, which narrow columns need."""
    for word in LONG_WORDS:
        label = label.replace(word.replace("-", ""), word.replace("-", "\N{SOFT HYPHEN}"))
    return label


def settings_in_order(evaluation: Mapping[str, Any], leading: str) -> list[str]:
    """The leading setting first, the others in their order."""
    return sorted(evaluation, key=lambda setting: setting != leading)


def data_uri(image: bytes) -> str:
    """The image as a `data:` URI, its type by its first bytes."""
    kinds = {b"\x89PNG": "png", b"GIF8": "gif", b"<?xm": "svg+xml"}
    return f"data:image/{kinds[image[:4]]};base64,{base64.b64encode(image).decode('ascii')}"
