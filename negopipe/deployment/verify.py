"""Check of an export: onnxruntime and torch on the same held-out decisions, driven by torch.

`python -m negopipe.deployment.verify <folder> [--decisions N] [--table FILE]` prints how many of the actions are the
same and the largest difference of a logit. Actions may differ where the two largest logits are closer than rounding;
such ties are counted. With --table the figures become a row of a CSV file. The exit status is 1 where any other action
differs, or a logit by more than `TOLERANCE`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

from negopipe.config.root import load
from negopipe.deployment.driven import drive_held_out
from negopipe.deployment.extras import need
from negopipe.deployment.manifest import POLICY_NAME, read_manifest
from negopipe.deployment.onnx_session import open_onnx
from negopipe.deployment.parity_table import put_row
from negopipe.deployment.policy_file import INPUT
from negopipe.errors import UserError
from negopipe.game.game import build_game
from negopipe.policy.actor_critic import greedy_action
from negopipe.runtime.build import load_policy, with_learned
from negopipe.tensors.torch_settings import own_settings
from negopipe.tracking.checkpoint import CHECKPOINT_NAME
from negopipe.tracking.csv_file import CsvKind

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

COMMAND = "python -m negopipe.deployment.verify"
TOLERANCE = 1e-4
"""Largest difference of a logit."""
COLUMNS = {"export": str, "n_by_action": str, "logit_error": float, "n_*": int}
ROWS = CsvKind(COMMAND, COLUMNS, "%.2g")
"""A row per export; `Parity` says what the columns are."""


@dataclass(frozen=True)
class Parity:
    """Decisions of two implementations.

    n_decisions: compared
    n_same: with the same action
    n_ties: with another action where torch's two logits in question are within `TOLERANCE` of each other
    logit_error: largest difference of a logit
    n_by_action: decisions of torch by action
    """

    n_decisions: int
    n_same: int
    n_ties: int
    logit_error: float
    n_by_action: tuple[int, ...]

    @property
    def is_good(self) -> bool:
        return self.n_same + self.n_ties == self.n_decisions and self.logit_error <= TOLERANCE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 1 where the two differ, or after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the export")
    parser.add_argument(
        "--decisions", type=int, help="number of decisions; export.n_decisions of the export by default"
    )
    parser.add_argument("--table", type=Path, help="CSV file that gets a row; one of the same export is replaced")
    given = parser.parse_args(arguments)
    try:
        parity = verify(given.folder, given.decisions)
        if given.table is not None:
            add_row(given.table, given.folder.resolve().name, parity)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"actions    {parity.n_same} of {parity.n_decisions} are the same, {parity.n_ties} are ties")
    print(f"by action  {', '.join(map(str, parity.n_by_action))}")
    print(f"logits     differ by at most {parity.logit_error:.2g}, {TOLERANCE:g} is allowed")
    return 0 if parity.is_good else 1


def add_row(path: Path, name: str, parity: Parity) -> None:
    """Write a row of the figures into a table, in the place of one with the same name."""
    figures = {field.name: getattr(parity, field.name) for field in fields(parity)}
    figures["n_by_action"] = " ".join(map(str, parity.n_by_action))
    put_row(path, ROWS, name, figures)


@own_settings()
def verify(folder: Path, n_decisions: int | None) -> Parity:
    """Compare policy.onnx with the checkpoint beside it; None = as many decisions as the export's config says."""
    need("export")
    manifest = read_manifest(folder)
    config = config_of(manifest)
    policy = load_policy(folder / CHECKPOINT_NAME, config)
    session = open_onnx(folder / POLICY_NAME)
    game = with_learned(build_game(config), config, policy)
    horizons = torch.tensor(config.policy.horizons_s)
    counted: list[Parity] = []

    def choose(world: Any) -> Tensor:
        observation = game.see(world)
        logits = policy(observation)[0]
        counted.append(compare(logits, session.run(["logits"], {INPUT: observation.numpy()})[0]))
        return horizons[greedy_action(logits)]

    n = n_decisions or config.export.n_decisions
    drive_held_out(config, game, choose, n)
    return total(counted)


def compare(logits: Tensor, others: np.ndarray) -> Parity:
    """Parity of logits [E, A] of torch with those of the file."""
    theirs = torch.from_numpy(others)
    own_action, their_action = greedy_action(logits), greedy_action(theirs)
    is_same = own_action == their_action
    apart = logits.gather(1, own_action[:, None]) - logits.gather(1, their_action[:, None])
    n_ties = (~is_same & (apart[:, 0] < TOLERANCE)).sum()
    n_by_action = own_action.bincount(minlength=logits.shape[1])
    error = float((logits - theirs).abs().max())
    return Parity(len(logits), int(is_same.sum()), int(n_ties), error, tuple(n_by_action.tolist()))


def total(parts: Sequence[Parity]) -> Parity:
    """All decisions together."""
    return Parity(
        n_decisions=sum(part.n_decisions for part in parts),
        n_same=sum(part.n_same for part in parts),
        n_ties=sum(part.n_ties for part in parts),
        logit_error=max(part.logit_error for part in parts),
        n_by_action=tuple(map(sum, zip(*(part.n_by_action for part in parts), strict=True))),
    )


def config_of(manifest: dict[str, Any]) -> "RunConfig":
    """The config of an export, in float32."""
    config = load(OmegaConf.create(manifest["config"]))
    policy = config.policy
    return replace(config, policy=replace(policy, precision="float32")) if policy.kind == "cnn" else config


if __name__ == "__main__":
    sys.exit(main())
