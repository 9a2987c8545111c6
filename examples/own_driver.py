"""A driver of one's own on tasks of unseen-v1, beside a fixed horizon of 6 s.

    python examples/own_driver.py driver_idm 100

The driver is a function from what the vehicle perceives to a prediction horizon; the planner does the rest.
"""

import sys

import torch

import negopipe
from negopipe.agents.driver import ChooseHorizon, fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.measures import summary
from negopipe.game.game import build_game
from negopipe.simulation.perception import Perception
from negopipe.stages.evaluate import held_out_tasks


def gives_way_to_the_fast(perception: Perception) -> torch.Tensor:
    """A long horizon where another vehicle comes fast, a short one where all are slow."""
    fastest = torch.where(perception.is_seen, perception.other.speed, 0.0).amax(-1)
    return torch.where(fastest > 3.0, 6.0, 2.0)


def main(case: str, n_episodes: int) -> dict[str, float]:
    """Success rates of both drivers in a case of conf/unseen."""
    config = negopipe.load_config("+experiment=unseen", f"+unseen={case}", f"evaluation.n_episodes={n_episodes}")
    game, setting = build_game(config), config.evaluation.leading_setting
    tasks, rates = held_out_tasks(config, game, setting), {}
    drivers: dict[str, ChooseHorizon] = {"own": gives_way_to_the_fast, "fixed_6": fixed_horizon(6.0)}
    for name, choose in drivers.items():
        ego, n_worlds, paid = by_horizon(game, choose), config.evaluation.n_worlds, config.evaluation.reward
        trace = drive_episodes(game, ego, tasks, n_worlds, paid, (name, setting))
        measured = summary(episodes(Drives.of(config, trace)))["evaluation"][setting][name]
        rates[name] = measured["success_rate"]
    return rates


if __name__ == "__main__":
    with torch.no_grad():
        print(main(sys.argv[1], int(sys.argv[2])))
