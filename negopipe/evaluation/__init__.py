"""Evaluation: held-out episodes, their record (`trace`), the measures (`measures`), statistics, the paper's claims."""
