"""What a run has to tell a store: journal -> delivery -> MLflow."""
