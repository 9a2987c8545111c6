import multiprocessing
import threading
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from negopipe.tensors.chunked import ChunkedFunction
from negopipe.tensors.compiled import compiled
from negopipe.tensors.sparse import SparseFunction

TIMEOUT_S = 60


@pytest.fixture
def two_threads() -> None:
    torch.set_num_threads(2)


def uncompiled(fn: Callable) -> Callable:
    return fn


@pytest.mark.parametrize(
    ("n_worlds", "calls"), [(1, [2]), (2, [2]), (3, [5]), (5, [5]), (6, [5, 2]), (10, [5, 5]), (13, [5, 5, 5])]
)
def test_the_rest_takes_the_smallest_size_that_holds_it(n_worlds: int, calls: list[int]) -> None:
    met: list[int] = []

    def double(x: Tensor) -> Tensor:
        met.append(len(x))
        return 2 * x

    chunked = ChunkedFunction(double, [5, 2], uncompiled)
    given = torch.arange(3.0 * n_worlds).reshape(n_worlds, 3)
    assert torch.equal(chunked(given), 2 * given)
    assert met[1:] == calls  # the first call finds the layout of the result


def test_threads_share_the_chunks(two_threads: None) -> None:
    """Two chunks wait for each other, which one thread alone would do for ever."""
    meeting = threading.Barrier(1)

    def met(x: Tensor) -> Tensor:
        meeting.wait(TIMEOUT_S)
        assert not torch.is_grad_enabled() or meeting.parties == 1
        return 2 * x

    chunked, given = ChunkedFunction(met, [2], uncompiled), torch.arange(8.0)
    assert torch.equal(chunked(given), 2 * given)  # the first call, which would compile, has one thread
    meeting = threading.Barrier(2)
    assert torch.equal(chunked(given), 2 * given)
    assert torch.get_num_threads() == 2


def test_an_error_in_a_thread_is_that_of_the_call(two_threads: None) -> None:
    def positive(x: Tensor) -> Tensor:
        if x.min() < 0:
            raise ValueError("negative")
        return x

    chunked = ChunkedFunction(positive, [2], uncompiled)
    chunked(torch.ones(6))
    with pytest.raises(ValueError, match="negative"):
        chunked(torch.tensor([1.0, 1.0, 1.0, -1.0, 1.0, 1.0]))
    assert torch.equal(chunked(torch.ones(6)), torch.ones(6))


def test_a_forked_process_has_threads_of_its_own(two_threads: None) -> None:
    chunked = ChunkedFunction(torch.neg, [2], uncompiled)
    given = torch.ones(6)
    for _ in range(2):
        chunked(given)
    process = multiprocessing.get_context("fork").Process(target=chunked, args=(given,), daemon=True)
    process.start()
    process.join(TIMEOUT_S)
    assert process.exitcode == 0


@pytest.mark.slow
def test_compiled_chunks_give_the_same_bytes_in_threads(two_threads: None) -> None:
    """Some of the code is compiled in a thread, since nothing counts in the first call."""
    sparse = SparseFunction(lambda own, its: torch.sin(own[:1] * its[:1]), torch.zeros(1))

    def fn(x: Tensor) -> Tensor:
        items = x.T[None]  # [1, 300, worlds]
        return sparse(items[0] > 0, items[:, 0], items)[0].T.cos()

    given = torch.rand(37, 300, generator=torch.Generator().manual_seed(1))
    chunked = ChunkedFunction(fn, [4], compiled)
    chunked(-given)
    threaded = chunked(given)
    torch.set_num_threads(1)
    assert torch.equal(chunked(given), threaded)
    torch.set_num_threads(2)
    torch.testing.assert_close(threaded, fn(given))
