"""The wheel in an environment without the repository: all files are in it, and it works from any folder."""

import os
import subprocess
import sys
import venv
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[1]
INSTALLED = [path for path in sys.path if Path(path).name == "site-packages"]
"""Where the packages lie that negopipe needs."""

pytestmark = pytest.mark.slow

USE = """
import gymnasium, negopipe
from negopipe.deployment import Negotiator
print(negopipe.__file__)
env = negopipe.make_env(["scenario.episode_steps=4"])
print(env.reset(seed=1)[0].shape, gymnasium.make("negopipe/Push-v0", overrides=["scenario.episode_steps=4"]).spec.id)
print(negopipe.load_policy("pretrained/yield").act(env.reset(seed=1)[0]))
"""

PLAY = """
import json, subprocess, sys, urllib.request
command = [sys.executable, "-m", "negopipe.play", "play.port=0", "play.opens_browser=false", "scenario.episode_steps=1"]
server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
address = next(word for word in server.stdout.readline().split() if word.startswith("http"))

def ask(path, value=None):
    body = None if value is None else json.dumps(value).encode()
    request = urllib.request.Request(f"{address}{path}", body, {"Content-Type": "application/json"})
    return urllib.request.urlopen(request).read()

assert b"<canvas" in ask("/")
begun = json.loads(ask("/api/encounters", {"opponent": "yield", "street": "narrow_lane", "control": "pedals"}))
print(json.loads(ask(f"/api/encounters/{begun['id']}/step", {"step": 0, "command": "go"}))["outcome"])
server.terminate()
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(command, check=True)
    (built,) = folder.glob("*.whl")
    return built


Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def anywhere(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """An empty folder, and a function that runs Python there in an environment with the wheel and what it needs."""
    home, folder = tmp_path_factory.mktemp("environment"), tmp_path_factory.mktemp("anywhere")
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    (site,) = home.glob("lib/python*/site-packages")
    (site / "needed.pth").write_text("\n".join(INSTALLED))  # a path alone: .pth files over there are not read
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], check=True)
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}

    def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
        command = [str(python), *arguments]
        return subprocess.run(command, cwd=folder, env=clean, capture_output=True, text=True, timeout=600)

    return folder, run


def test_all_files_of_the_package_and_its_configs_are_in_the_wheel(wheel: Path) -> None:
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "negopipe", "conf"], capture_output=True, text=True, check=True
    )
    files = {f"negopipe/{name}" if name.startswith("conf/") else name for name in listed.stdout.split()}
    with ZipFile(wheel) as packed:
        assert files <= set(packed.namelist())


def test_environments_and_policies_work_anywhere(anywhere: tuple[Path, Run]) -> None:
    folder, run = anywhere
    used = run("-c", USE)
    assert used.returncode == 0, used.stderr
    where, made, action = used.stdout.splitlines()
    assert not Path(where).is_relative_to(ROOT)
    assert "site-packages" in where
    assert made == "(4, 84, 84) negopipe/Push-v0"
    assert action in "0123"
    assert not list(folder.iterdir())  # nothing is written that was not asked for


def test_the_pipeline_and_a_replay_work_anywhere(anywhere: tuple[Path, Run]) -> None:
    folder, run = anywhere
    for more in ((), ("stages=[replay]", "episode=yield/fixed_6/1")):
        done = run("-m", "negopipe", "+experiment=smoke", "n_threads=1", *more)
        assert done.returncode == 0, done.stdout + done.stderr
    assert [path.name for path in folder.iterdir()] == ["outputs"]
    (made,) = (folder / "outputs" / "smoke").iterdir()
    assert 1e5 < (made / "report.html").stat().st_size < 5e6
    assert (made / "replays" / "yield_fixed_6_1.gif").is_file()
    assert str(ROOT) not in (made / "config.yaml").read_text() + (made / "record.json").read_text()


def test_a_person_can_drive_anywhere(anywhere: tuple[Path, Run]) -> None:
    folder, run = anywhere
    driven = run("-c", PLAY)
    assert driven.returncode == 0, driven.stderr
    assert driven.stdout.split() == ["timeout"]
    assert len(list((folder / "outputs" / "play" / "encounters").iterdir())) == 1


def test_an_export_works_anywhere_or_says_what_is_missing(anywhere: tuple[Path, Run]) -> None:
    folder, run = anywhere
    arguments = ("pretrained/yield", "exported", "+experiment=yield", "export.n_selftest=8")
    done = run("-m", "negopipe.deployment.export", *arguments)
    if find_spec("onnxscript") is None or find_spec("onnxruntime") is None:
        assert done.returncode == 1
        assert "pip install 'negopipe[export]'" in done.stderr
        return
    assert done.returncode == 0, done.stderr
    assert (folder / "exported" / "policy.onnx").is_file()
    checked = run("-m", "negopipe.deployment.verify", "exported")
    assert checked.returncode == 0, checked.stdout + checked.stderr
