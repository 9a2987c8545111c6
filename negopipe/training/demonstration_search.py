"""Search for demonstrations: the best horizons for tasks of the training, found with full knowledge of the tasks.

The tasks are drawn like those of the training, from a stream of their own, so no held-out task is among them. The
policy sees only the observations of a demonstration, as in its own episodes, and not the knowledge of the search.
"""

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import torch
from torch import Tensor

from negopipe.evaluation.horizon_text import from_text, to_text
from negopipe.game.game import Game
from negopipe.learning.demonstrations import Demonstrations, DemonstrationsConfig
from negopipe.runtime.progress import ProgressLine
from negopipe.search.oracle import Rollouts, Sequences, best_simple, improve, simplify
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task
from negopipe.tensors.ranks import ALONE, Ranks
from negopipe.tensors.seeding import generator
from negopipe.tensors.torch_settings import one_thread
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.tracking.run_folder import DEMONSTRATIONS_NAME

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

DEMONSTRATIONS = CsvKind("the stage `train`", {"family": str, "reward": float, "horizons": str})
"""demonstrations.csv: a row per task."""


def demonstrations(config: "RunConfig", game: Game, folder: Path | None, ranks: Ranks = ALONE) -> Demonstrations | None:
    """Demonstrations of the curriculum; None where it has none; collective.

    folder: run folder that keeps the result; None = search anew. The first rank searches for all
    """
    wanted = config.curriculum.demonstrations
    if wanted is None:
        return None
    tasks = demonstrated_tasks(config, wanted, game)
    path = None if folder is None else folder / DEMONSTRATIONS_NAME
    table = ranks.first(partial(_found, config, wanted, game, tasks, path))
    texts = {name: table.loc[table["family"] == name, "horizons"].tolist() for name in tasks}
    seen = [_replay(config, game, drawn, texts[name]) for name, drawn in tasks.items()]
    observation, action = (torch.cat(parts) for parts in zip(*seen, strict=True))
    return Demonstrations(wanted, observation, action)


def demonstrated_tasks(config: "RunConfig", wanted: DemonstrationsConfig, game: Game) -> dict[str, Task]:
    """Demonstrated tasks of each family of the last stage, by its name."""
    scenario, families = config.curriculum.scenario(config.scenario), config.curriculum.stages[-1].families
    device = game.planner.times.device
    streams = {name: generator(config.seed, f"demonstrated tasks {name}", device) for name in families}
    return {
        name: TaskSampler(scenario, {name: family}, streams[name], game.cast.assign, scenario.training_streets).draw(
            wanted.n_tasks
        )
        for name, family in families.items()
    }


def _found(
    config: "RunConfig", wanted: DemonstrationsConfig, game: Game, tasks: dict[str, Task], path: Path | None
) -> pd.DataFrame:
    """Table of the search result, from the file at `path` where there is one, else written there."""
    if path is not None and path.is_file():
        return read_csv(path, DEMONSTRATIONS, DEMONSTRATIONS.columns)
    table = _search(config, wanted, game, tasks)
    if path is not None:
        write_csv(path, table, DEMONSTRATIONS)
    return table


@one_thread()
def _search(config: "RunConfig", wanted: DemonstrationsConfig, game: Game, tasks: dict[str, Task]) -> pd.DataFrame:
    """Table of the search result, a row per task: family, reward and horizons."""
    rollouts, found = Rollouts(game, config.policy.horizons_s, config.reward), []
    with ProgressLine("demonstrate", len(tasks) * 2 * wanted.rounds) as progress:
        for name, drawn in tasks.items():
            random = generator(config.seed, f"demonstrations {name}", drawn.family.device)
            best = best_simple(rollouts, drawn, may_switch_twice=False)
            for change in (*[improve] * wanted.rounds, *[simplify] * wanted.rounds):
                best = change(rollouts, drawn, best, wanted.population, random)
                progress.advance(f"{name}, return {best.reward.mean():.2f}")
            found.append(_table(name, best, config.policy.horizons_s))
    return pd.concat(found)


def _table(name: str, best: Sequences, horizons_s: tuple[float, ...]) -> pd.DataFrame:
    horizon = torch.tensor(horizons_s)[best.actions.T.cpu()].numpy()
    texts = to_text(horizon, best.n_steps.cpu().numpy())
    return pd.DataFrame({"family": name, "reward": best.reward.cpu().numpy(), "horizons": texts})


def _replay(config: "RunConfig", game: Game, tasks: Task, texts: list[str]) -> tuple[Tensor, Tensor]:
    """Observations [D, *obs] and actions [D] int64 of all decisions in N episodes."""
    device = tasks.family.device
    horizons, world = torch.tensor(config.policy.horizons_s, device=device), game.simulator.reset(tasks)
    known = horizons.tolist()  # rounded to float32, as the texts are
    chosen = [torch.tensor([known.index(h) for h in from_text(text).tolist()], device=device) for text in texts]
    observation, seen, actions = game.see(world), [], []
    for action in torch.nn.utils.rnn.pad_sequence(chosen, padding_value=-1):
        is_driving = action >= 0
        seen.append(observation[is_driving])
        actions.append(action[is_driving])
        world = game.drive(world, game.choose(world, horizons[action])).world
        observation = game.see(world)
    return torch.cat(seen), torch.cat(actions)
