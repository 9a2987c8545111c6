"""Every launcher really runs a sweep: what fails is told in one line, and the rest is done all the same."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

LAUNCHERS = {
    "joblib": ["hydra.launcher.n_jobs=2"],
    "submitit_local": [],
    "ray": [
        "hydra.launcher.ray.init.address=local",  # or it would join a cluster that this machine is part of
        "+hydra.launcher.ray.init.num_cpus=2",
        "+hydra.launcher.ray.init.include_dashboard=false",
    ],
}
TINY_RUN = ["+experiment=smoke", "stages=[train]", "n_threads=1"]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_job_that_fails_is_told_and_the_others_are_run(launcher: str, tmp_path: Path) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.removesuffix('_local')}_launcher")
    call = [sys.executable, "-m", "negopipe", "-m", f"hydra/launcher={launcher}", *LAUNCHERS[launcher], *TINY_RUN]
    values = ["planner.horizon_s=-1.0,-2.0,6.0", f"outputs={tmp_path}/outputs"]
    quiet = {"HOME": str(tmp_path), "RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}
    result = subprocess.run([*call, *values], capture_output=True, text=True, check=False, env=os.environ | quiet)
    assert result.returncode == 1, result.stderr
    told = [line for line in result.stderr.splitlines() if "planner.horizon_s" in line]
    assert sorted(told) == [f"planner.horizon_s must be greater than 0, got {x}" for x in ("-1.0", "-2.0")]
    assert "Traceback" not in result.stderr
    (metrics,) = (tmp_path / "outputs" / "smoke").glob("*/metrics.json")
    assert json.loads(metrics.read_text(encoding="utf-8"))["train"]


def test_a_launcher_that_is_not_installed_is_an_error_of_one_line(tmp_path: Path) -> None:
    if importlib.util.find_spec("ray") is not None:
        pytest.skip("Ray is installed")
    call = [sys.executable, "-m", "negopipe", "-m", "hydra/launcher=ray", "seed=1,2"]
    result = subprocess.run(call, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("hydra/launcher must be one of basic, ")
    assert result.stderr.count("\n") == 1
