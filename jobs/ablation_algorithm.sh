#!/usr/bin/env bash
# Ablation: the four algorithms on the paper's two tasks, the same decisions for each; three seeds, none left out.
# learning_curves.png shows them over decisions and over wall time. The Adam rates are the paper's.
set -euo pipefail
python -m negopipe -m +experiment=yield name=ablation_algorithm stages=[train,evaluate] evaluation/baseline=[] \
    evaluation.n_episodes=1000 curriculum=none curriculum.stages.0.n_iterations=200 \
    algorithm.n_worlds=64 algorithm.n_steps=32 algorithm=acktr algorithm.kl_clip=0.01 seed=1,2,3
python -m negopipe -m +experiment=yield name=ablation_algorithm stages=[train,evaluate] evaluation/baseline=[] \
    evaluation.n_episodes=1000 curriculum=none curriculum.stages.0.n_iterations=200 \
    algorithm.n_worlds=64 algorithm.n_steps=32 algorithm=acktr_adam,a2c,ppo seed=1,2,3
python -m negopipe.sweeping.compare outputs/ablation_algorithm --by algorithm.kind --every 5
