"""A large evaluation in pieces, which merge to what one evaluation of all tasks writes.

    python jobs/evaluate_pieces.py drive <folder> --episodes 1000000 --of 256 --piece 3 [overrides]
    python jobs/evaluate_pieces.py merge <folder>

`drive` drives every planner through a range of the tasks of every setting and writes the rows to one file. A piece that
is there is not driven again. Pieces may be driven in any order, on any machines that share the folder:
jobs/slurm_evaluate.sh is an array job, and `--piece 0-255` drives several one after the other. `merge` writes
episodes.csv and metrics.json, those of `stages=[evaluate]` with as many episodes: to the last byte where the simulator
is compiled. With compile=off the last digits may differ, since a product of matrices rounds by their size on some
processors. Overrides must choose a policy with `checkpoint`. Baselines that drive a part of the tasks, and the oracle,
belong to whole evaluations only.
"""

import argparse
import io
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from negopipe import load_config
from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import Game, has_compiler
from negopipe.policy.actor_critic import ActorCritic
from negopipe.runtime import backend
from negopipe.runtime.build import build, load_weights
from negopipe.runtime.identity import source_hash, stage_key
from negopipe.stages.evaluate import jobs_of, results_of
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.checkpoint import find_checkpoint
from negopipe.tracking.csv_file import write_csv
from negopipe.tracking.metrics_file import merge_into
from negopipe.tracking.run_folder import METRICS_NAME
from negopipe.tracking.whole_file import write_whole

SETTINGS = ("device=cpu", "n_threads=1", "policy.precision=float32", "policy.memory_format=channels_last")
IDENTITY = "identity"
"""Entry of a piece beside its columns: what all pieces of an evaluation have in common."""


def config_of(n_episodes: int, n_pieces: int, overrides: Sequence[str]) -> RunConfig:
    """The config of a piece, whose memory is that of its own tasks."""
    is_of_grids = not any(text.startswith("policy=objects") or "generalist" in text for text in overrides)
    n_own = -(-n_episodes // n_pieces)
    settings = SETTINGS if is_of_grids else SETTINGS[:2]
    config = load_config(*overrides, *settings, f"evaluation.n_episodes={n_own}", "stages=[evaluate]")
    if config.compile == "auto":
        config = replace(config, compile="on" if has_compiler() else "off")
    partial = [name for name, baseline in config.evaluation.baselines.items() if baseline.n_driven is not None]
    if partial:
        raise UserError(f"evaluation.baselines must drive all tasks for an evaluation in pieces, got {partial[0]}")
    if config.checkpoint is None:
        raise UserError("checkpoint must be the policy that is evaluated in pieces, got null")
    return replace(config, evaluation=replace(config.evaluation, oracle=None))


def drive(config: RunConfig, game: Game, policy: ActorCritic, n_episodes: int, rows: range) -> pd.DataFrame:
    """Rows of episodes.csv of the tasks `rows` among `n_episodes`, setting by setting and planner by planner."""
    tasks = {name: held_out_tasks(config, game, name, n_episodes) for name in config.evaluation.settings}
    own = {name: map_tensors(lambda field: field[rows.start : rows.stop], each) for name, each in tasks.items()}
    driven = [job() for job in jobs_of(config, game, policy, own).values()]
    table = pd.concat([each[0] for each in driven if each is not None], ignore_index=True)
    return table.assign(episode=table["episode"] + rows.start)


def save(path: Path, table: pd.DataFrame, identity: str) -> None:
    """Write a piece whole or not at all; every column keeps its type and all of its digits."""
    columns: Any = {
        str(name): values.to_numpy(dtype="U" if EPISODES.type_of(str(name)) is str else None)
        for name, values in table.items()
    }
    content = io.BytesIO()
    columns[IDENTITY] = np.array(identity)
    np.savez_compressed(content, **columns)
    write_whole(path, content.getvalue())


def load(path: Path) -> tuple[pd.DataFrame, str]:
    """Table and identity of a piece."""
    with np.load(path, allow_pickle=False) as content:
        columns: dict[str, Any] = {name: content[name] for name in content.files if name != IDENTITY}
        return pd.DataFrame(columns), str(content[IDENTITY])


def merge(folder: Path) -> pd.DataFrame:
    """Rows of all pieces in the order of one evaluation; UserError where one is missing or of another evaluation."""
    paths = sorted(folder.glob("piece_*_of_*.npz"))
    if not paths:
        raise UserError(f"{folder} must hold the pieces that `drive` writes, got none")
    n_pieces = int(paths[0].stem.rpartition("_")[2])
    missing = [i for i in range(n_pieces) if place_of(folder, i, n_pieces) not in paths]
    if missing or len(paths) != n_pieces:
        raise UserError(
            f"{folder} must hold {n_pieces} pieces of one evaluation, got {len(paths)}, without {missing[:3]}"
        )
    tables, identities = zip(*map(load, paths), strict=True)
    if others := [path.name for path, each in zip(paths, identities, strict=True) if each != identities[0]]:
        raise UserError(
            f"{folder} must hold pieces of one config, code and number of episodes, got {others[0]} of others"
        )
    order = list(dict.fromkeys(zip(tables[0]["setting"], tables[0]["planner"], strict=True)))
    joined = dict(list(pd.concat(tables).groupby(["setting", "planner"], sort=False)))
    return pd.concat([joined[each] for each in order], ignore_index=True)


def place_of(folder: Path, piece: int, n_pieces: int) -> Path:
    return folder / f"piece_{piece:06d}_of_{n_pieces}.npz"


def drive_pieces(folder: Path, n_episodes: int, n_pieces: int, pieces: range, overrides: Sequence[str]) -> None:
    """Drive the pieces that the folder does not hold."""
    config = config_of(n_episodes, n_pieces, overrides)
    identity = f"{stage_key(config, 'evaluate')} {source_hash()} {n_episodes}"
    if not 0 <= pieces.start < pieces.stop <= min(n_pieces, n_episodes):
        raise UserError(f"--piece must be within 0 and {n_pieces - 1}, got {pieces.start}-{pieces.stop - 1}")
    backend.prepare(config)
    game, policy = build(config)
    load_weights(find_checkpoint(str(config.checkpoint), config), policy, config)
    for piece in pieces:
        path = place_of(folder, piece, n_pieces)
        if path.is_file() and load(path)[1] == identity:
            continue
        rows = range(n_episodes * piece // n_pieces, n_episodes * (piece + 1) // n_pieces)
        save(path, drive(config, game, policy, n_episodes, rows), identity)
        print(f"piece {piece} of {n_pieces}: tasks {rows.start} to {rows.stop - 1}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("drive", "merge"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=500, help="tasks of every setting")
    parser.add_argument("--of", type=int, default=1, help="number of pieces")
    parser.add_argument("--piece", default="0", help="number of the piece from 0, or the first and the last as 0-7")
    given, overrides = parser.parse_known_args(arguments)
    first, _, last = given.piece.partition("-")
    try:
        if given.what == "drive":
            pieces = range(int(first), int(last or first) + 1)
            drive_pieces(given.folder, given.episodes, given.of, pieces, overrides)
            return 0
        table = merge(given.folder)
        write_csv(given.folder / EPISODES_NAME, table, EPISODES)
        merge_into(given.folder / METRICS_NAME, results_of(table))
        print(f"{given.folder / EPISODES_NAME}: {len(table)} episodes; their rates: {given.folder / METRICS_NAME}")
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
