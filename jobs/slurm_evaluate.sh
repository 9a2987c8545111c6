#!/usr/bin/env bash
#SBATCH --job-name=negopipe-evaluate
#SBATCH --array=0-255
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=04:00:00
#SBATCH --requeue
# A large evaluation on a SLURM cluster: an array job, every task of which drives a piece (jobs/evaluate_pieces.py).
#
# Where to run it: in the repository, with the environment active; both must lie on a file system that the nodes share.
#   EPISODES=1000000 sbatch jobs/slurm_evaluate.sh <folder> +experiment=mixture checkpoint=pretrained compile=on
#   python jobs/evaluate_pieces.py merge <folder>      # once all tasks are over
#
# A piece that a node has lost is put back into the queue. When the command is given again, pieces that are there are
# not driven again.
set -euo pipefail
EPISODES="${EPISODES:-1000000}"
exec python jobs/evaluate_pieces.py drive "$1" \
  --episodes "$EPISODES" --of "$SLURM_ARRAY_TASK_COUNT" --piece "$SLURM_ARRAY_TASK_ID" "${@:2}"
