"""Synchronisation of a run with its store: journal -> delivery -> MLflow."""
