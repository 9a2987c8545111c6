#!/usr/bin/env bash
# Ablation: a crash that costs 5, as in the paper, or 50; three seeds, none left out. What results.sh or
# ablation_curriculum.sh has trained is taken over.
set -euo pipefail
python -m negopipe -m +experiment=yield name=ablation_reward stages=[train,evaluate] \
    evaluation/baseline=[] evaluation.n_episodes=1000 reward=paper,strict seed=1,2,3
python -m negopipe.sweeping.compare outputs/ablation_reward
