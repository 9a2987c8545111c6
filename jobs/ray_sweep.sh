#!/usr/bin/env bash
# A sweep on a Ray cluster: every run is a task, Ray finds it a machine (pip install 'negopipe[ray]').
#
# The cluster: the same environment on every machine, and a folder that all of them share. Once per machine:
#   head:     ray start --head --port=6379 --include-dashboard=false
#   others:   ray start --address=<head>:6379
# Ray lets in who has its token: copy ~/.ray/auth_token from the head to the other machines before they start.
# Then, on the head:  OUTPUTS=/shared/outputs jobs/ray_sweep.sh     and in the end, on every machine: ray stop
#
# Without a cluster the launcher makes one of this machine: hydra/launcher=ray hydra.launcher.ray.init.address=local
#
# Paths must be absolute: a task's working folder is the one in which `ray start` was given. With an address the launcher
# must not ask for memory, hence object_store_memory=null (hydra-ray-launcher 1.2.2 would). Runs report to
# a tracking server that all machines can reach, see jobs/tracking_server.sh.
set -euo pipefail
: "${MLFLOW_TRACKING_URI:?must be the address of a tracking server, see jobs/tracking_server.sh}"
ADDRESS="${ADDRESS:-auto}"
CPUS="${CPUS:-2}"      # of a run, one torch thread each
GPUS="${GPUS:-0}"      # of a run: 0, 1, or a share of one such as 0.25
OUTPUTS="${OUTPUTS:-$PWD/outputs}"
export RAY_USAGE_STATS_ENABLED=0
python -m negopipe -m +experiment=yield seed=1,2,3 reward=paper,strict \
  hydra/launcher=ray \
  hydra.launcher.ray.init.address="$ADDRESS" \
  +hydra.launcher.ray.init.object_store_memory=null \
  +hydra.launcher.ray.remote.num_cpus="$CPUS" \
  +hydra.launcher.ray.remote.num_gpus="$GPUS" \
  outputs="$OUTPUTS" tracking.uri="$MLFLOW_TRACKING_URI" "$@"
python -m negopipe.sweeping.compare "$OUTPUTS/yield"
