"""The training loop, its record, demonstrations, and what of it can be used again."""
