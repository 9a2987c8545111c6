"""Sequences of horizons as text: nothing is lost."""

import numpy as np
import pytest

from negopipe.errors import UserError
from negopipe.evaluation.horizon_text import from_text, to_text


def test_there_and_back() -> None:
    horizon_s = np.float32([[0, 2.5], [0, 2.5], [4, 2.5], [0, 6], [np.nan, 6]])
    texts = to_text(horizon_s, np.array([4, 5]))
    assert texts == ["0x2 4 0", "2.5x3 6x2"]
    for column, (text, n) in enumerate(zip(texts, (4, 5), strict=True)):
        assert np.array_equal(from_text(text), horizon_s[:n, column])


def test_a_driver_without_horizons_has_none() -> None:
    assert to_text(np.full((3, 1), np.nan, dtype=np.float32), np.array([3])) == [""]
    assert len(from_text("")) == 0


@pytest.mark.parametrize("text", ["0y3", "ax2", "0x1.5"])
def test_other_text_is_an_error(text: str) -> None:
    with pytest.raises(UserError, match="horizons must be like"):
        from_text(text)
