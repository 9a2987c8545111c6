#!/usr/bin/env bash
# The best sequence of horizons for each held-out task, found by search: oracle.csv, the limit of every planner.
set -euo pipefail
python -m negopipe +experiment=oracle
