"""Speed of the simulator, the planner and the training, and its physical limit."""
