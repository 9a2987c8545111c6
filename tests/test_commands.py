"""Every command of README.md, CONTRIBUTING.md and docs/ and every script of jobs/ runs, at small size.

Those of a page run in their order in a folder of their own, as a reader would run them.
"""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from documented import PAGES, commands
from mlflow_server import free_port, server

ROOT = Path(__file__).parent.parent
SMALL = (
    "compile=off n_threads=1 scenario.episode_steps=24 "
    "'curriculum.stages=[{name:few,n_iterations:2,families:{yield:${scenario.families.yield}}}]' "
    "curriculum.demonstrations=null algorithm.n_worlds=4 algorithm.n_steps=8 algorithm.minibatch_size=16 "
    "evaluation.n_episodes=4 report.n_animations=0 report.side_by_side=[] report.figure_formats=[png] "
    "behaviour_map.n_episodes=2 "
    "behaviour_map.horizons_s=[0.0,2.0] behaviour_map.styles_s=[2.0] cross_play.n_episodes=2 "
    "oracle.n_episodes=2 oracle.population=2 oracle.rounds=1 benchmark.n_worlds=[1,2] benchmark.base_n_worlds=1 "
    "benchmark.backends=[eager] benchmark.min_time_s=0.01 benchmark.n_latencies=5 benchmark.n_iterations=2"
)
OF_GRIDS = "policy.precision=float32 policy.memory_format=channels_last"
"""Keys that a network of objects does not have."""
FEW = "--overrides compile=off n_threads=1 algorithm.n_worlds=4 algorithm.n_steps=8"
SMALL_JOBS = {
    "jobs/safety.py": f"--tasks 4 --cases yield/yield --layers rss {FEW} scenario.episode_steps=24",
    "jobs/ablation_generalist.py": f"--variants one_street --seeds 1 --iterations 1 --tasks 2 --cases driver_idm {FEW}",
}
CASES = "\n".join(f'  {job}) set -- "$@" {small} ;;' for job, small in SMALL_JOBS.items())
WITH_ALL = "demonstrations|generalist|generalist_grids|mixture|push|yield"
"""Experiments whose baselines are `all`. Their level_k takes a hundred times as long as another one."""
SMALL_PYTHON = f"""#!/usr/bin/env bash
case "$1" in
{CASES}
esac
if [ "$1 $2" = "-m negopipe" ] && [[ " $* " != *" --help "* && " $* " != *" --cfg "* ]]; then
  [[ " $* " == *experiment=unseen* && " $* " != *" +unseen="* ]] && set -- "$@" +unseen=driver_idm,street_tight
  [[ " $* " =~ experiment=({WITH_ALL})" " && " $* " != *baseline=* ]] && set -- "$@" "~evaluation.baselines.level_k"
  [[ " $* " == *hydra/sweeper=optuna* ]] && set -- "$@" hydra.sweeper.n_trials=2
  [[ " $* " =~ (experiment=(generalist|generalist_gpu|unseen|cross_play)|policy=objects)" " ]] || set -- "$@" {OF_GRIDS}
  exec {sys.executable} "$@" {SMALL}
fi
exec {sys.executable} "$@"
"""
"""Stands for python: what follows a command's own settings makes it small, and unseen-v1 has two cases."""
SMALL_TORCHRUN = f"""#!/usr/bin/env bash
OMP_NUM_THREADS=1 exec {sys.executable} -m torch.distributed.run "$@" {SMALL} {OF_GRIDS}
"""
"""Stands for torchrun, whose commands train networks of grids."""

MEASURES = "--wheel-base 2.7 --front-overhang 0.9 --rear-overhang 0.9"
PREFIX = "\"$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')\""
BUILT = "tests/deployment/test_decision_package.py runs it"
NOT_RUN = {
    "make ui": "a server",
    "make play": "a server",
    "python -m negopipe.play play.port=8080 play.participant=p07": "a server",
    "make test": "the tests themselves",
    "make docs-serve": "a server",
    f"python -m negopipe.deployment.ros2_node outputs/export/yield {MEASURES} --record drive.mcap": "a server",
    "python -m negopipe.deployment.replay drive.mcap outputs/export/yield": "needs a recording",
    f"cmake -S examples/cpp -B build/cpp -DCMAKE_PREFIX_PATH={PREFIX}": BUILT,
    "cmake --build build/cpp": BUILT,
    "build/cpp/decide outputs/export/yield": BUILT,
    "bash jobs/tracking_server.sh": "a server, used by the commands after it",
    "source .venv/bin/activate": "the environment of the tests",
    "pre-commit install": "changes the checkout's hooks",
    "nvidia-cuda-mps-control -d": "needs a GPU",
    "python jobs/attainable.py outputs/attainable.csv outputs/unseen-v1": "tests/test_jobs.py runs it, on two cases",
    "bash jobs/peer_environments.sh": "downloads gigabytes",
    "bash jobs/peer_environments.sh build/peers frenetix": "installs what is not negopipe's",
}
EXAMPLES = {
    "outputs/generalist/seed1-1a2b3c4d/checkpoint.safetensors": "pretrained/generalist",
    "checkpoint=<file>": "checkpoint=pretrained/generalist",
}
"""Files that a command takes for example -> what it takes here."""
OF_MAKE = ("ARGS", "MAKEFLAGS", "MAKELEVEL", "MFLAGS")
"""Variables by which `make test-slow ARGS=...` would tell a `make` of the tests its own arguments."""
SILENT = "bash jobs/watch_memory.sh"
"""Writes a table and says nothing."""
NAMING = ("Makefile", "conf/config.yaml", "jobs/README.md", "outputs/README.md")
"""Files that name commands, beside the scripts of jobs/."""
NEEDS = {"joblib": "hydra_plugins.hydra_joblib_launcher", "submitit": "submitit", "ray": "ray", "optuna": "optuna"}
ON_GPU = "experiment=generalist_gpu"
"""Part of the command that needs a GPU."""
EXPORTS = "negopipe.deployment"
"""Part of the commands that need the packages of the extra `export`."""
CARS = "negopipe.deployment.vehicle "
"""Part of the commands that need the packages of the extra `vehicle`."""


def missing_for(command: str) -> str | None:
    """What this machine lacks for a command; None = nothing."""
    if ON_GPU in command and not torch.cuda.is_available():
        return "GPU"
    if EXPORTS in command and importlib.util.find_spec("onnxruntime") is None:
        return "onnxruntime"
    if CARS in command and importlib.util.find_spec("vehiclemodels") is None:
        return "commonroad-vehicle-models"
    engines = {name for name in NEEDS if re.search(rf"(launcher|sweeper)={name}", command)}
    return next((name for name in engines if importlib.util.find_spec(NEEDS[name]) is None), None)


def checkout(folder: Path) -> Path:
    """A folder that looks like a checkout, in which `python` and the Makefile's python are small."""
    for name in ("jobs", "conf", "negopipe"):
        (folder / name).symlink_to(ROOT / name)
    for name in ("Makefile", "pyproject.toml"):
        shutil.copyfile(ROOT / name, folder / name)
    (folder / ".ci").symlink_to(ROOT / ".ci")
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(SMALL_PYTHON)
    python.chmod(0o755)
    torchrun = python.with_name("torchrun")
    torchrun.write_text(SMALL_TORCHRUN)
    torchrun.chmod(0o755)
    (folder / ".venv" / ".ready").touch()
    return folder


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with server(tmp_path_factory.mktemp("server"), free_port()) as uri:
        yield uri


def run(command: str, place: Path, **more: str) -> str:
    inherited = {name: value for name, value in os.environ.items() if name not in OF_MAKE}
    environment = {**inherited, **more, "PATH": f"{place}/.venv/bin:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", command], cwd=place, env=environment, capture_output=True, text=True, timeout=1800, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.parametrize("path", [*sorted((ROOT / "jobs").glob("*.sh")), *(ROOT / name for name in NAMING)], ids=str)
def test_the_modules_that_commands_name_can_be_run(path: Path) -> None:
    for module in re.findall(r"python -m (negopipe[\w.]*\w)", path.read_text(encoding="utf-8")):
        found = importlib.util.find_spec(module)
        assert found is not None, module
        assert found.submodule_search_locations or "__main__" in Path(str(found.origin)).read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem)
def test_the_commands_of_a_page_run(page: Path, tmp_path: Path, address: str, subtests: pytest.Subtests) -> None:
    place = checkout(tmp_path)
    for command in dict.fromkeys(commands(page)):
        if command in NOT_RUN:
            continue
        with subtests.test(command):
            if missing := missing_for(command):
                pytest.skip(f"there is no {missing}")
            here = command.replace("http://127.0.0.1:5000", address)
            for example, known in EXAMPLES.items():
                here = here.replace(example, known)
            assert run(here, place) or command.startswith(SILENT)


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(path.name for path in (ROOT / "jobs").glob("*.sh")))
def test_a_script_of_jobs_runs(script: str, tmp_path: Path, address: str) -> None:
    if script == "tracking_server.sh":
        pytest.skip("is what the address is of")
    if script == "watch_memory.sh":
        pytest.skip("needs arguments: a documented command runs it")
    if script == "peer_environments.sh":
        pytest.skip(NOT_RUN[f"bash jobs/{script}"])
    if script.startswith("slurm_") and shutil.which("sbatch") is None:
        pytest.skip("there is no SLURM")
    if missing := missing_for((ROOT / "jobs" / script).read_text(encoding="utf-8")):
        pytest.skip(f"there is no {missing}")
    where = {"ADDRESS": "local"} if script == "ray_sweep.sh" else {}
    run(f"bash jobs/{script}", checkout(tmp_path), MLFLOW_TRACKING_URI=address, **where)


@pytest.mark.slow
def test_chaos_leaves_every_job_finished_once(tmp_path: Path) -> None:
    said = run("python jobs/chaos.py --jobs 5 --killed 0.4", checkout(tmp_path))
    assert "equal results 5 of 5" in said


@pytest.mark.slow
def test_cartpole_is_solved(tmp_path: Path) -> None:
    assert "acktr: 1 of 1 seeds reach 450" in run("python jobs/cartpole.py --seeds 1", checkout(tmp_path))
