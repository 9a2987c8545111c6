"""Arenas: the opponent's policy takes its most probable horizon, or draws it where the evaluation does."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from negopipe.play.arena import Chooser

HORIZONS_S = (0.0, 2.0, 4.0, 6.0)
LOGITS = torch.tensor([[0.1, 0.0, 0.0, 0.0]])


def chosen(key: Tensor | None, n: int = 60) -> list[float]:
    game = cast(Any, SimpleNamespace(draw=lambda perception: perception))
    chooser = Chooser(cast(Any, lambda seen: (LOGITS, None)), game, HORIZONS_S, key)
    horizons = [float(chooser(cast(Any, None))) for _ in range(n)]
    assert chooser.probability == pytest.approx(LOGITS.softmax(-1)[0].tolist())
    return horizons


def test_the_most_probable_horizon_is_taken() -> None:
    assert set(chosen(None)) == {0.0}


def test_horizons_are_drawn_and_the_same_key_draws_the_same() -> None:
    first = chosen(torch.tensor([7]))
    assert set(first) == set(HORIZONS_S)
    assert first == chosen(torch.tensor([7]))
    assert first != chosen(torch.tensor([8]))
