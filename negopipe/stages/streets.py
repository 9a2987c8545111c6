"""The streets stage: maps of the streets that a scenario draws, for a look at what is trained on."""

import logging
from typing import TYPE_CHECKING

from negopipe.report.figures import render
from negopipe.report.street_figures import street_maps
from negopipe.simulation.build_road import build_road

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Writes figures/streets_training.* and figures/streets_held_out.*."""
    folder = tracked.folder / "figures"
    folder.mkdir(exist_ok=True)
    for name, drawn in street_maps(config.scenario, build_road(config.scenario), config.report.n_streets).items():
        for format_ in config.report.figure_formats:
            path = folder / f"{name}.{format_}"
            path.write_bytes(render(drawn, format_))
            tracked.log_artifact(path, folder.name)
            log.info("streets: %s", path)
