"""The command of the node: it runs until it is told to end, and says in one line what is wrong."""

import logging
import os
import signal
from pathlib import Path

import pytest
import ros_packages  # noqa: F401
from games import tiny_config
from ros_drives import LOOPBACK, VEHICLE
from runtime_drives import straight_on

from negopipe.config.root import as_mapping
from negopipe.deployment import Negotiator, extras, ros2_node
from negopipe.deployment.manifest import MANIFEST_NAME, manifest_text
from negopipe.deployment.middleware.recording import about
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.deployment.settings import Settings
from negopipe.errors import UserError

MEASURES = ["--wheel-base", "2.7", "--front-overhang", "0.9", "--rear-overhang", "0.9"]


class Ending(logging.Handler):
    """Ctrl-C as soon as the node listens."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.getMessage().startswith("listens"):
            os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What stands for an export."""
    runtime = Negotiator(Settings.of(as_mapping(tiny_config("yield"))), straight_on, lambda tables: {})
    monkeypatch.setattr(Negotiator, "load", staticmethod(lambda folder, seed: runtime))
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(100 + os.getpid() % 100))
    (tmp_path / MANIFEST_NAME).write_text(manifest_text({}, tmp_path, []))
    return tmp_path


def test_it_runs_until_ctrl_c_and_closes_its_recording(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "negopipe")
    log, ending = logging.getLogger("negopipe"), Ending()
    log.addHandler(ending)
    try:
        assert ros2_node.main([str(folder), *MEASURES, "--seed", "7", "--record", str(folder / "drive.mcap")]) == 0
    finally:
        log.removeHandler(ending)
    kept = about(folder / "drive.mcap")
    assert Vehicle.of_texts(kept) == VEHICLE
    assert len(kept["export"]) == 64
    assert kept["seed"] == "7"


@pytest.mark.parametrize(
    ("more", "environment", "message"),
    [
        (["--wheel-base", "3.2"], "0", "must be at most the export's 4.5 m, got 5 m"),
        (["--remap", "/a:=/b"], "0", "remap must be FROM:=/to with FROM among /planning/negopipe/street"),
        (["--remap", "/planning/trajectory"], "0", "got /planning/trajectory"),
        ([], "233", "ROS_DOMAIN_ID must be a whole number from 0 to 232, got 233"),
    ],
    ids=["length", "no topic", "no other name", "domain"],
)
def test_what_is_wrong_is_said_in_one_line(
    more: list[str],
    environment: str,
    message: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", environment)
    assert ros2_node.main([str(folder), *MEASURES, *more]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_topics_get_other_names() -> None:
    assert ros2_node.names(["/planning/trajectory:=/b"]) == {"/planning/trajectory": "/b"}


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(extras.EXTRAS, "middleware", ("json", "no_such_package"))
    with pytest.raises(UserError, match="got no no_such_package"):
        extras.need("middleware")
