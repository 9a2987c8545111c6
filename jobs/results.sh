#!/usr/bin/env bash
# The main results: five training seeds on the paper's two tasks, three on the mixture, none left out; 10,000 held-out
# episodes per planner and seed, the same for all. The fixed horizons, which are not trained, drive them once. The
# regret needs the oracle's table (jobs/oracle.sh makes it).
set -euo pipefail
oracle=${ORACLE:-negopipe/pretrained/oracle.csv}
python -m negopipe +experiment=yield name=results_yield stages=[train,evaluate] evaluation.n_episodes=5000 seed=1
python -m negopipe -m +experiment=yield name=results_yield stages=[train,evaluate] evaluation.n_episodes=5000 \
    evaluation/baseline=[] seed=2,3,4,5
python -m negopipe.sweeping.compare outputs/results_yield --oracle "$oracle"
python -m negopipe +experiment=mixture name=results_mixture stages=[train,evaluate] evaluation.n_episodes=5000 seed=1
python -m negopipe -m +experiment=mixture name=results_mixture stages=[train,evaluate] evaluation.n_episodes=5000 \
    evaluation/baseline=[] seed=2,3
python -m negopipe.sweeping.compare outputs/results_mixture --oracle "$oracle"
