"""Doors for other people's code: gymnasium and Stable-Baselines3."""
