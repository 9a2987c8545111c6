import pytest
import torch
from torch import Tensor

from negopipe.tensors.chunked import ChunkedFunction


@pytest.mark.parametrize(
    ("n_worlds", "calls"), [(1, [2]), (2, [2]), (3, [5]), (5, [5]), (6, [5, 2]), (10, [5, 5]), (13, [5, 5, 5])]
)
def test_the_rest_takes_the_smallest_size_that_holds_it(n_worlds: int, calls: list[int]) -> None:
    met: list[int] = []

    def double(x: Tensor) -> Tensor:
        met.append(len(x))
        return 2 * x

    chunked = ChunkedFunction(double, [5, 2], lambda fn: fn)
    given = torch.arange(3.0 * n_worlds).reshape(n_worlds, 3)
    assert torch.equal(chunked(given), 2 * given)
    assert met[1:] == calls  # the first call finds the layout of the result
