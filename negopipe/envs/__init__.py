"""Interfaces for other libraries: gymnasium, PettingZoo and Stable-Baselines3."""
