"""The search for the best sequence of horizons with full knowledge of a task: the oracle and its table."""
