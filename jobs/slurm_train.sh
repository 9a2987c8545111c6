#!/usr/bin/env bash
#SBATCH --job-name=negopipe-train
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --time=12:00:00
#SBATCH --signal=B:TERM@120
#SBATCH --requeue
# One training by several processes on a SLURM cluster (docs/scaling.md).
#
# Where to run it: in the repository, with the environment active; both must lie on a file system that the nodes share.
#   sbatch jobs/slurm_train.sh +experiment=generalist
#   RANKS=4 sbatch --nodes=4 --gpus-per-node=4 jobs/slurm_train.sh +experiment=generalist device=cuda
#
# One task per node starts RANKS processes. On GPUs every process needs one of its own. The job stops by itself two
# minutes before its time is over, with a snapshot, and is put back into the queue; after a node has failed SLURM puts
# it back likewise. It then resumes from its newest snapshot. The first rank alone writes to OUTPUTS and to the store.
# GLOO_SOCKET_IFNAME and NCCL_SOCKET_IFNAME name the network interface where the default one is not that of the cluster.
set -euo pipefail
RANKS="${RANKS:-16}"   # processes of a node; one per core, or one per GPU
OUTPUTS="${OUTPUTS:-$PWD/outputs}"
HEAD="$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)"
PORT="$((20000 + SLURM_JOB_ID % 20000))"
srun --kill-on-bad-exit=1 torchrun \
  --nnodes="$SLURM_JOB_NUM_NODES" --nproc-per-node="$RANKS" \
  --rdzv-backend=c10d --rdzv-id="$SLURM_JOB_ID" --rdzv-endpoint="$HEAD:$PORT" \
  -m negopipe 'stages=[train]' outputs="$OUTPUTS" "$@" &
STEP=$!
STOPPED=0
trap 'STOPPED=1; kill -TERM "$STEP"' TERM
wait "$STEP" || true
if [ "$STOPPED" = 1 ]; then
  wait "$STEP" || true  # the ranks write their snapshot
  scontrol requeue "$SLURM_JOB_ID"
fi
