"""Batched tensors without anything of driving: trees, chunks, random streams, settings of torch."""
