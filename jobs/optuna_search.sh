#!/usr/bin/env bash
# A search over ACKTR's learning rate, trust region, entropy and momentum (conf/hydra/sweeper/optuna_acktr.yaml), by
# Optuna. Stop it when you like: the same command goes on with the study, in outputs/sweeps/yield/optuna.db, until
# 24 trials are finished. The search has evaluation tasks of its own: what is chosen by its results must not be chosen
# on the tasks that results are reported for. On more cores: hydra.sweeper.n_jobs=4 hydra/launcher=joblib n_threads=1
set -euo pipefail
python -m negopipe -m +experiment=yield hydra/sweeper=optuna_acktr 'stages=[train,evaluate]' evaluation.task_seed=1000 "$@"
python -m negopipe.sweeping.compare outputs/yield
