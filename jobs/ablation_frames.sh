#!/usr/bin/env bash
# Ablation: how many past grids the policy sees. With one it sees where the other is and not how it moves, so it must
# do worse where intent must be read: on the mixture of hidden styles. A third of the usual decisions.
set -euo pipefail
python -m negopipe -m +experiment=mixture name=ablation_frames stages=[train,evaluate] evaluation/rival=[] \
    observation.n_frames=1,2,4 seed=1,2,3 curriculum.stages.0.n_iterations=320
python -m negopipe.sweeping.learning_curves outputs/ablation_frames --by observation.n_frames
python -m negopipe.sweeping.summary outputs/ablation_frames
