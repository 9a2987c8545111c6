"""Ablation of the generalist, a part left out at a time: python jobs/ablation_generalist.py train|drive <folder> ...

`train` trains every variant with every seed, `--at-once` of them side by side, and writes <variant>-<seed>.safetensors
and its learning curve. `drive` drives each through cases of unseen-v1 and writes a table. Both leave out what is
there already, and a training that was stopped goes on from its last iteration. A variant drives with what it was
trained with. Overrides apply to every training, such as device=cuda.

The cases were chosen before any variant was trained: two per group of unseen-v1, one of the two mixed ones.
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from time import monotonic

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from negopipe import load_config
from negopipe.agents.driver import HorizonDriver
from negopipe.agents.horizon_drivers import adaptive_planner
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.trace import ADAPTIVE, OUTCOMES
from negopipe.runtime.backend import prepare
from negopipe.runtime.build import game_of, load_policy, save_policy
from negopipe.simulation.perception import Perception
from negopipe.stages.evaluate import measure
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.tracking.run_folder import SNAPSHOTS_NAME
from negopipe.tracking.snapshots import Snapshots
from negopipe.training.training import Training

NOT_SELF = ("any_horizon", "undecided", "late", "cautious")
AGENT: dict[str, tuple[str, ...]] = {
    "without_inf": ("policy.horizons_s=[0.0,2.0,4.0,6.0]",),
    "without_reversing": ("planner=consistent_stops",),
    "grids": ("observation=occupancy_grid", "policy=cnn_inf"),
    "memory_2s": ("observation.n_frames=3",),
}
"""Variant -> overrides that it is trained and driven with."""
TRAINING: dict[str, tuple[str, ...]] = {
    "as_shipped": (),
    "without_self_play": ("population.drivers.self.weight=0", "population.drivers.league.weight=0"),
    "self_play_alone": tuple(f"population.drivers.{name}.weight=0" for name in NOT_SELF),
    "one_street": ("scenario=narrow_lane",),
}
"""Variant -> overrides that it is trained with alone."""
VARIANTS = (*TRAINING, *AGENT)
CASES = (
    *("driver_idm", "driver_distracted", "sensor_noisy", "sensor_occlusion", "start_fast", "start_standing"),
    *("street_long", "street_sharp_bend", "traffic_follower", "traffic_three", "vehicle_bus", "vehicle_cyclist"),
    "mixed_tight_bus",
)
TABLE = CsvKind(
    "jobs/ablation_generalist.py",
    {"variant": str, "case": str, "seed": int, "n_episodes": int, "*": float},
)
MEANS = CsvKind("jobs/ablation_generalist.py", {"variant": str, "n_*": int, "*": float}, "%.4f")


def train(folder: Path, variant: str, seed: int, n_iterations: int, overrides: Sequence[str]) -> str:
    """Train one variant with one seed, unless its file is there; returns a line about it."""
    path, began = folder / f"{variant}-{seed}.safetensors", monotonic()
    if path.exists():
        return f"{path.name} is there"
    length = f"curriculum.stages.0.n_iterations={n_iterations}"
    own = (*TRAINING.get(variant, ()), *AGENT.get(variant, ()), length)
    fixed = (f"seed={seed}", "n_threads=1", "device=cpu", "compile=on")
    config = load_config("+experiment=generalist", *fixed, *own, *overrides)
    prepare(config)
    training, own_folder = Training(config), folder / f"{variant}-{seed}"
    snapshots = Snapshots(own_folder / SNAPSHOTS_NAME, config.tracking.n_snapshots)
    training.resume(snapshots)
    while training.n_done < training.n_total:
        row = training.iterate()
        training.save_to(snapshots)
        print(f"{variant}-{seed} {monotonic() - began:.0f} s {training.n_done} {training.curve.text(row)}", flush=True)
    training.curve.write(own_folder)
    save_policy(path, training.policy, config, training.curve.rows[-1]["decisions"])
    snapshots.remove()
    return f"{path.name} after {monotonic() - began:.0f} s"


def drive(folder: Path, variants: Sequence[str], seeds: Sequence[int], n_tasks: int, case: str) -> str:
    """Drive trained variants of one agent through a case, unless its piece is there; returns a line about it.

    All policies drive in one batch, since a step of few worlds costs hardly less than one of many.
    """
    piece = folder / f"{variants[0]}.{case}.{n_tasks}.csv"
    if piece.exists():
        return f"{piece.name} is there"
    which = list(product(variants, seeds))
    table = _driven(
        _unseen(variants[0], case, n_tasks), [folder / f"{each}-{seed}.safetensors" for each, seed in which]
    )
    rows = []
    for (variant, seed), (_, own) in zip(which, table.groupby(np.arange(len(table)) // n_tasks), strict=True):
        shares = {outcome: float((own["outcome"] == outcome).mean()) for outcome in OUTCOMES}
        time_s = round(float(own["driving_time_s"].mean()), 2)
        row = {"variant": variant, "seed": seed, "case": case, "n_episodes": len(own), "driving_time_s": time_s}
        rows.append(row | shares)
    write_csv(piece, pd.DataFrame(rows), TABLE)
    return f"{piece.name} {100 * (table['outcome'] == 'success').mean():.0f} % success"


def _unseen(variant: str, case: str, n_tasks: int) -> RunConfig:
    own = ("evaluation/baseline=[]", f"evaluation.n_episodes={n_tasks}", "n_threads=1", "device=cpu")
    return load_config("+experiment=unseen", f"+unseen={case}", *own, *AGENT.get(variant, ()))


def _driven(config: RunConfig, checkpoints: Sequence[Path]) -> pd.DataFrame:
    """Rows of episodes.csv of the first tasks with the policy of each checkpoint, one policy after the other."""
    prepare(config)
    game, setting, n = game_of(config), config.evaluation.leading_setting, len(checkpoints)
    tasks = map_tensors(lambda field: torch.cat([field] * n), held_out_tasks(config, game, setting))
    policies = [load_policy(path, config) for path in checkpoints]

    def ego(key: Tensor) -> HorizonDriver:
        choices = [
            adaptive_planner(policy, game, config.policy.horizons_s, own)
            for policy, own in zip(policies, key.chunk(n), strict=True)
        ]

        def choose(perception: Perception) -> Tensor:
            size = len(key) // n
            parts = [map_tensors(lambda f, i=i: f[i * size : (i + 1) * size], perception) for i in range(n)]
            return torch.cat([choice(part) for choice, part in zip(choices, parts, strict=True)])

        return HorizonDriver(choose, game.plan)

    names, paid = (ADAPTIVE, setting), config.evaluation.reward
    return measure(config, drive_episodes(game, ego, tasks, len(tasks), paid, names, is_lockstep=True))


def by_agent(variants: Sequence[str]) -> list[list[str]]:
    """The variants that drive with the same planner, observation and network."""
    return [[each for each in variants if AGENT.get(each) == own] for own in dict.fromkeys(map(AGENT.get, variants))]


def in_processes(work: Callable[..., str], arguments: Iterable[tuple], at_once: int) -> None:
    """Call `work` and print what it returns or why it failed; a new process for each, which frees its GPU memory.

    Ends the program with status 1 where a call has failed, once all others are done.
    """
    context, has_failed = get_context("spawn"), False
    with ProcessPoolExecutor(at_once, context, max_tasks_per_child=1) as pool:
        calls = {pool.submit(work, *given): given for given in arguments}
        for done in as_completed(calls):
            error = done.exception()
            has_failed |= error is not None
            print(done.result() if error is None else f"{calls[done]}: {error}", flush=True)
    if has_failed:
        raise SystemExit(1)


def main(args: argparse.Namespace) -> None:
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.what == "train":
        which = [(args.folder, variant, seed) for seed, variant in product(args.seeds, args.variants)]
        in_processes(train, [(*each, args.iterations, args.overrides) for each in which], args.at_once)
        return
    groups = product(args.cases, by_agent(args.variants))
    in_processes(drive, [(args.folder, group, args.seeds, args.tasks, case) for case, group in groups], args.at_once)
    pieces = pd.concat([read_csv(path, TABLE) for path in sorted(args.folder.glob("*.*.*.csv"))])
    write_csv(args.table, pieces.sort_values(["variant", "seed", "case"]), TABLE)
    write_csv(args.table.with_stem(f"{args.table.stem}_means"), means(pieces), MEANS)


def means(rows: pd.DataFrame) -> pd.DataFrame:
    """Per variant, the means over cases and seeds, each alike, and the seeds with least and most success."""
    of_seed = rows.groupby(["variant", "seed"])[["success", "collision", "deadlock", "driving_time_s"]].mean()
    of_all = of_seed.groupby("variant")
    success = of_all["success"].agg(success_low="min", success_high="max")
    counts = rows.groupby("variant").agg(n_seeds=("seed", "nunique"), n_cases=("case", "nunique"))
    return counts.join(of_all.mean()).join(success).sort_values("success", ascending=False).reset_index()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "drive"))
    parser.add_argument("folder", type=Path, help="folder of the policies and pieces")
    parser.add_argument("--table", type=Path, default=Path("ablation_generalist.csv"), help="file of the table")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--iterations", type=int, default=28, help="of a training, of 16,384 decisions")
    parser.add_argument("--tasks", type=int, default=50, help="tasks of a case, the first of its 500")
    parser.add_argument("--at-once", type=int, default=2, help="processes side by side")
    parser.add_argument("--overrides", nargs="*", default=[], help="of the trainings' configs, such as device=cuda")
    main(parser.parse_args())
