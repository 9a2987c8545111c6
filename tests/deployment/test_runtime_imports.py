"""The runtime is importable, and opens an export, where only NumPy and onnxruntime are installed."""

import subprocess
import sys
from pathlib import Path

import pytest

import negopipe
from negopipe.deployment import negotiator as runtime
from negopipe.safety.layer import INTERVENTIONS, N_KEPT
from negopipe.simulation.simulator import UNCOUNTED_REST_S
from negopipe.simulation.state import AT_REST_MPS

ROOT = Path(negopipe.__file__).resolve().parents[1]

ALONE = """
import sys, time
from importlib.machinery import PathFinder

class Only:
    allowed = {*sys.stdlib_module_names, "numpy", "onnxruntime", "negopipe"}
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in self.allowed:
            raise ImportError(f"{name} is not there")

sys.meta_path.insert(0, Only())
began = time.perf_counter()
from negopipe.deployment import EgoState, Negotiator, ObjectState
print(time.perf_counter() - began)
"""


def test_it_needs_numpy_alone_to_be_imported() -> None:
    done = subprocess.run([sys.executable, "-c", ALONE], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 5.0


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        (runtime.INTERVENTIONS, INTERVENTIONS),
        (runtime.N_KEPT, N_KEPT),
        (runtime.AT_REST_MPS, AT_REST_MPS),
        (runtime.UNCOUNTED_REST_S, UNCOUNTED_REST_S),
    ],
    ids=["interventions", "kept", "rest", "uncounted"],
)
def test_its_constants_are_those_of_the_simulator(written: object, meant: object) -> None:
    assert written == meant
