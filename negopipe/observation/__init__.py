"""Observations of the policy: occupancy grids."""
