"""The stages of a run, in the order in which they need each other: train, evaluate, report."""
