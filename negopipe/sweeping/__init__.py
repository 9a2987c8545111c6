"""Many runs: what a sweep is about (objective), a search that goes on after a stop (Optuna), what came of it."""
