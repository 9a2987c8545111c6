"""Speed of the simulator, the planner and the training, and what bounds it."""
