"""The oracle: a search for the best sequence of horizons with full knowledge of a task, and its table."""
