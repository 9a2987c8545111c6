"""The learner on a task whose answer is known: CartPole-v1, where no episode returns more than 500.

    python jobs/cartpole.py                                  # acktr, five seeds: about a minute
    python jobs/cartpole.py --algorithm ppo --seeds 1,2
    python jobs/cartpole.py --out cartpole.csv algorithm.kl_clip=0.003

`Learner`, `collect` and `ActorCritic` are those that train the driving policy, with a network of 64 units per layer.
The config is conf/algorithm/<algorithm>.yaml, changed by OVERRIDES and by the overrides at the end of the command line.

The table has a row per seed. The exit code is 1 if `greedy` of any seed is below 450. Columns:
    greedy, sampled    mean return of the final policy in 100 new episodes, with its most probable or with drawn actions
    training           mean return of the last 100 episodes of the training, with drawn actions
    steps              number of steps of all carts in the training
    steps_to_450       number of steps after which the mean of 100 episodes first reached 450; nan = never
    seconds            duration of the training
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from hydra.errors import HydraException
from torch import Tensor, nn

from negopipe.config.compose import compose_config
from negopipe.config.messages import explain_composition
from negopipe.errors import UserError
from negopipe.learning.learner import AnyAlgorithmConfig, Learner
from negopipe.learning.rollout import RunningEpisodes, Transition, collect
from negopipe.policy.actor_critic import ActorCritic, greedy_action, mlp, sample_action
from negopipe.tensors.seeding import generator
from negopipe.tracking.csv_file import CsvKind, write_csv

# ACKTR has the options of conf/ except for smaller batches, since 150,000 steps are few. Its steps are measured in nat,
# which does not depend on the network. The Adam rates of conf/ are those of the paper, for its grids; a network this
# small takes larger steps. All algorithms collect the same rollouts.
ADAM = ("algorithm.adam.policy_rate=0.003", "algorithm.adam.value_rate=0.003")
COLLECTING = ("algorithm.n_worlds=64", "algorithm.n_steps=16", "algorithm.minibatch_size=512")
OVERRIDES = {
    "acktr": COLLECTING,
    "acktr_adam": (*COLLECTING, *ADAM),
    "a2c": (*COLLECTING, *ADAM),
    "ppo": (*COLLECTING, *ADAM),
}
SOLVED = 450.0
"""Mean return at which the task counts as solved."""
N_EPISODES = 100
"""Number of episodes in a mean return."""
WIDTH = 64
"""Units of the encoder's layer and of the hidden layer of each head."""
TABLE = CsvKind(
    "jobs/cartpole.py",
    {
        "seed": int,
        "greedy": float,
        "sampled": float,
        "training": float,
        "steps": int,
        "steps_to_450": float,
        "seconds": float,
    },
)


class CartPole:
    """E carts, each with a pole to be kept upright; satisfies `negopipe.learning.rollout.Environment`.

    Observations [E, 4] float32: the cart's position (m) and speed (m/s), the pole's angle (rad) and its speed (rad/s).
    Action 1 pushes to the right, 0 to the left, and each gives 1. An episode is terminated (`is_collision`) where the
    pole falls or the cart leaves its track, and truncated (`is_success`) after 500 steps otherwise.
    """

    def __init__(self, n_worlds: int, seed: int) -> None:
        self.n_worlds = n_worlds
        self.envs: Any = gymnasium.make_vec("CartPole-v1", num_envs=n_worlds, vectorization_mode="vector_entry_point")
        self._observation, _ = self.envs.reset(seed=seed)

    def observe(self) -> Tensor:
        return torch.from_numpy(self._observation)

    def is_learning(self) -> Tensor:
        return torch.ones(self.n_worlds, dtype=torch.bool)

    def step(self, action: Tensor) -> Transition:
        reached, reward, has_fallen, is_late, _ = self.envs.step(action.numpy())
        is_truncated, is_done = is_late & ~has_fallen, is_late | has_fallen
        self._start_anew(is_done)
        self._observation = self.envs.state.T.astype(np.float32)
        return Transition(
            observation=self.observe(),
            final_observation=torch.from_numpy(reached[is_done]),
            reward=torch.from_numpy(reward),
            is_terminated=torch.from_numpy(has_fallen),
            is_truncated=torch.from_numpy(is_truncated),
            is_success=torch.from_numpy(is_truncated),
            is_collision=torch.from_numpy(has_fallen),
        )

    def _start_anew(self, is_done: np.ndarray) -> None:
        """Start the next episodes at once; gymnasium's batched CartPole does so in its next step, without an action."""
        envs = self.envs
        envs.state[:, is_done] = envs.np_random.uniform(envs.low, envs.high, size=(4, is_done.sum()))
        envs.steps[is_done] = 0
        envs.prev_done = np.zeros_like(is_done)


def config_of(algorithm: str, overrides: Sequence[str] = ()) -> AnyAlgorithmConfig:
    """Config of an algorithm for this task."""
    return compose_config([f"algorithm={algorithm}", *OVERRIDES[algorithm], *overrides]).algorithm


def network(seed: int) -> ActorCritic:
    """A freshly initialised policy for CartPole."""
    encoder = nn.Sequential(mlp((4, WIDTH)), nn.ReLU())
    return ActorCritic(encoder, WIDTH, (WIDTH,), 2, torch.float32, generator(seed, "weights"))


def train(config: AnyAlgorithmConfig, n_iterations: int, seed: int) -> tuple[ActorCritic, pd.DataFrame]:
    """The final policy, and a table of the training's episodes: return, and steps of all carts up to its iteration."""
    policy, actions = network(seed), generator(seed, "actions")
    learner = Learner(policy, config, generator(seed, "updates"))
    env = CartPole(config.n_worlds, generator(seed, "training starts").initial_seed())
    running, episodes = RunningEpisodes.start(config.n_worlds, torch.device("cpu")), []
    for iteration in range(n_iterations):
        rollout, running = collect(env, policy, config.n_steps, actions, running)
        learner.update(rollout, iteration / n_iterations)
        n_steps = (iteration + 1) * rollout.reward.numel()
        episodes += [(n_steps, result) for result in rollout.episode_return[rollout.is_done].tolist()]
    return policy, pd.DataFrame(episodes, columns=["steps", "return"], dtype=float)


@torch.no_grad()
def play(policy: ActorCritic, choose: Callable[[Tensor], Tensor], seed: int) -> float:
    """Mean return of one episode in each of N_EPISODES worlds; `choose` maps logits [E, 2] to actions [E]."""
    env = CartPole(N_EPISODES, generator(seed, "evaluation starts").initial_seed())
    returns, is_first = torch.zeros(N_EPISODES), torch.ones(N_EPISODES, dtype=torch.bool)
    while is_first.any():
        transition = env.step(choose(policy(env.observe())[0]))
        returns += transition.reward * is_first
        is_first &= ~(transition.is_terminated | transition.is_truncated)
    return float(returns.mean())


def row(config: AnyAlgorithmConfig, n_iterations: int, seed: int) -> dict[str, float]:
    """Row of one seed in the table, with the keys of TABLE."""
    started_s = time.perf_counter()
    policy, episodes = train(config, n_iterations, seed)
    seconds = time.perf_counter() - started_s
    draw = partial(sample_action, generator=generator(seed, "evaluation actions"))
    solved_at = episodes["steps"][episodes["return"].rolling(N_EPISODES).mean() >= SOLVED]
    numbers = (
        seed,
        play(policy, greedy_action, seed),
        play(policy, draw, seed),
        float(episodes["return"].tail(N_EPISODES).mean()),
        n_iterations * config.n_worlds * config.n_steps,
        math.nan if solved_at.empty else int(solved_at.iloc[0]),
        seconds,
    )
    return dict(zip(TABLE.columns, numbers, strict=True))


def seeds(text: str) -> list[int]:
    return [int(seed) for seed in text.split(",")]


def command_line(arguments: Sequence[str] | None) -> tuple[argparse.Namespace, AnyAlgorithmConfig]:
    """The options, with n_iterations, and the config of the algorithm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=OVERRIDES, default="acktr")
    parser.add_argument("--seeds", type=seeds, default="1,2,3,4,5", help="seeds of the trainings, separated by commas")
    parser.add_argument("--steps", type=int, default=150_000, help="most steps of a training, all carts together")
    parser.add_argument("--out", type=Path, help="CSV file for the table")
    parser.add_argument("overrides", nargs="*", help="algorithm.<key>=<value> or algorithm/<group>=<option>")
    options = parser.parse_intermixed_args(arguments)
    if strange := [text for text in options.overrides if not text.startswith(("algorithm.", "algorithm/"))]:
        parser.error(f"overrides must begin with algorithm. or algorithm/, got {' '.join(strange)}")
    try:
        config = config_of(options.algorithm, options.overrides)
    except (HydraException, UserError) as error:
        parser.error(str(error) if isinstance(error, UserError) else explain_composition(error))
    options.n_iterations = options.steps // (config.n_worlds * config.n_steps)
    if options.n_iterations < 1:
        parser.error(f"--steps must be at least {config.n_worlds * config.n_steps}, an iteration, got {options.steps}")
    return options, config


def main(arguments: Sequence[str] | None = None) -> int:
    options, config = command_line(arguments)
    torch.set_num_threads(1)  # a network this small does not gain from more
    table = pd.DataFrame([row(config, options.n_iterations, seed) for seed in options.seeds])
    print(table.round(1).to_string(index=False, float_format=lambda x: f"{x:.6g}"))
    n_solved = int((table["greedy"] >= SOLVED).sum())
    print(f"{options.algorithm}: {n_solved} of {len(table)} seeds reach {SOLVED:.0f}")
    if options.out is not None:
        write_csv(options.out, table, TABLE)
    return 0 if n_solved == len(table) else 1


if __name__ == "__main__":
    sys.exit(main())
