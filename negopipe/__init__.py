"""negopipe: train, evaluate and show a driving policy that negotiates narrow passages.

The map, from the bottom up (a part imports only what stands above it here):

    schema, errors, seeding   how configs are declared, the user's errors, random streams
    torch_settings            torch's process-wide settings, for as long as a call lasts
    environment               environment variables and the user's home, for code and for conf/
    simulation/   state, geometry, reference_line, verge, road, scenario (tasks), perception,
                  dynamics, simulator
    planner/      polynomials, longitudinal and lateral candidates, prediction, frenet (the choice)
    observation/  occupancy grids          reward   Eq. 3
    driver        who drives a vehicle     policy/  the network
    learning/     rollout, advantage, curriculum, demonstrations, update (what algorithms share), learner; acktr and
                  acktr_adam (with kfac), a2c and ppo (with adam): tensors only, nothing of the simulator
    chunks, env   the game as batched worlds for the learner
    evaluation/   drives held-out tasks: planners, baselines (whom the policy is compared with), episodes, trace,
                  replay;
                  metrics, safety; statistics over tasks and seeds, comparison, claims of the paper
    report/       figures, animation, headlines, tables, page
    tracking/     what a run tells a store: journal -> delivery -> MLflow; checkpoints, snapshots, tables as files
                  (csv_file), the policies that come with negopipe
    stages/       train, evaluate, report, replay, behaviour_map, oracle, benchmark: each a function of config and run;
                  what is stopped goes on from its last snapshot
    config        RunConfig, the root schema   identity   which results are the same
    compose       the RunConfig of a command line, in any process
    sweeping/     a sweep's objective, Optuna search, summary, results over seeds, learning curves
    __main__      the command line             gym_env, sb3_adapter    doors of gymnasium and Stable-Baselines3

One decision (E worlds, V vehicles)
    action [E] -> horizon [E, V] (ego from the action, social from its style) -> perceive -> predict
    -> one `plan` for all E*V -> `step` 0.2 s -> events -> reward -> grids of the state reached -> new tasks where
    an episode is over

One iteration
    the stage's task distribution -> collect -> advantages -> the algorithm's update -> log -> (stage's end) checkpoint
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent

CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
"""The configs: inside the package in a wheel, beside it in a checkout."""
