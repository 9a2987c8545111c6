"""Sequences of prediction horizons as text for a cell of a table: `0x14 4 0x20` is 0 s for 14 decisions, 4 s for one
and 0 s for 20."""

from itertools import groupby

import numpy as np

from negopipe.errors import UserError


def to_text(horizon_s: np.ndarray, n_steps: np.ndarray) -> list[str]:
    """Texts of E episodes from the first n_steps [E] of horizon_s [T, E] (s); empty for a driver without horizons."""
    return [_text(horizon_s[:n, episode]) for episode, n in enumerate(n_steps)]


def _text(horizon_s: np.ndarray) -> str:
    if np.isnan(horizon_s).any():
        return ""
    runs = [(value, len(list(same))) for value, same in groupby(horizon_s.tolist())]
    return " ".join(f"{value:g}" + (f"x{n}" if n > 1 else "") for value, n in runs)


def from_text(text: str) -> np.ndarray:
    """[T] float32, s. Raises UserError for a text that `to_text` does not write."""
    values: list[float] = []
    try:
        for run in text.split():
            value, _, n = run.partition("x")
            values += [float(value)] * int(n or 1)
    except ValueError as error:
        raise UserError(f"horizons must be like `0x14 4 0x20`, got {text[:80]}") from error
    return np.array(values, dtype=np.float32)
