"""Streets of a host: the tables that the simulator's streets have, in the host's frame; the example of a vehicle."""

from pathlib import Path

import numpy as np
import pytest
from runtime_drives import HEADING, ORIGIN, negotiator, parts
from test_examples import main_of

from negopipe.deployment import HostStreet, Negotiator, speed
from negopipe.deployment.decision import needs
from negopipe.deployment.decision_file import StreetInputs, street_of
from negopipe.deployment.manifest import MANIFEST_NAME, manifest_text
from negopipe.deployment.onnx_session import Graph
from negopipe.errors import UserError

X = np.linspace(-60.0, 60.0, 121)
PARKED = np.array([[at, y, 0.0, 3.6, 1.9] for at in (-4.2, 0.0, 4.2) for y in (2.55, -2.55)])


def kerb(y: float) -> np.ndarray:
    return np.column_stack([X, np.full_like(X, y)])


def turned(poses: np.ndarray) -> np.ndarray:
    """Places, or poses, of the street's frame on the host's map."""
    cos, sin = np.cos(HEADING), np.sin(HEADING)
    moved = np.array(poses)
    moved[:, :2] = ORIGIN + poses[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    if poses.shape[1] > 2:
        moved[:, 2] += HEADING
    return moved


def between(parked: np.ndarray) -> HostStreet:
    return negotiator("safety=rss").street_between(turned(kerb(3.5)), turned(kerb(-3.5)), turned(parked))


def test_tables_are_those_that_the_simulator_makes() -> None:
    config, game, _ = parts("safety=rss")
    street = negotiator("safety=rss").street(street_of(game.simulator.road, 1), 1.0, ORIGIN, HEADING)
    expected = StreetInputs(config, game).of(1)
    for name in needs(config):
        np.testing.assert_array_equal(street.tables[name], expected[name], err_msg=name)


def test_a_street_between_kerbs_is_that_of_the_simulator() -> None:
    """The simulator's street of 7 m with three cars on each side; its corridor reaches from -6 to 6 m."""
    street, made = between(PARKED), StreetInputs(*parts("safety=rss")[:2]).of(1)
    np.testing.assert_allclose(street.origin, ORIGIN, atol=0.3)
    assert street.heading == pytest.approx(HEADING, abs=1e-3)
    assert street.tables["corridor"][0] == pytest.approx(made["corridor"][0], abs=1.5)
    np.testing.assert_allclose(np.abs(street.tables["near_kerbs"][0]), 3.5, atol=2e-3)
    cars = street.tables["parked"][0, :6, :2]
    np.testing.assert_allclose(cars[np.lexsort(cars.T)], PARKED[np.lexsort(PARKED[:, :2].T), :2], atol=0.3)
    for name in ("waiting", "leaving"):
        np.testing.assert_allclose(street.tables[name][:, 0], made[name][:, 0], atol=3.0)  # routes begin earlier


def test_poses_come_back_from_the_streets_frame() -> None:
    street, poses = between(PARKED), np.array([[310.0, -30.0, 3.0, 5.0], [290.0, -50.0, -3.0, 1.0]])
    np.testing.assert_allclose(street.to_host(street.to_street(poses)), poses, atol=1e-9)
    np.testing.assert_allclose(street.to_street(np.array([*street.origin, street.heading]))[:3], 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("parked", "message"),
    [
        (PARKED[:1] + np.array([0.0, 0.0, 0.0, 0.0, 0.0]), "has no narrow place"),
        (PARKED + np.array([0.0, 0.0, 0.0, 0.0, 2.0]), "a vehicle needs"),
        (PARKED * np.nan, "parked must be finite numbers"),
        (PARKED[:, :4], r"parked must be finite numbers of shape \[n, 5\], got shape \[6, 4\]"),
    ],
    ids=["no corridor", "too narrow", "NaN", "columns"],
)
def test_a_street_that_cannot_be_is_refused(parked: np.ndarray, message: str) -> None:
    with pytest.raises(UserError, match=message):
        between(parked)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_kerb_without_two_points_is_refused(n: int) -> None:
    left = np.tile(turned(kerb(3.5))[:1], (n, 1))  # of one place
    with pytest.raises(UserError, match="left must be a kerb of at least 2 different points"):
        negotiator("safety=rss").street_between(left, turned(kerb(-3.5)), turned(PARKED))


def test_a_direction_is_one_of_two() -> None:
    _, game, _ = parts()
    with pytest.raises(UserError, match="direction must be 1"):
        negotiator().street(street_of(game.simulator.road, 1), 2.0, ORIGIN, HEADING)


def test_the_example_of_a_vehicle_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(Negotiator, "load", staticmethod(lambda folder, backend="onnxruntime": negotiator()))
    main_of("vehicle")("export")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 10
    assert all("m/s  none" in line for line in lines)


def test_the_command_of_speed_measures_decisions(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(Negotiator, "load", staticmethod(lambda folder, backend="onnxruntime": negotiator()))
    monkeypatch.setattr(speed, "N_WARM_UP", 1)
    monkeypatch.setattr(speed, "_import_s", lambda backend: 0.5)
    assert speed.main(["some/export", "--decisions", "3", "--table", str(tmp_path / "speed.csv")]) == 0
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert printed["n_decisions"] == "3"
    assert 0 < float(printed["p50_ms"]) <= float(printed["p99_ms"])
    assert (tmp_path / "speed.csv").read_text().splitlines()[1].startswith("export,3,")


def test_an_export_without_a_decision_is_refused(tmp_path: Path) -> None:
    (tmp_path / MANIFEST_NAME).write_text(manifest_text({"config": {}}, tmp_path, []))
    with pytest.raises(UserError, match=r"must hold decision\.onnx"):
        Negotiator.load(tmp_path)


def test_a_file_that_is_no_graph_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    (tmp_path / "decision.onnx").write_bytes(b"no graph")
    with pytest.raises(UserError, match="must be a file that onnxruntime"):
        Graph(tmp_path / "decision.onnx")
