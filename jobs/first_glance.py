"""Regret to the oracle of drivers that see only the first grid: python jobs/first_glance.py <oracle.csv>

The oracle has a sequence of horizons for each task, chosen in hindsight. A driver that sees only the first grid uses
one sequence for all tasks whose first grids are equal. Among the oracle's sequences of a setting, the script selects
the best one for each such group of tasks and the best one for all tasks, and prints their regret to the oracle. A
policy sees a grid at every decision, so its regret may be lower.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from negopipe import load_config
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.horizon_text import from_text
from negopipe.game.game import Game, build_game, has_compiler
from negopipe.runtime.backend import keep_freed_memory
from negopipe.search.oracle import Rollouts
from negopipe.search.oracle_table import read_oracle
from negopipe.simulation.state import Task
from negopipe.tensors.tree import map_tensors


def returns_of(rollouts: Rollouts, tasks: Task, actions: torch.Tensor) -> np.ndarray:
    """[N, R] float64: return of each of the sequences `actions` [R, T] in each of N tasks."""
    n_tasks, n_sequences = len(tasks), len(actions)
    each = map_tensors(lambda field: field.repeat_interleave(n_sequences, 0), tasks)
    any_score = torch.full((n_tasks * n_sequences,), -torch.inf, dtype=torch.float64)
    return rollouts.play(each, actions.repeat(n_tasks, 1), any_score).reward.reshape(n_tasks, n_sequences).numpy()


def actions_of(texts: Iterable[str], horizons_s: list[float], n_steps: int) -> torch.Tensor:
    """[R, T] int64: indices into horizons_s; those after the end of a sequence mean nothing."""
    rows = [[horizons_s.index(horizon_s) for horizon_s in from_text(text).tolist()] for text in texts]
    return torch.tensor([row + [0] * (n_steps - len(row)) for row in rows])


def first_grids(game: Game, tasks: Task) -> np.ndarray:
    """[N] int64: number of the first grid of each task; equal grids have equal numbers."""
    grids = game.see(game.simulator.reset(tasks)).flatten(1).numpy()
    return np.unique(grids, axis=0, return_inverse=True)[1]


def main(path: Path, is_compiled: bool) -> None:
    torch.set_num_threads(1)
    table = read_oracle(str(path)).rows
    config = load_config(f"evaluation.n_episodes={table['episode'].max() + 1}")
    keep_freed_memory()
    game = build_game(config, is_compiled=is_compiled)
    rollouts = Rollouts(game, config.policy.horizons_s, config.evaluation.reward)
    horizons_s = list(config.policy.horizons_s)
    for setting, rows in table.groupby("setting", sort=False):
        n_tasks = len(rows)
        tasks = map_tensors(lambda field, n=n_tasks: field[:n], held_out_tasks(config, game, str(setting)))
        returns = returns_of(rollouts, tasks, actions_of(rows["horizons"], horizons_s, rollouts.n_steps))
        group, best = first_grids(game, tasks), rows["reward"].mean()
        groups = [returns[group == number] for number in np.unique(group)]
        per_group = sum(each.sum(0).max() for each in groups) / n_tasks
        print(
            f"{setting:18} oracle {best:.2f}; regret of one sequence for each of {len(groups)} first grids "
            f"{best - per_group:.2f}, of one for all {n_tasks} tasks {best - returns.mean(0).max():.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("oracle", type=Path, help="oracle.csv of +experiment=oracle")
    main(parser.parse_args().oracle, is_compiled=has_compiler())
