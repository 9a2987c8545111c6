"""What a run leaves behind: its folder, its record in the MLflow store, its checkpoints."""

from negopipe import environment

environment.drop_empty("MLFLOW_")  # read when mlflow is imported, which only happens below
environment.default("MLFLOW_DISABLE_TELEMETRY", "true")
