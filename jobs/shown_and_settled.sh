#!/usr/bin/env bash
# What demonstrations come to where the policy is made to settle afterwards: trained with them to the end, then 40
# iterations without, in which a decided policy pays (a negative weight of the entropy). One seed.
# It has evaluation tasks of its own: nothing should be chosen on those that results are reported for.
set -euo pipefail
python -m negopipe +experiment=yield name=shown stages=[train,evaluate] evaluation/rival=[] evaluation.task_seed=1000 \
    seed=1 curriculum=shown curriculum.demonstrations.until=1.0 curriculum.stages.0.n_iterations=180 \
    algorithm.n_worlds=64 algorithm.n_steps=32 algorithm.kl_clip=0.01 algorithm.final_step_share=0.3
checkpoint=$(ls -t outputs/shown/seed1-*/checkpoint.safetensors | head -n 1)
python -m negopipe +experiment=yield name=settled stages=[train,evaluate] evaluation/rival=[] evaluation.task_seed=1000 \
    seed=11 checkpoint="$checkpoint" curriculum=none curriculum.stages.0.n_iterations=40 \
    algorithm.n_worlds=64 algorithm.n_steps=32 algorithm.kl_clip=0.003 algorithm.entropy_coefficient=-0.1 \
    algorithm.final_entropy_share=1.0
