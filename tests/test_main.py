"""The command line: help, errors in one line, exit codes, and what a stopped process leaves behind."""

import io
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from tracked import Command, ready_at

import negopipe.__main__ as entry
from negopipe.config.root import RunConfig
from negopipe.runtime.interruption import DeferredInterrupt
from negopipe.runtime.workers import side_by_side
from negopipe.tracking.store import TrackedRun


@pytest.fixture
def stored(new_database: Path, tmp_path: Path) -> None:
    """A store without runs in the folder `outputs`."""
    ready_at(new_database, tmp_path / "outputs")


def only_line(text: str) -> str:
    lines = text.splitlines()
    assert len(lines) == 1, text
    return lines[0]


def replace_stage(monkeypatch: pytest.MonkeyPatch, name: str, run: Callable[..., None]) -> None:
    module = ModuleType(f"negopipe.stages.{name}")
    module.run = run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)


def statuses(outputs: Path) -> dict[str, str]:
    """Status in the store by seed."""
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        rows = connection.execute("SELECT name, status FROM runs").fetchall()
    return {name.split("-")[0]: status for name, status in rows}


def test_help_names_the_experiments_and_needs_no_torch() -> None:
    code = "import sys, negopipe.__main__ as m; sys.argv = ['negopipe', '--help']\ntry: m.main()\n"
    code += "except SystemExit: print({'torch', 'mlflow', 'negopipe.config.root'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    experiments = [path.stem for path in (entry.CONF / "experiment").glob("*.yaml")]
    shown = re.search(r"^experiment: (.*)$", result.stdout, flags=re.MULTILINE)
    assert shown is not None
    assert shown[1].split(", ") == sorted(experiments)
    assert result.stdout.splitlines()[-1] == "set()"


def test_the_stages_are_said_before_torch_is_imported() -> None:
    code = "import sys, negopipe.__main__ as m; sys.argv = ['negopipe', 'stages=[oracle,report]']\n"
    code += "def said(*line): sys.exit(' '.join(map(str, [*line, {'torch', 'mlflow'} & set(sys.modules)])))\n"
    code += "m.log.info = said\nm.main()"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.stderr == "stages     %s oracle, report set()\n"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["planner.foo=1"], "planner.foo is not a known key, allowed: braking, clearance, cost, "),
        (["+planner.foo=1"], "planner.foo is not a known key, allowed: braking, clearance, cost, "),
        (["sede=1"], "sede is not a known key, did you mean seed? allowed: algorithm, behaviour_map, "),
        (["+sede=1"], "sede is not a known key, did you mean seed? allowed: algorithm, behaviour_map, "),
        (["planner.horizon_s=-1.0"], "planner.horizon_s must be greater than 0, got -1.0"),
        (["seed=abc"], "seed must be a valid integer, got abc"),
        (["device=tpu"], "device must be one of auto, cpu, cuda, got tpu"),
        (["+experiment=nope"], "experiment must be one of "),
        (
            ["scenario=nope"],
            "scenario must be one of bent_street, commonroad, karlsruhe, lanelet2, long_corridor, narrow_lane, ",
        ),
        (["planner=3"], "Config group override must be a string or a list. Got int, got planner=3"),
        (["seed=[1"], "seed=[1 cannot be read: "),
        (["+seed=1"], "Could not append to config. An item is already at 'seed'."),
        (["seed=1,2"], "Ambiguous value for argument 'seed=1,2', use -m to sweep over them, 'seed=[1,2]' for a list, "),
        (["outputs=a=b"], """outputs=a=b cannot be read: mismatched input '=' expecting <EOF>, try 'outputs="a=b"'"""),
        (
            ["outputs=\udcc3\udca4"],
            "outputs must be UTF-8, got \\udcc3",
        ),
        (["outputs='\udcc3'"], "outputs must be UTF-8, got \\udcc3"),
        (["name=2024_05"], """name must be a valid string, got 202405, try 'name="2024_05"'"""),
        (["runs=yield", "stages=[report]"], "runs is now python -m negopipe.sweeping.compare <outputs>/<name>"),
        (["+runs=yield"], "runs is now python -m negopipe.sweeping.compare <outputs>/<name>"),
        (["outputs=null"], """outputs must be a valid string, got null, try 'outputs="null"'"""),
        (["checkpoint=true"], """checkpoint must be a valid string, got true, try 'checkpoint="true"'"""),
        (
            ["tracking.registered_model=1_0"],
            """tracking.registered_model must be a valid string, got 10, try 'tracking.registered_model="1_0"'""",
        ),
        (["hydra.job.chdir=true"], "hydra.job.chdir must be false, got true: relative paths are relative to where "),
        (
            ["checkpoint=nope"],
            "checkpoint must be an existing file, pretrained, or the id of an MLflow run that saved one, got ",
        ),
        (["-m", "seed=1,2", "planner.horizon_s=-1.0"], "planner.horizon_s must be greater than 0, got -1.0"),
        (["-m", "seed=1,2", "planner.foo=1"], "planner.foo is not a known key, allowed: "),
        (["-m", "seed=1,2", "+planner.foo=1"], "planner.foo is not a known key, allowed: "),
        (["-m", "+experiment=yield,nope"], "experiment must be one of "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_an_error_of_the_user_is_one_line(command: Command, arguments: list[str], line: str) -> None:
    code, _, err = command(*arguments)
    assert code == 1
    assert only_line(err).startswith(line)
    assert not [path for path in Path.cwd().iterdir() if path.name != "outputs"]


def test_different_errors_in_a_sweep_are_all_said(command: Command) -> None:
    code, _, err = command("-m", "planner.horizon_s=-1.0,-2.0")
    assert code == 1
    assert err.splitlines() == [f"planner.horizon_s must be greater than 0, got {x}" for x in ("-1.0", "-2.0")]


def test_a_sweep_is_told_where_it_may_not_change_folders(command: Command) -> None:
    code, _, err = command("-m", "seed=1,2", "hydra.job.chdir=true", "outputs=here")
    assert code == 1
    assert only_line(err).startswith("hydra.job.chdir must be false, got true")
    assert not list(Path.cwd().rglob("mlflow*"))


THREE_IN_ASCII = """
import os, sys, negopipe.__main__ as entry

for folder, *arguments in ((".", sys.argv[1]), (".", sys.argv[2]), ("\\udcc3\\udca4",)):
    os.chdir(folder)
    sys.argv[1:] = arguments
    assert entry.main() == 1
"""


@pytest.mark.slow
def test_a_command_line_that_is_not_read_as_utf8_is_told_so(tmp_path: Path) -> None:
    """... and a folder that is given, and one that is not."""
    latin = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    (tmp_path / "ä").mkdir()
    call = [sys.executable, "-c", THREE_IN_ASCII, "outputs='ä'", "outputs=ä"]
    result = subprocess.run(call, capture_output=True, text=True, cwd=tmp_path, env=latin, check=True)
    said = "outputs must be UTF-8, which is read as ascii here (PYTHONUTF8=1 in front of it mends that), got "
    quoted, plain, here = result.stderr.splitlines()
    assert quoted == plain == f"{said}\\udcc3\\udca4"
    assert here.startswith(said)
    assert [path.name for path in tmp_path.rglob("*")] == ["ä"]


def test_what_stdout_has_no_character_for_is_escaped(
    command: Command, monkeypatch: pytest.MonkeyPatch, new_database: Path, tmp_path: Path
) -> None:
    ready_at(new_database, tmp_path / "ä")
    replace_stage(monkeypatch, "report", lambda config, run: print(config.tracking.experiment))
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    code, _, err = command("stages=[report]", "outputs='ä'", "tracking.experiment='ö'")
    out.flush()
    said = out.buffer.getvalue().decode()  # type: ignore[attr-defined]
    assert (code, err) == (0, "")
    assert "\\xf6\n" in said
    assert re.search(r"^run +\\xe4/", said, flags=re.MULTILINE)
    assert out.errors == "strict"


@pytest.mark.usefixtures("stored")
def test_the_command_line_works_in_a_thread(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def stage(config: RunConfig, run: TrackedRun) -> None:
        with DeferredInterrupt():
            assert side_by_side([lambda: 1, lambda: 2], 2, lambda _: None) == [1, 2]

    replace_stage(monkeypatch, "report", stage)
    with ThreadPoolExecutor(1) as pool:
        code, _, err = pool.submit(command, "stages=[report]").result()
    assert (code, err) == (0, "")


HANDLERS = [signal.SIG_DFL, pytest.param(signal.SIG_IGN, marks=pytest.mark.slow), lambda *_: None]


@pytest.mark.usefixtures("stored")
@pytest.mark.parametrize("handler", HANDLERS)
def test_signal_handlers_stay_as_they_were(command: Command, monkeypatch: pytest.MonkeyPatch, handler: Any) -> None:
    found = []
    replace_stage(monkeypatch, "report", lambda *_: found.append(signal.getsignal(signal.SIGTERM)))
    signal.signal(signal.SIGTERM, handler)
    for arguments in (["stages=[report]"], ["seed=x"], ["--help"]):
        command(*arguments)
        assert signal.getsignal(signal.SIGTERM) == handler
    assert found == [entry._terminate]


@pytest.mark.slow
def test_a_parallel_sweep_says_its_error_once(tmp_path: Path) -> None:
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    call = [sys.executable, "-m", "negopipe", "-m", *launcher, "seed=1,2", "+planner.foo=1"]
    result = subprocess.run([*call, f"outputs={tmp_path}"], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert only_line(result.stderr).startswith("planner.foo is not a known key, allowed: ")


def test_stages_run_in_order_and_paths_are_shown(
    command: Command, monkeypatch: pytest.MonkeyPatch, new_database: Path, tmp_path: Path
) -> None:
    """... and a bug in one of them shows its traceback and leaves a record that says FAILED."""
    ready_at(new_database, tmp_path / "here")
    calls = []

    def stage(name: str) -> Callable[..., None]:
        def run(config: RunConfig, run: TrackedRun) -> None:
            calls.append((name, config.seed, run.folder.is_dir()))
            run.update_metrics_json({name: 1})
            if config.seed == 5:
                raise ZeroDivisionError("a bug")

        return run

    for name in ("train", "oracle", "report"):
        replace_stage(monkeypatch, name, stage(name))
    code, out, err = command("stages=[oracle,report]", "seed=4", "outputs=here")
    assert (code, err) == (0, "")
    assert calls == [("oracle", 4, True), ("report", 4, True)]
    folder = re.search(r"^run +(\S+)$", out, flags=re.MULTILINE)
    assert folder is not None
    assert f"{folder[1]}/metrics.json" in out
    assert [path.name for path in Path.cwd().iterdir()] == ["here"]

    code, out, err = command("stages=[oracle,report]", "seed=5", "outputs=here")
    assert code == 1
    assert "Traceback" in err
    assert "ZeroDivisionError: a bug" in err
    assert statuses(Path("here")) == {"seed4": "FINISHED", "seed5": "FAILED"}


@pytest.mark.usefixtures("stored")
def test_the_recorded_command_is_the_jobs_own(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """... of a sweep its job's, without -m, with the folder of its experiment, and never a later replay's."""
    told = {}

    def stage(config: RunConfig, run: TrackedRun) -> None:
        told[config.seed] = run.commands

    for name in ("evaluate", "replay"):
        replace_stage(monkeypatch, name, stage)
    more = Path("my configs") / "experiment" / "mine.yaml"
    more.parent.mkdir(parents=True)
    given = "policy: {precision: float32, memory_format: channels_last}"  # rather than timed
    more.write_text(f"# @package _global_\nname: mine\n{given}\n")
    where = f"--config-dir '{more.parent.parent.absolute()}'"
    swept = ["-m", "--config-dir", "my configs", "+experiment=mine", "stages=[evaluate]", "seed=1,2"]
    assert command(*swept)[0] == 0
    expected = [f"python -m negopipe {where} +experiment=mine 'stages=[evaluate]' seed={seed}" for seed in (1, 2)]
    assert told == {1: [expected[0]], 2: [expected[1]]}
    later = ["--config-dir", "my configs", "+experiment=mine", "stages=[replay]", "episode=push/adaptive/1", "seed=2"]
    assert command(*later)[0] == 0
    assert told[2][0] == expected[1]
    assert "'stages=[replay]' episode=push/adaptive/1" in told[2][1]
    (record,) = Path("outputs/mine").glob("seed2-*/record.json")
    assert json.loads(record.read_text())["tags"]["overrides"] == expected[1].removeprefix("python -m negopipe ")


FOUR_STARTS = """
import json, os, signal, sys, time, types
import mlflow.store.tracking.sqlalchemy_store, sqlalchemy.orm, negopipe.config.root, negopipe.__main__ as entry

sqlalchemy.orm.configure_mappers()

def stage(config, run):
    os.write(writing, b"r")
    time.sleep(0 if config.seed == 0 else 60)

sys.modules["negopipe.stages.report"] = types.SimpleNamespace(run=stage)
reading, writing = os.pipe()
children = {}
for seed in (0, signal.SIGINT, signal.SIGKILL, signal.SIGTERM):
    children[seed] = os.fork()
    if children[seed] == 0:
        sys.argv = ["negopipe", "stages=[report]", f"seed={int(seed)}"]
        sys.exit(entry.main())
for _ in children:
    os.read(reading, 1)
time.sleep(0.2)
for seed, child in children.items():
    if seed:
        os.kill(child, seed)
codes = {int(seed): os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for seed, child in children.items()}
print(json.dumps(codes))
"""
"""Imports once, then forks four command lines that start at the same moment, in an empty folder. Each says
when its stage runs; then they get the signal that their seed is the number of."""


@pytest.mark.slow
def test_four_processes_start_at_once_and_end_in_four_ways(tmp_path: Path) -> None:
    call = [sys.executable, "-c", FOUR_STARTS]
    result = subprocess.run(call, capture_output=True, text=True, check=True, cwd=tmp_path)
    codes = json.loads(result.stdout.splitlines()[-1])
    assert codes == {"0": 0, str(int(signal.SIGINT)): 130, str(int(signal.SIGKILL)): -9, "15": 143}
    assert only_line(result.stderr) == "interrupted"
    assert statuses(tmp_path / "outputs") == {
        "seed0": "FINISHED",
        f"seed{signal.SIGINT:d}": "KILLED",
        f"seed{signal.SIGTERM:d}": "KILLED",
        f"seed{signal.SIGKILL:d}": "RUNNING",  # the next start closes it (tracking/test_store.py)
    }
