"""The motion planner that every vehicle shares: polynomials, candidates, prediction, choice."""
