#!/usr/bin/env bash
# Three training seeds of the main line, one after the other; every seed meets the same held-out tasks.
# With the joblib launcher, on a machine with more cores, they run side by side: add  hydra/launcher=joblib
set -euo pipefail
python -m negopipe -m +experiment=yield seed=1,2,3
