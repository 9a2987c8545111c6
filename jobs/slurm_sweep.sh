#!/usr/bin/env bash
# A sweep on a SLURM cluster: every run is a job of its own (submitit: pip install 'negopipe[submitit]').
#
# Where to run it: on the login node, in the repository, with the environment active; both must lie on a file system
# that the nodes share. The command stays until all runs are over (tmux). Everything below can be set from outside:
#   PARTITION=gpu GPUS=1 jobs/slurm_sweep.sh
#
# What comes back: run folders under OUTPUTS, what each job printed under OUTPUTS/sweeps/yield/.submitit/<job>/.
# A run that is thrown off its node goes on when the same command is given again. One that reaches MINUTES is put back
# into the queue by itself, up to five times, and goes on from its last snapshot (tracking.snapshot_period_s).
#
# The store: many nodes must not write one SQLite file over the network. Start jobs/tracking_server.sh on a machine
# that the nodes can reach and set MLFLOW_TRACKING_URI, which all runs report to.
set -euo pipefail
: "${MLFLOW_TRACKING_URI:?must be the address of a tracking server, see jobs/tracking_server.sh}"
PARTITION="${PARTITION:-cpu}"
CPUS="${CPUS:-4}"      # of a run, one torch thread each; a fifth does not help
GPUS="${GPUS:-0}"      # of a run: 0 or 1
MEMORY_GB="${MEMORY_GB:-8}"
MINUTES="${MINUTES:-120}"  # of a job: longest time before it is put back into the queue
AT_A_TIME="${AT_A_TIME:-32}"
OUTPUTS="${OUTPUTS:-$PWD/outputs}"
python -m negopipe -m +experiment=yield seed=1,2,3 reward=paper,strict \
  hydra/launcher=submitit_slurm \
  hydra.launcher.partition="$PARTITION" \
  hydra.launcher.cpus_per_task="$CPUS" \
  hydra.launcher.gpus_per_node="$GPUS" \
  hydra.launcher.mem_gb="$MEMORY_GB" \
  hydra.launcher.timeout_min="$MINUTES" \
  hydra.launcher.max_num_timeout=5 \
  hydra.launcher.array_parallelism="$AT_A_TIME" \
  outputs="$OUTPUTS" tracking.uri="$MLFLOW_TRACKING_URI" "$@"
python -m negopipe.sweeping.compare "$OUTPUTS/yield"
