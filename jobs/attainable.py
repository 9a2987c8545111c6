"""Tasks of unseen-v1 in which a sequence of horizons succeeds: python jobs/attainable.py <table.csv> <outputs> [...]

A task that one of the planners in the outputs folders solved is attainable. In every other one sequences of the ego's
horizons are driven in the true world until one succeeds: those without a switch, then those with one. What is not
found is not proven impossible. The table gets a row per case once it is searched, so a stopped job goes on.
"""

import argparse
from itertools import chain
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from negopipe import load_config
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import has_compiler
from negopipe.game.reward import RewardConfig
from negopipe.runtime.backend import prepare
from negopipe.runtime.build import game_of
from negopipe.search.oracle import SWITCH_STEPS, Rollouts
from negopipe.sweeping.swept_runs import find_folders, read_runs
from negopipe.sweeping.unseen import SUITE, read_cases
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv

WORTH_COMPILING = 3
"""Tasks of a case from which on compiling it, two minutes, takes less time than it saves."""

SUCCESS_ALONE = RewardConfig(step=0.0, collision=0.0, success=1.0)
TABLE = CsvKind(
    "jobs/attainable.py",
    {"case": str, "n_tasks": int, "n_solved": int, "n_found": int, "attainable": float, "not_found": str},
)


def solved(outputs: list[Path]) -> pd.DataFrame:
    """[case, task] whether any planner solved it."""
    runs = [run for each in outputs for run in read_runs(find_folders([each / f"{SUITE}.*"]))]
    episodes = read_cases([run for run in runs if run.holds("episodes.csv")]).episodes
    return (episodes["outcome"] == "success").groupby([episodes["case"], episodes["episode"]]).any().unstack()


def search(case: str, numbers: list[int], n_tasks: int) -> list[int]:
    """Those tasks of a case, out of these, for which no sequence that succeeds is found."""
    compiled = "on" if has_compiler() and len(numbers) >= WORTH_COMPILING else "off"
    fixed = ("device=cpu", "n_threads=1", f"evaluation.n_episodes={n_tasks}")
    config = load_config("+experiment=unseen", f"+unseen={case}", f"compile={compiled}", *fixed)
    prepare(config)
    game = game_of(config)
    rollouts = Rollouts(game, config.policy.horizons_s, SUCCESS_ALONE)
    tasks, left = held_out_tasks(config, game, config.evaluation.leading_setting), torch.tensor(numbers)
    for actions in sequences(rollouts.n_actions, rollouts.n_steps):
        n = len(actions)
        each = map_tensors(lambda field, n=n, left=left: field[left].repeat_interleave(n, 0), tasks)
        played = rollouts.play(each, actions.repeat(len(left), 1), torch.full((len(each),), 0.5, dtype=torch.float64))
        left = left[~(played.score > 0).reshape(-1, n).any(1)]
        if not len(left):
            break
    return left.tolist()


def sequences(n_actions: int, n_steps: int) -> chain[Tensor]:
    """[R, T] int64: the sequences without a switch, then those with one at a time each."""
    fixed, step = torch.arange(n_actions), torch.arange(n_steps)
    pairs = torch.cartesian_prod(fixed, fixed)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return chain([fixed[:, None].expand(-1, n_steps)], (pairs[:, (step >= at).long()] for at in SWITCH_STEPS))


def main(table: Path, outputs: list[Path]) -> None:
    is_solved = solved(outputs)
    rows: list[dict] = read_csv(table, TABLE).to_dict("records") if table.exists() else []
    for case in [case for case in is_solved.index if case not in {row["case"] for row in rows}]:
        own = is_solved.loc[case].dropna().astype(bool)
        open_tasks = own.index[~own].tolist()
        left = search(case, open_tasks, len(own)) if open_tasks else []
        found = len(open_tasks) - len(left)
        row = {"case": case, "n_tasks": len(own), "n_solved": int(own.sum()), "n_found": found}
        share = 1 - len(left) / len(own)
        rows.append(row | {"attainable": round(share, 4), "not_found": " ".join(map(str, left))})
        write_csv(table, pd.DataFrame(rows).sort_values("case"), TABLE)
        print(f"{case:28} of {len(own)} tasks planners solve {own.sum()}, sequences {found} more", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, help="file of the table")
    parser.add_argument("outputs", type=Path, nargs="+", help="outputs folders of +experiment=unseen")
    args = parser.parse_args()
    main(args.table, args.outputs)
