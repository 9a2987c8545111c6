#!/usr/bin/env bash
# Ablation (claim 10): curricula against the last stage's distribution alone, with a crash that costs 5 and 50; 240
# iterations each, three seeds, none left out.
set -euo pipefail
python -m negopipe -m +experiment=yield name=ablation_curriculum stages=[train,evaluate] \
    evaluation/rival=[] reward=paper,strict seed=1,2,3 \
    curriculum=wait_first curriculum.stages.0.n_iterations=80 curriculum.stages.1.n_iterations=160
python -m negopipe -m +experiment=yield name=ablation_curriculum stages=[train,evaluate] \
    evaluation/rival=[] reward=paper,strict seed=1,2,3 \
    curriculum=three_stages curriculum.stages.0.n_iterations=50 curriculum.stages.1.n_iterations=75 \
    curriculum.stages.2.n_iterations=115
python -m negopipe -m +experiment=yield name=ablation_curriculum stages=[train,evaluate] \
    evaluation/rival=[] reward=paper,strict seed=1,2,3 \
    curriculum=none curriculum.stages.0.n_iterations=240
python -m negopipe.sweeping.learning_curves outputs/ablation_curriculum --by curriculum.stages.0.name reward.collision
python -m negopipe.sweeping.summary outputs/ablation_curriculum
