"""The driving game as a learner meets it: one decision, the reward, task distributions by stages, batched worlds."""
