"""A store that the tests of a module share: creating one takes MLflow a second or two."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tracked import ready_at

from negopipe.tracking.store import TrackingConfig

TRACKING = TrackingConfig(
    uri=None,
    experiment="tests",
    registered_model=None,
    n_metrics_per_flush=1000,
    flush_period_s=3600.0,
    snapshot_period_s=60.0,
    n_snapshots=2,
)


@dataclass(frozen=True)
class Config:
    """The part of the root config that tracking sees."""

    outputs: str
    name: str = "case"
    tracking: TrackingConfig = field(default=TRACKING)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    return Config(outputs=str(tmp_path_factory.mktemp("outputs")))


@pytest.fixture
def empty(tmp_path: Path) -> Config:
    return Config(outputs=str(tmp_path / "outputs"))


@pytest.fixture
def ready(tmp_path: Path, new_database: Path) -> Config:
    """Outputs with a store without runs."""
    config = Config(outputs=str(tmp_path / "outputs"))
    ready_at(new_database, Path(config.outputs))
    return config
