"""Interfaces for other libraries: gymnasium and Stable-Baselines3."""
