"""Recordings: read as written, refused where they are none, and driven again to the same trajectories."""

from collections import Counter
from pathlib import Path

import pytest
import ros_packages  # noqa: F401
from mcap.reader import make_reader
from mcap.writer import Writer
from ros_drives import BEGIN_NS, VEHICLE, Losses, drive, in_process, odometry, on_own_street
from runtime_drives import GENERALIST, negotiator
from test_planning_node import Scene

from negopipe.deployment import Negotiator, replay
from negopipe.deployment.manifest import MANIFEST_NAME, manifest_text
from negopipe.deployment.middleware import again
from negopipe.deployment.middleware.codec import definition
from negopipe.deployment.middleware.interface import DEBUG, ODOMETRY, OUTPUTS, TOPICS, TRAJECTORY
from negopipe.deployment.middleware.planning_node import PlanningNode
from negopipe.deployment.middleware.recording import SEED, Recording, about, messages
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.errors import UserError

N_STEPS = 12


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with losses, of the policy on its own street."""
    path = tmp_path_factory.mktemp("recorded") / "drive.mcap"
    with Recording(path, VEHICLE.as_texts() | {SEED: "0"}) as file:
        drive(in_process(PlanningNode(on_own_street(), VEHICLE, 0.2), file), N_STEPS, seed=1, losses=Losses(2))
    return path


def test_a_recording_is_read_in_the_order_in_which_it_was_written(recorded: Path) -> None:
    found = list(messages(recorded))
    counted = Counter(topic.name for topic, _ in found)
    assert counted.keys() == TOPICS.keys()
    assert counted[TRAJECTORY.name] == counted[DEBUG.name]
    names = [topic for topic, _ in found]
    for index in [index for index, topic in enumerate(names) if topic is TRAJECTORY]:
        assert names[index - 1] is ODOMETRY
        assert tuple(names[index : index + 3]) == OUTPUTS
    assert Vehicle.of_texts(about(recorded)) == VEHICLE


def test_foxglove_finds_schemas_of_ros_2(recorded: Path) -> None:
    with recorded.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    for name, schema in schemas.items():
        assert (schema.name, schema.encoding) == (TOPICS[name].type_name, "ros2msg")
        assert schema.data.decode() == definition(schema.name)


def test_a_replay_gives_the_recorded_trajectories(recorded: Path) -> None:
    done = again.replay(recorded, on_own_street())
    assert 5 < done.n_trajectories < N_STEPS  # some odometries are lost
    assert (done.n_equal, done.n_decisions, done.n_unpaired) == (done.n_trajectories, done.n_trajectories, 0)
    assert done.is_same


@pytest.mark.parametrize(("seed", "is_same"), [(5, True), (6, False)])
def test_a_drive_with_drawn_horizons_is_replayed_by_its_seed(seed: int, is_same: bool, tmp_path: Path) -> None:
    path, drawn = tmp_path / "drive.mcap", (*GENERALIST, "evaluation.action=sample")
    with Recording(path, VEHICLE.as_texts() | {SEED: "5"}) as file:
        drive(in_process(PlanningNode(negotiator(*drawn, seed=5), VEHICLE, 0.2), file), N_STEPS, seed=5)
    done = again.replay(path, negotiator(*drawn, seed=seed))
    assert again.seed_of(path) == 5
    assert done.is_same == is_same
    assert (done.n_equal == done.n_trajectories > 5) == is_same


def test_a_recording_without_a_seed_is_refused(tmp_path: Path) -> None:
    with Recording(tmp_path / "drive.mcap", VEHICLE.as_texts()):
        pass
    with pytest.raises(UserError, match=r"drive\.mcap must hold the seed of its drawn horizons, got 'seed'"):
        again.seed_of(tmp_path / "drive.mcap")


def test_a_replay_of_another_runtime_says_how_far_its_plans_are(recorded: Path) -> None:
    other = on_own_street()
    decide = other._decide
    other._decide = lambda arguments: (said := dict(decide(arguments))) | {"trajectory": said["trajectory"] + 0.25}
    done = again.replay(recorded, other)
    assert (done.n_equal, done.is_same) == (0, False)
    assert done.largest_m > 0.25


def test_decisions_without_a_trajectory_are_replayed_too(tmp_path: Path) -> None:
    scene, path = Scene(has_street=False), tmp_path / "drive.mcap"
    with Recording(path, VEHICLE.as_texts()) as file:
        in_process(scene.node, file)([(ODOMETRY, odometry(scene.ego(BEGIN_NS), BEGIN_NS))], BEGIN_NS)
    done = again.replay(path, on_own_street())
    assert (done.n_decisions, done.n_trajectories, done.n_unpaired) == (1, 0, 0)


def test_the_command_compares(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Negotiator, "load", staticmethod(lambda folder, seed: on_own_street()))
    (tmp_path / MANIFEST_NAME).write_text(manifest_text({}, tmp_path, []))
    assert replay.main([str(recorded), str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "the recording was made with another export"
    assert "trajectories are the same bit for bit" in lines[1]
    assert lines[2] == "largest difference 0 m, 0 m/s"


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path, recorded: Path) -> None:
    damaged, foreign = tmp_path / "damaged.mcap", tmp_path / "foreign.mcap"
    damaged.write_bytes(recorded.read_bytes()[:-100])
    with foreign.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    for path, message in (
        (tmp_path / "none.mcap", "must be a file that can be read"),
        (damaged, "must be a whole MCAP file"),
        (foreign, "got an MCAP file of others"),
    ):
        with pytest.raises(UserError, match=message):
            again.replay(path, on_own_street())
    with pytest.raises(UserError, match="record must be a file that can be written"):
        Recording(tmp_path / "no folder" / "drive.mcap", {})
