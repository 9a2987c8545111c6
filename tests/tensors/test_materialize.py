"""Values that a compiler must store."""

import pytest
import torch
from torch import Tensor
from torch._inductor.utils import run_and_get_code

from negopipe.tensors.materialize import materialize


def readers(x: Tensor, is_stored: bool) -> Tensor:
    """Something that is costly for each of 64 numbers, read for 64 x 64."""
    costly = torch.sin(x)
    if is_stored:
        (costly,) = materialize(costly)
    return (costly[:, None] - costly).abs().sum(1)


def test_values_stay_as_they_are() -> None:
    values = torch.tensor([1.0, -torch.inf, torch.nan]), torch.tensor([0.0, 2.0, 1e30])
    for value, same in zip(values, materialize(*values), strict=True):
        assert torch.equal(value.nan_to_num(), same.nan_to_num())


@pytest.mark.slow
def test_a_compiler_computes_them_in_a_loop_of_their_own() -> None:
    x = torch.rand(64, generator=torch.Generator().manual_seed(1))
    results, loops = [], []
    for is_stored in (False, True):
        torch.compiler.reset()
        result, (code,) = run_and_get_code(torch.compile(readers, dynamic=False), x, is_stored)
        results.append(result)
        loops.append(code.count("sin("))
    torch.testing.assert_close(results[0], readers(x, False))
    torch.testing.assert_close(results[1], readers(x, True))
    assert loops[1] < loops[0]
