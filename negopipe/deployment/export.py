"""Export of a trained policy for hosts without negopipe.

`python -m negopipe.deployment.export <checkpoint> <folder> [override ...]` writes into the folder

    policy.onnx             observations -> logits and value
    decision.onnx           states and street -> horizon and trajectory, where `export.files` names it
    decision.pt2            the same for torch and C++, where `export.files` names the package
    decision_selftest.pt    arguments of driven decisions, and the results that torch gives for them, beside the package
    street.onnx             tables of a street -> those that say where to wait, where the decision reads them
    selftest.npz            driven observations and the outputs that torch gives for them
    checkpoint.safetensors  the weights, for the check by `python -m negopipe.deployment.verify <folder>`
    export.json             all that these depend on: observation, horizons, config, versions, hashes

The overrides are those of the run, such as `+experiment=yield`; the checkpoint must fit them.
"""

import argparse
import io
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from negopipe.config.compose import compose_config
from negopipe.config.root import as_mapping
from negopipe.deployment.decision import Decision, outputs
from negopipe.deployment.decision_file import (
    StreetInputs,
    arguments_of,
    driven_arguments,
    has_surroundings,
    write_decision,
    write_street,
)
from negopipe.deployment.driven import drive_held_out
from negopipe.deployment.extras import EXTRAS, need
from negopipe.deployment.manifest import (
    DECISION_NAME,
    MANIFEST_NAME,
    PACKAGE_NAME,
    PACKAGE_TEST_NAME,
    POLICY_NAME,
    SELFTEST_NAME,
    STREET_NAME,
    file_hash,
    manifest_text,
)
from negopipe.deployment.package_file import check_machine, decision_selftest, package_inputs, write_package
from negopipe.deployment.policy_file import exported, selftest, write_policy
from negopipe.errors import UserError
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import Game, build_game
from negopipe.policy.actor_critic import Policy, greedy_action
from negopipe.runtime.build import load_policy, with_learned
from negopipe.runtime.identity import source_hash
from negopipe.tensors.torch_settings import one_thread, own_settings
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, find_checkpoint, load_checkpoint
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

COMMAND = "python -m negopipe.deployment.export"

N_TESTED = 16
"""Decisions of decision_selftest.pt."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkpoint", help="a file, pretrained/<name>, or the id of an MLflow run")
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument("overrides", nargs="*", help="of the run, such as +experiment=yield")
    given = parser.parse_args(arguments)
    try:
        config = compose_config([*given.overrides, "device=cpu", "compile=off"])
        for path in export(config, find_checkpoint(given.checkpoint, config), given.folder):
            print(path)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


@one_thread()
def export(config: "RunConfig", checkpoint: Path, folder: Path) -> list[Path]:
    """Write the files of `config.export.files`; returns all paths. UserError where the checkpoint does not fit."""
    need("export")
    if "package" in config.export.files:
        check_machine(config.export.processor)
    policy = exported(load_policy(checkpoint, config))
    game = build_game(config)
    observations = driven_observations(config, game, policy, config.export.n_selftest)
    names = [CHECKPOINT_NAME, POLICY_NAME, SELFTEST_NAME]
    write_whole(folder / CHECKPOINT_NAME, checkpoint.read_bytes())
    write_policy(folder / POLICY_NAME, policy, observations, config.export.opset)
    write_whole(folder / SELFTEST_NAME, npz_bytes(selftest(policy, observations)))
    if set(config.export.files) & {"decision", "package"}:
        names += _write_decision(config, game, policy, folder)
    write_whole(folder / MANIFEST_NAME, manifest_text(_content(config, folder), folder, names).encode())
    return [folder / name for name in (*names, MANIFEST_NAME)]


def _write_decision(config: "RunConfig", game: Game, policy: Policy, folder: Path) -> list[str]:
    """Write the decision's files by the first decision of a held-out task; returns their names."""
    one = replace(config, evaluation=replace(config.evaluation, n_episodes=1))
    world = game.simulator.reset(held_out_tasks(one, game, config.evaluation.leading_setting))
    with torch.no_grad():
        decision = Decision(config, policy).eval()
        streets = StreetInputs(config, game)
        (arguments,) = arguments_of(config, game, streets, world)
        names = []
        if "decision" in config.export.files:
            write_decision(folder / DECISION_NAME, decision, arguments, config)
            names += [DECISION_NAME]
        if "package" in config.export.files:
            write_package(folder / PACKAGE_NAME, decision, arguments, config)
            tested = decision_selftest(decision, driven_arguments(config, game, policy, N_TESTED), config)
            write_whole(folder / PACKAGE_TEST_NAME, saved_bytes(tested))
            names += [PACKAGE_NAME, PACKAGE_TEST_NAME]
        if has_surroundings(config):
            write_street(folder / STREET_NAME, config, streets.tables(1))
            names += [STREET_NAME]
        return names


@own_settings()  # which torch.export, that writes the files, cannot stand
def driven_observations(config: "RunConfig", game: Game, policy: Policy, n: int) -> torch.Tensor:
    """[n, *obs]: evenly spread over the decisions of held-out episodes."""
    game = with_learned(game, config, policy)
    horizons = torch.tensor(config.policy.horizons_s)
    seen: list[torch.Tensor] = []

    def choose(world: Any) -> torch.Tensor:
        seen.append(game.see(world))
        return horizons[greedy_action(policy(seen[-1])[0])]

    drive_held_out(config, game, choose, n * config.export.n_worlds)
    every = torch.cat(seen)
    return every[torch.linspace(0, len(every) - 1, n).long()].clone()


def npz_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """Content of a compressed .npz file."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    return content.getvalue()


def saved_bytes(content: Any) -> bytes:
    """Content of a file of `torch.save`."""
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def _content(config: "RunConfig", folder: Path) -> dict[str, Any]:
    """What the files depend on, as JSON values."""
    values = as_mapping(config)
    observation = config.observation
    return {
        "versions": {name: version(name) for name in ("negopipe", "torch", *EXTRAS["export"])}
        | {"opset": config.export.opset},
        "source": source_hash(),
        "checkpoint": {
            "sha256": file_hash(folder / CHECKPOINT_NAME),
            "made_by": load_checkpoint(folder / CHECKPOINT_NAME)[1],
        },
        "observation": {
            "shape": list(observation.shape),
            "dtype": "uint8" if observation.kind == "occupancy_grid" else "float32",
            **values["observation"],
        },
        "decision": {"inputs": list(package_inputs(config)), "outputs": list(outputs(config))},
        "horizons_s": values["policy"]["horizons_s"],
        "dt_s": config.scenario.dt_s,
        "config": values,
    }


if __name__ == "__main__":
    sys.exit(main())
