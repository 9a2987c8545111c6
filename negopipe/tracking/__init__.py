"""Records of a run: its folder, its entry in the MLflow store, its checkpoints."""

from negopipe import environment

environment.drop_empty("MLFLOW_")  # read when mlflow is imported, which only happens below
environment.default("MLFLOW_DISABLE_TELEMETRY", "true")
