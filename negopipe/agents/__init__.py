"""Who drives: horizon drivers, the baselines that the policy is compared with, and what they know of an encounter."""
