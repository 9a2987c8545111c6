"""negopipe: train, evaluate and show a driving policy that negotiates narrow passages.

The map, lowest first: a package imports only what stands above it here, and itself.

    errors        the error that is the user's to mend
    lazy_face     the public names of a package, imported at their first use
    checks        what a component says of its own values: problems, memory
    environment   environment variables and the user's home
    peak_memory   peak memory of the process
    schema        how a component declares its configuration
    tensors       batched tensors without anything of driving: trees, chunks, random streams, ranks, settings of torch
    policy        the networks
    learning      ACKTR, PPO and A2C: rollout, advantage, update, K-FAC; tensors only
    maps          real streets: lanelet2 and CommonRoad files in, CommonRoad scenarios out
    simulation    the rules of the game: state, geometry, street, tasks, perception, dynamics, collisions, simulator
    planner       Frenet candidates, prediction of the others, the choice
    safety        what checks every plan before it is driven: stops, reachable sets of the others, interventions
    observation   occupancy grids; rows of numbers of objects
    agents        who drives: planners with horizons, drivers by rule, policies; the population of social drivers
    game          one decision, the reward, task distributions by stages, batched worlds for a learner
    tracking      a run's folder, checkpoints, CSV files, the store; sync: journal -> delivery -> MLflow
    evaluation    held-out tasks driven and recorded: episodes, metrics, safety, statistics, claims of the paper,
                  replay, drives as CommonRoad scenarios
    search        the oracle: the best sequence of horizons, found with full knowledge of a task
    report        figures, films, tables, headlines, the page
    config        the root config: composed, checked, frozen
    runtime       how a process runs: device, compiler, threads, workers, ranks, interruption, which results are the
                  same
    training      Algorithm 1: the loop, its record, the league, demonstrations, reuse
    benchmark     speed of simulator, planner and training, and what bounds it
    sweeping      a sweep's objective, Optuna search, the comparison of many runs
    deployment    a trained policy outside of the repository: its export, and the check of an export
    stages        preview, train, evaluate, report, replay, behaviour_map, cross_play, oracle, streets, benchmark,
                  export: functions of config, run
    envs          doors for other people's code: gymnasium, PettingZoo, Stable-Baselines3
    play          a page on which a person drives against an opponent: server, encounters, page
    __main__      the command line

One decision (E worlds, V vehicles)
    action [E] -> horizon [E, V] (ego from the action, social from its style) -> perceive -> predict
    -> one `plan` for all E*V -> `step` 0.2 s -> events -> reward -> observation of the state reached -> new tasks
    where an episode is over

One iteration
    the stage's task distribution -> collect -> advantages -> the algorithm's update -> log -> (stage's end) checkpoint
"""

from pathlib import Path
from typing import TYPE_CHECKING

from negopipe.envs.registration import register_with_gymnasium
from negopipe.lazy_face import lazy_face

if TYPE_CHECKING:
    from negopipe.config.compose import load_config
    from negopipe.envs.gymnasium import make_env, make_vec_env
    from negopipe.envs.pettingzoo import make_parallel_env
    from negopipe.runtime.build import load_policy

__all__ = ["load_config", "load_policy", "make_env", "make_parallel_env", "make_vec_env"]

_PACKAGE = Path(__file__).resolve().parent

CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
"""The configs: inside the package in a wheel, beside it in a checkout."""

if not TYPE_CHECKING:  # a type checker must not take every name for one of this package
    # imported at their first use: torch and Hydra take seconds
    __getattr__, __dir__ = lazy_face(
        __name__,
        {
            "load_config": "negopipe.config.compose",
            "load_policy": "negopipe.runtime.build",
            "make_env": "negopipe.envs.gymnasium",
            "make_parallel_env": "negopipe.envs.pettingzoo",
            "make_vec_env": "negopipe.envs.gymnasium",
        },
    )


register_with_gymnasium()
