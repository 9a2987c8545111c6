"""Somebody else's model in the project's evaluation: a function from an observation to an action.

    python examples/other_model.py 100

The model here is the policy that comes with negopipe, called as a stranger's would be: with arrays as the environment
gives them. It drives the held-out tasks of an evaluation, and all measures follow.
"""

import sys
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import negopipe
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.envs.worlds import shown
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.measures import summary
from negopipe.game.game import build_game
from negopipe.simulation.perception import Perception
from negopipe.stages.evaluate import held_out_tasks

Model = Callable[[np.ndarray], np.ndarray]
"""Observations [E, *obs] as the environment gives them -> actions [E]."""


def main(model: Model, n_episodes: int) -> dict[str, dict[str, float]]:
    """The measures of a model in each setting of the experiment `yield`."""
    config = negopipe.load_config("+experiment=yield", f"evaluation.n_episodes={n_episodes}")
    game, horizons = build_game(config), torch.tensor(config.policy.horizons_s)

    def choose(perception: Perception) -> Tensor:
        return horizons[torch.from_numpy(model(shown(game.draw(perception))))][:, None]

    measured = {}
    for setting in config.evaluation.settings:
        tasks, paid = held_out_tasks(config, game, setting), config.evaluation.reward
        trace = drive_episodes(game, by_horizon(game, choose), tasks, n_episodes, paid, ("model", setting))
        measured[setting] = summary(episodes(Drives.of(config, trace)))["evaluation"][setting]["model"]
    return measured


if __name__ == "__main__":
    policy = negopipe.load_policy("pretrained/yield")
    for name, values in main(policy.act, int(sys.argv[1])).items():
        print(f"{name}: success {values['success_rate']:.0%}, driving time {values['driving_time_s']:.1f} s")
