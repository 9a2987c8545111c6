"""negopipe beside its peers: workloads in processes of their own, who is left out, ratios, tables, the catalogue."""

import importlib
import json
import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from negopipe.benchmark.peers import __main__ as command
from negopipe.benchmark.peers.catalogue import OWN, PEERS, PYTHON_ROBOTICS, Peer, Workload
from negopipe.benchmark.peers.comparison import Comparison, compare, python_of
from negopipe.benchmark.peers.serve import measured
from negopipe.benchmark.peers.tables import show, write_json, write_table
from negopipe.benchmark.peers.worker import Worker
from negopipe.errors import UserError

ROOT = Path(__file__).parents[2]

FAKE = """
LIBRARIES = ("json",)
PACKAGES = ()
def start(options):
    if "broken" in options:
        raise ValueError("no licence")
    print("a library says hello")
    calls = []
    def work():
        calls.append(1)
        if "dies" in options and len(calls) > 1:
            raise RuntimeError("out of memory")
        sum(range(options["n"]))
        return 3
    return work, {"n_candidates": 3}
"""
"""A workload of `n` additions for three units of work."""


class FakePeer(Peer):
    folder = Path()

    @property
    def path(self) -> Path:
        return self.folder / f"{self.file}.py"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(FakePeer, "folder", tmp_path)
    (tmp_path / "fake.py").write_text(FAKE)
    return tmp_path


def peer(name: str, n: int, module: str = "json", **options: object) -> FakePeer:
    differs = "it adds more"
    return FakePeer(name, "fake", "sums", {"n": n, **options}, module, module, ("ours",), differs)


def compared(folder: Path) -> Comparison:
    """A peer that is slower, one that fails and one that is not installed."""
    peers = [peer("slow", 200_000), peer("broken", 1, broken=True), peer("absent", 1, module="no_such_module")]
    owns: list[Workload] = [peer("ours", 20_000), peer("not asked for", 1)]
    return compare(owns, peers, folder / "environments", n_rounds=3, seconds=0.02)


def test_a_worker_answers_whatever_its_libraries_print(fake: Path) -> None:
    worker = Worker(sys.executable, fake / "fake.py", {"n": 1000})
    try:
        assert worker.start.facts == {"n_candidates": 3}
        assert worker.start.versions == {"Python": sys.version.split()[0]}
        done = worker.measure(0.01)
        assert done.n_units == 3 * done.n_calls > 0
        assert done.cpu_s >= 0.01
        assert done.per_cpu_s == pytest.approx(done.n_units / done.cpu_s)
        assert 0 <= done.cpu_p50_ms <= done.cpu_p99_ms
    finally:
        worker.close()


def test_a_worker_that_fails_says_why(fake: Path) -> None:
    with pytest.raises(UserError, match="fake: ValueError: no licence"):
        Worker(sys.executable, fake / "fake.py", {"broken": True})


def test_a_peer_runs_without_our_path(fake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (fake / "fake.py").write_text(
        "import os, sys\nLIBRARIES = PACKAGES = ()\n"
        "def start(options):\n"
        "    return lambda: 1, {'path': os.environ.get('PYTHONPATH'), 'threads': os.environ['OMP_NUM_THREADS'],"
        " 'serve': 'negopipe/benchmark/peers' in ' '.join(sys.path)}\n"
    )
    monkeypatch.setenv("PYTHONPATH", "somewhere")
    python = fake / "environment" / "python"
    python.parent.mkdir()
    python.symlink_to(sys.executable)
    told = {}
    for name in (str(python), sys.executable):
        worker = Worker(name, fake / "fake.py", {})
        worker.close()
        told[name] = worker.start.facts
    assert told[str(python)] == {"path": None, "threads": "1", "serve": False}
    assert told[sys.executable]["path"] == "somewhere"


def test_percentiles_are_of_single_calls() -> None:
    durations = iter([0.05])

    def work() -> int:
        end = time.process_time() + next(durations, 0.0002)  # the first call takes long
        while time.process_time() < end:
            pass
        return 2

    figures = measured(work, 0.1)
    assert figures["n_units"] == 2 * figures["n_calls"]
    assert figures["cpu_p99_ms"] < 50 <= 1e3 * figures["cpu_s"] / 2
    assert figures["cpu_p50_ms"] == pytest.approx(0.2, rel=0.5)


def test_ratios_come_from_rounds_side_by_side(fake: Path) -> None:
    comparison = compared(fake)
    kept: list[int] = []
    groups = [peer("slow", 1), replace(peer("alone", 1), beside=("ours", "not asked for"))]
    owns: list[Workload] = [peer("ours", 1), peer("not asked for", 1)]
    compare(owns, groups, fake, 1, 0.01, keep=lambda so_far: kept.append(len(so_far.ratios)))
    assert kept == [1, 3]
    (ratio,) = comparison.ratios
    assert (ratio.own.name, ratio.peer.name) == ("ours", "slow")
    assert 1 < ratio.low <= ratio.median <= ratio.high
    assert comparison.measured.keys() == {"slow", "ours"}
    assert {len(one.rounds) for one in comparison.measured.values()} == {3}
    assert comparison.left_out["broken"] == "fails: fake: ValueError: no licence"
    assert comparison.left_out["absent"].startswith("not installed: no no_such_module in ")


def test_a_peer_that_fails_in_a_round_is_left_out(fake: Path) -> None:
    peers = [peer("mortal", 1, dies=True), peer("other", 1)]
    comparison = compare([peer("ours", 1)], peers, fake / "environments", n_rounds=2, seconds=0.01)
    assert comparison.left_out == {"mortal": "fails: fake: RuntimeError: out of memory"}
    assert [ratio.peer.name for ratio in comparison.ratios] == ["other"]
    with pytest.raises(UserError, match="out of memory"):
        compare([peer("ours", 1, dies=True)], [peer("other", 1)], fake / "environments", n_rounds=1, seconds=0.01)


def test_a_comparison_is_shown_and_written(fake: Path) -> None:
    comparison, console = compared(fake), Console(width=200, record=True)
    show(comparison, console)
    said = console.export_text()
    assert "slow: not the same: it adds more" in said
    assert "broken: fails: fake: ValueError: no licence" in said
    write_json(fake / "peers.json", comparison, 3, 0.02)
    content = json.loads((fake / "peers.json").read_text())
    assert content["made"]["n_rounds"] == 3
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", content["made"]["date"])
    assert content["measured"]["slow"]["start"]["facts"] == {"n_candidates": 3}
    assert len(content["measured"]["slow"]["rounds"]) == 3
    assert content["left_out"].keys() == {"broken", "absent"}
    write_table(fake / "peers.csv", comparison)
    (row,) = pd.read_csv(fake / "peers.csv").to_dict("records")
    assert row["ratio"] == pytest.approx(comparison.ratios[0].median, rel=1e-3)
    assert row["own_per_s"] > row["peer_per_s"]


def test_with_nothing_installed_nothing_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "PEERS", [replace(each, module="no_such_module") for each in PEERS])
    assert command.main(["--environments", str(tmp_path), "--out", str(tmp_path / "peers.json")]) == 0
    content = json.loads((tmp_path / "peers.json").read_text())
    assert content["measured"] == {}
    assert content["left_out"].keys() == {each.name for each in PEERS}
    assert "VMAS, 200 worlds: not installed" in capsys.readouterr().out


def test_a_wrong_argument_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--only", "vmas,carla"]) == 1
    assert "--only must name some of frenetix, " in (said := capsys.readouterr().err)
    assert said.endswith("got carla\n")
    assert command.main(["--rounds", "0"]) == 1
    assert "--rounds and --seconds must be above 0, got 0 and 1" in capsys.readouterr().err


def test_an_environment_comes_before_this_python(tmp_path: Path) -> None:
    one = peer("one", 1)
    assert python_of(one, tmp_path) == sys.executable
    python = tmp_path / "json" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    assert python_of(one, tmp_path) == str(python)


def test_python_robotics_needs_its_folder() -> None:
    named = {each.name: each for each in command.chosen("vmas,python_robotics", "checkout")}
    assert named["PythonRobotics"].options == {"folder": "checkout"}
    assert named.keys() == {"PythonRobotics", "VMAS, 200 worlds"}
    comparison = compare(OWN, command.chosen(PYTHON_ROBOTICS, None), Path("none"), 1, 0.01)
    assert comparison.left_out["PythonRobotics"].startswith("not measured: --python-robotics <folder")


@pytest.mark.parametrize("each", [*OWN, *PEERS], ids=lambda each: each.name)
def test_the_catalogue_is_complete(each: Workload) -> None:
    module = importlib.import_module(f"negopipe.benchmark.peers.workloads.{each.file}")
    assert Path(str(module.__file__)) == each.path
    assert module.LIBRARIES
    assert callable(module.start)
    if isinstance(each, Peer):
        assert set(each.beside) <= {own.name for own in OWN}
        assert {own.unit for own in OWN if own.name in each.beside} == {each.unit}
        pins = (ROOT / "jobs" / "peers" / f"{each.environment}.txt").read_text().lower()
        assert [name for name in module.PACKAGES if f"\n{name}==" not in pins.replace("_", "-")] == []


def test_our_own_workloads_count_their_work() -> None:
    planner = importlib.import_module("negopipe.benchmark.peers.workloads.negopipe_planner")
    plan, facts = planner.start({"n_plans": 3, "is_compiled": False})
    assert plan() == 3 * 216
    assert facts == {"n_candidates": 216, "n_times": 30}
    environment = importlib.import_module("negopipe.benchmark.peers.workloads.negopipe_environment")
    decide, facts = environment.start({"n_worlds": 2, "observation": "objects"})
    assert decide() == 2
    assert facts["n_vehicles"] == 2
