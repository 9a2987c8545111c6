"""Evaluation: episodes driven to the end, their record (`trace`) and what is measured on it (`metrics`)."""
