#!/usr/bin/env bash
# How fast this machine simulates, per backend and number of worlds: benchmark.json and a table. About ten minutes,
# mostly compiling from scratch; nothing else should run beside it.
set -euo pipefail
python -m negopipe +experiment=benchmark
