"""Check of an exported decision: the same horizon and trajectory as the simulator's planner, in driven decisions.

`python -m negopipe.deployment.verify_decision <folder> [--decisions N] [--backend NAME] [--table FILE]` drives held-out
tasks with torch and asks for the same decisions, one at a time on one core: onnxruntime by decision.onnx, or torch by
decision.pt2. The exported decision computes every street by tables, the simulator one straight street in closed form:
candidates whose costs are equal up to rounding may be chosen otherwise, so a trajectory that differs is counted and not
hidden.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch

from negopipe.deployment.decision_file import StreetInputs, arguments_of, expected
from negopipe.deployment.driven import drive_held_out
from negopipe.deployment.extras import need
from negopipe.deployment.manifest import read_manifest
from negopipe.deployment.open_decision import FILES, Backend, open_decision
from negopipe.deployment.parity_table import put_row, row_name
from negopipe.deployment.policy_file import exported
from negopipe.deployment.verify import config_of
from negopipe.errors import UserError
from negopipe.game.game import build_game
from negopipe.runtime.build import load_policy, with_learned
from negopipe.simulation.state import World
from negopipe.tensors.torch_settings import own_settings
from negopipe.tracking.checkpoint import CHECKPOINT_NAME
from negopipe.tracking.csv_file import CsvKind

COMMAND = "python -m negopipe.deployment.verify_decision"
TOLERANCE_M = 1e-3
"""Largest distance between two places of the same trajectory."""
ROWS = CsvKind(COMMAND, {"export": str, "n_*": int, "*": float}, "%.3g")
"""A row per export; `DecisionParity` says what the columns are."""


@dataclass(frozen=True)
class DecisionParity:
    """Decisions of an export beside the simulator's.

    n_decisions: compared
    n_same_horizon: with the same horizon and intervention of the safety layer
    n_same: of those, with a trajectory within `TOLERANCE_M` at all times
    n_same_step: of those with the same horizon, with the first state within `TOLERANCE_M`
    n_interventions: decisions in which the safety layer replaces the plan; of these only the first state is compared
    largest_m: largest distance of two places among the trajectories that count as the same
    p50_ms, p99_ms: CPU time of one exported decision, which is what it takes on a core of its own
    """

    n_decisions: int
    n_same_horizon: int
    n_same: int
    n_same_step: int
    n_interventions: int
    largest_m: float
    p50_ms: float
    p99_ms: float

    @staticmethod
    def of(rows: np.ndarray) -> "DecisionParity":
        """rows: [n, 5], whether horizon and intervention agree, distance of the first places and largest distance (m),
        time (s), whether the safety layer intervenes."""
        agree, first_m, farthest_m, seconds, intervenes = rows.T
        is_same = (agree > 0) & (farthest_m <= TOLERANCE_M)
        p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
        largest = float(farthest_m[is_same].max(initial=0.0))
        n_step = int(((agree > 0) & (first_m <= TOLERANCE_M)).sum())
        counts = (len(rows), int(agree.sum()), int(is_same.sum()), n_step, int(intervenes.sum()))
        return DecisionParity(*counts, largest, float(p50), float(p99))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the export")
    parser.add_argument("--decisions", type=int, required=True, help="number of decisions")
    parser.add_argument("--backend", choices=FILES, default="onnxruntime", help="what decides (default: onnxruntime)")
    parser.add_argument("--table", type=Path, help="CSV file that gets a row; one of the same export is replaced")
    given = parser.parse_args(arguments)
    try:
        parity = verify_decision(given.folder, given.decisions, given.backend)
        if given.table is not None:
            put_row(given.table, ROWS, row_name(given.folder, given.backend), asdict(parity))
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    for field in fields(parity):
        print(f"{field.name:15} {getattr(parity, field.name):.6g}")
    return 0


@own_settings()
def verify_decision(folder: Path, n_decisions: int, backend: Backend = "onnxruntime") -> DecisionParity:
    """Compare the decision with the game of the export's config; the weights are those of the folder."""
    need("export")
    manifest = read_manifest(folder)
    config, session = config_of(manifest), open_decision(folder, manifest, backend)
    policy = exported(load_policy(folder / CHECKPOINT_NAME, config))
    game = with_learned(build_game(config), config, policy)
    streets = StreetInputs(config, game)
    rows: list[tuple[float, ...]] = []

    def choose(world: World) -> torch.Tensor:
        ours = expected(config, game, policy, world)
        for index, arguments in enumerate(arguments_of(config, game, streets, world)):
            start = time.thread_time()
            theirs = session(arguments)
            seconds = time.thread_time() - start
            n_compared = 1 if int(ours["intervention"][index]) else None
            apart = np.linalg.norm((ours["trajectory"][index].numpy() - theirs["trajectory"])[:n_compared, :2], axis=-1)
            agree = float(ours["horizon"][index]) == float(theirs["horizon"][0])
            intervention = int(theirs.get("intervention", np.zeros(1))[0])
            agree &= intervention == int(ours["intervention"][index])
            rows.append((float(agree), float(apart[0]), float(apart.max()), seconds, float(intervention > 0)))
        return ours["horizon"]

    drive_held_out(config, game, choose, n_decisions)
    return DecisionParity.of(np.array(rows))


if __name__ == "__main__":
    sys.exit(main())
