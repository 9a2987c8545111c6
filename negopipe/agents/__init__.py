"""Drivers: horizon drivers, the baselines that the policy is compared with, and the encounter as they perceive it."""
