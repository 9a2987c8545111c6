#!/usr/bin/env bash
# Ablation (docs/reading.md, "claim 10"): curricula against the last stage's distribution alone, after the same number
# of decisions; three seeds, none left out. The comparison judges the claim.
set -euo pipefail
python -m negopipe -m +experiment=yield name=ablation_curriculum stages=[train,evaluate] \
    evaluation/baseline=[] evaluation.n_episodes=1000 curriculum=careful_first,wait_first,three_stages,none seed=1,2,3
python -m negopipe.sweeping.compare outputs/ablation_curriculum
