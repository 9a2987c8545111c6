"""The root config: composed by Hydra, checked and frozen; every error is one line."""
