#!/usr/bin/env bash
# Every ego horizon against every social style in push and yield: behaviour_map.csv and its figure.
set -euo pipefail
python -m negopipe +experiment=behaviour_map
