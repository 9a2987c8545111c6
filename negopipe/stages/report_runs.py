"""The report stage over many runs: a comparison of seeds, algorithms or ablations from their files."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from negopipe.report.captions import caption
from negopipe.report.figures import render
from negopipe.report.page import FigureItem, Section, build_page
from negopipe.report.provenance import provenance, write_claims
from negopipe.sweeping.comparison import (
    compare,
    curriculum_claim,
    find_runs,
    group,
    read_groups,
    read_histories,
    short_names,
)
from negopipe.sweeping.learning_curves import learning_curves
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Write report.html on the runs that `runs` names into this run's folder; UserError if there is none."""
    found = find_runs(Path(config.outputs).absolute(), str(config.runs))
    by_overrides = group(found)
    log.info(f"report: {len(found)} runs of {len(by_overrides)} configs")
    short = short_names(by_overrides)
    groups = {short[name]: folders for name, folders in by_overrides.items()}
    verdicts, chapters = compare(read_groups(groups))
    title = f"runs {config.runs}"
    sections = [*([_configs(short)] if list(short) != list(short.values()) else []), _training(groups)]
    tested = [claim for claim in (curriculum_claim(found),) if claim is not None]
    if tested:
        write_claims(tracked, tested)
    page = build_page(title, verdicts, chapters, tested, sections, provenance(config.seed, tracked))
    path = tracked.folder / "report.html"
    write_whole(path, page.encode())
    tracked.log_artifact(path)
    tracked.set_description("\n\n".join(" ".join(lines) for lines in verdicts))
    log.info("report: %s", path)


def _configs(short: dict[str, str]) -> Section:
    """The configs that letters stand for."""
    told = "; ".join(f"{letter}: {overrides}" for overrides, letter in short.items())
    return Section("Configs", f"Differences between the runs. {told}.", [])


def _training(groups: dict[str, list[Path]]) -> Section:
    histories = read_histories(groups)
    if histories.empty:
        return Section("Training", "None of the runs was trained.", [])
    drawing = render(learning_curves(histories), "svg")
    return Section("Training", "", [FigureItem(*caption("learning_curves"), drawing)])
