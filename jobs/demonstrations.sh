#!/usr/bin/env bash
# Demonstrations and settling (+experiment=demonstrations): five training seeds, none left out; 10,000 held-out episodes each, the
# tasks of results.sh.
set -euo pipefail
oracle=${ORACLE:-negopipe/pretrained/oracle.csv}
python -m negopipe -m +experiment=demonstrations name=results_shown stages=[train,evaluate] evaluation.n_episodes=5000 \
    evaluation/baseline=[] seed=1,2,3,4,5
python -m negopipe.sweeping.compare outputs/results_shown --oracle "$oracle"
