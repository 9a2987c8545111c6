#!/usr/bin/env bash
# Ablation: how many past grids the policy sees. With one it sees where the other is and not how it moves, so it must
# do worse where intent must be read: on the mixture of hidden styles. A ninth of the usual decisions.
set -euo pipefail
python -m negopipe -m +experiment=mixture name=ablation_frames stages=[train,evaluate] evaluation/baseline=[] \
    evaluation.n_episodes=1000 observation.n_frames=1,2,4 seed=1,2,3 curriculum.stages.0.n_iterations=150
python -m negopipe.sweeping.compare outputs/ablation_frames
