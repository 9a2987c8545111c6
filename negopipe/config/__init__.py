"""The root config: composed by Hydra, checked and frozen; one line for whatever is wrong."""
