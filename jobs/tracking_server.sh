#!/usr/bin/env bash
# An MLflow server that the runs of several machines report to: the same store and dashboard for all of them.
# Start it on one machine that stays up, and give each run its address: tracking.uri=http://<machine>:5000
#
# It asks nobody for a password. So it listens to its own machine only, and others reach it through ssh:
#   ssh -N -L 5000:127.0.0.1:5000 <machine>            and then  tracking.uri=http://127.0.0.1:5000
# Inside a network where everyone may see and delete every run, let it listen to that network, and name the names
# by which it is asked for (others are refused):
#   HOST=0.0.0.0 ALLOWED_HOSTS='cluster-head:5000,10.0.0.7:5000' jobs/tracking_server.sh
#
# SQLite is enough for some tens of runs at a time. For hundreds use PostgreSQL (pip install psycopg2-binary):
#   BACKEND=postgresql://mlflow@dbhost/mlflow jobs/tracking_server.sh
# One server per store; a SQLite file belongs on a local disk, not on a network drive.
set -euo pipefail
HOST="${HOST:-127.0.0.1}"
PORT="${PORT:-5000}"
STORE="${STORE:-$PWD/outputs/tracking_server}"
BACKEND="${BACKEND:-$(python -m negopipe.tracking.sqlite "$STORE/mlflow.db")}"
ALLOWED_HOSTS="${ALLOWED_HOSTS:-localhost:$PORT,127.0.0.1:$PORT}"
mkdir -p "$STORE/artifacts"
export MLFLOW_DISABLE_TELEMETRY=true
exec python -m mlflow server --host "$HOST" --port "$PORT" --allowed-hosts "$ALLOWED_HOSTS" --workers 2 \
  --backend-store-uri "$BACKEND" --artifacts-destination "$STORE/artifacts"
