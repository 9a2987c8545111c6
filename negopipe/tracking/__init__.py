"""What a run leaves behind: its folder, its record in the MLflow store, its checkpoints."""

import os

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")  # read when mlflow is imported, which only happens below
