"""decision.pt2: the simulator's decisions in Python and C++, and what is refused."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from runtime_drives import parts

import negopipe
from negopipe.config.root import RunConfig, as_mapping
from negopipe.deployment import EgoState, ObjectState, Trajectory, package_file
from negopipe.deployment.decision import Decision
from negopipe.deployment.decision_file import driven_arguments
from negopipe.deployment.export import main
from negopipe.deployment.manifest import DECISION_NAME, MANIFEST_NAME, PACKAGE_NAME, manifest_text
from negopipe.deployment.negotiator import Negotiator
from negopipe.deployment.package_file import check_machine, decision_selftest, in_order, package_inputs
from negopipe.deployment.package_session import Package
from negopipe.deployment.verify_decision import verify_decision
from negopipe.errors import UserError

SOURCE = Path(negopipe.__file__).resolve().parents[1] / "examples" / "cpp"
SMALL = (
    *("export.n_selftest=4", "export.n_worlds=4", "export.capacity.n_others=2", "export.capacity.n_narrow_places=1"),
    *("export.capacity.n_parked=8", "export.capacity.n_off_road=8"),
)


def driven(config: RunConfig, n: int) -> tuple[Decision, list[dict[str, object]]]:
    _, game, policy = parts(*SMALL)
    return Decision(config, policy).eval(), driven_arguments(config, game, policy, n)


def test_the_selftest_holds_driven_decisions_in_the_order_of_the_names() -> None:
    config = parts(*SMALL)[0]
    decision, arguments = driven(config, 3)
    ours = decision_selftest(decision, arguments, config)
    assert len(ours) == 3
    for (given, (horizon, action, logits, trajectory, _)), named in zip(ours, arguments, strict=True):
        assert [tuple(each.shape) for each in given] == [named[name].shape for name in package_inputs(config)]
        assert float(horizon) == config.policy.horizons_s[int(action)] == config.policy.horizons_s[int(logits.argmax())]
        assert trajectory.shape == (30, 6)
    histories = [given[1] for given, _ in ours]
    assert (histories[1].diff(dim=0).abs() > 0.01).any()  # driven, not reset


def test_arguments_share_no_memory() -> None:
    config = parts(*SMALL)[0]
    one = driven(config, 1)[1][0]
    given = in_order(config, dict.fromkeys(package_inputs(config), one["own"]))
    assert len({each.data_ptr() for each in given}) == len(package_inputs(config))


@pytest.mark.parametrize(
    ("machine", "compiler", "processor", "message"),
    [
        ("aarch64", "true", "avx2", "export.processor must be native on a machine of aarch64, got avx2"),
        ("x86_64", "no such compiler", "avx2", "export.files must be without package where there is no C.. compiler"),
    ],
)
def test_a_machine_that_cannot_compile_is_told_before(
    machine: str, compiler: str, processor: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(package_file.platform, "machine", lambda: machine)
    monkeypatch.setenv("CXX", compiler)
    with pytest.raises(UserError, match=message):
        check_machine(processor)


def test_an_export_without_a_package_names_the_option(tmp_path: Path) -> None:
    (tmp_path / DECISION_NAME).write_bytes(b"graph")
    (tmp_path / MANIFEST_NAME).write_text(manifest_text({"config": as_mapping(parts()[0])}, tmp_path, [DECISION_NAME]))
    with pytest.raises(UserError, match=r"must hold decision\.pt2 \(export\.files=\[policy,package\]\)"):
        Negotiator.load(tmp_path, backend="torch")


@pytest.mark.slow
def test_a_file_that_is_no_package_is_refused(tmp_path: Path) -> None:
    (tmp_path / PACKAGE_NAME).write_bytes(b"code")
    with pytest.raises(UserError, match=r"decision\.pt2 must be a package that torch"):
        Package(tmp_path / PACKAGE_NAME, [], [])


def plan_of(runtime: Negotiator) -> Trajectory:
    """A decision between kerbs and parked cars, towards an oncoming car."""
    x = np.linspace(-60.0, 60.0, 121)
    left, right = (np.column_stack([x, np.full_like(x, y)]) for y in (3.5, -3.5))
    street = runtime.street_between(left, right, np.array([[0.0, 2.55, 0.0, 3.6, 1.9], [0.0, -2.55, 0.0, 3.6, 1.9]]))
    car = ObjectState("car", 0.0, 22.0, 1.75, np.pi, 5.0, length=4.5, width=1.8)
    return runtime.decide(EgoState(0.0, -20.0, -1.75, 0.0, 4.8, 0.0, 0.0, 6.0), [car], street, 0.0)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs CMake")
def test_python_and_cpp_decide_as_the_simulator_does(tmp_path: Path) -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    """Exporting and compiling take minutes."""
    export, build = tmp_path / "export", tmp_path / "build"
    overrides = ["+experiment=yield", "evaluation.action=sample", "export.files=[policy,decision,package]"]
    assert main(["pretrained/yield", str(export), *overrides, *SMALL]) == 0
    for backend in ("onnxruntime", "torch"):
        parity = verify_decision(export, 80, backend)
        assert parity.n_same_horizon == parity.n_same == parity.n_same_step == parity.n_decisions == 80
    plans = [plan_of(Negotiator.load(export, seed=4, backend=backend)) for backend in ("onnxruntime", "torch")]
    np.testing.assert_allclose(plans[0].states, plans[1].states, atol=1e-4)
    assert plans[0].horizon_s == plans[1].horizon_s
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    for command in (["cmake", "-S", str(SOURCE), "-B", str(build), prefix], ["cmake", "--build", str(build)]):
        subprocess.run(command, check=True, capture_output=True)
    done = subprocess.run([build / "decide", export], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].startswith("16 decisions, 0 with another horizon, trajectories within ")
    missing = subprocess.run([build / "decide", tmp_path], capture_output=True, text=True, check=False)
    assert missing.returncode == 1
