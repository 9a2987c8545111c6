"""The export stage: the run's policy as files for hosts without negopipe."""

import logging
from typing import TYPE_CHECKING

from negopipe.deployment.export import export
from negopipe.stages.evaluate import checkpoint_of

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Writes the folder export/ of the run."""
    folder = tracked.folder / "export"
    for path in export(config, checkpoint_of(config, tracked), folder):
        tracked.log_artifact(path, folder.name)
        log.info("export: %s", path)
