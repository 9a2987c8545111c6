import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import negopipe.__main__ as entry
from negopipe.tensors import compiled, sparse
from negopipe.tensors.sparse import SparseFunction

OTHERWISE = torch.tensor([7.0, -torch.inf])


def shares(of_owners: Tensor, of_items: Tensor) -> Tensor:
    """Two results per item: its number as a share of its owner's, and its square root."""
    return torch.stack([of_items[0] / of_owners[1], torch.rsqrt(of_items[0])])


def draw(n_items: int, n_owners: int, share: float) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(n_items)
    counts = torch.rand(n_items, n_owners, generator=g) < share
    return counts, torch.rand(2, n_owners, generator=g), torch.rand(1, n_items, n_owners, generator=g)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_items_that_count_get_what_the_function_gives_for_all(share: float) -> None:
    counts, owners, items = draw(40, 33, share)
    results = SparseFunction(shares, OTHERWISE)(counts, owners, items)
    whole = shares(owners[:, None], items)
    assert results.shape == whole.shape
    assert torch.equal(results[:, counts], whole[:, counts])
    assert torch.equal(results[:, ~counts], OTHERWISE[:, None].expand(-1, int((~counts).sum())))


def test_nothing_is_computed_for_the_others() -> None:
    computed: list[int] = []

    def fn(of_owners: Tensor, of_items: Tensor) -> Tensor:
        computed.append(of_items.shape[1])
        return shares(of_owners, of_items)

    function = SparseFunction(fn, OTHERWISE)
    for share in (0.0, 0.3):
        counts, owners, items = draw(40, 33, share)
        function(counts, owners, items)
    assert computed == [int(counts.sum())]


def test_an_exported_program_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, owners, items = draw(7, 5, 0.3)
    function = SparseFunction(shares, OTHERWISE)
    picked = function(counts, owners, items)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    assert torch.equal(function(counts, owners, items), picked)


def test_keys_are_given_again() -> None:
    """A key is part of compiled code, which is found again on the disk only under the same one."""
    gc.collect()
    first = SparseFunction(shares, OTHERWISE)
    key, second = first._key, SparseFunction(shares, OTHERWISE)
    assert key != second._key
    del first
    gc.collect()
    assert SparseFunction(shares, OTHERWISE)._key == key


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [64, 2000])
def test_compiled_code_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    """In chunks of one size, or all items where they are fewer than that, whichever count."""
    monkeypatch.setattr(sparse, "CHUNK", chunk)
    function = SparseFunction(shares, OTHERWISE)

    def around(counts: Tensor, owners: Tensor, items: Tensor) -> Tensor:
        return torch.where(counts, function(counts, owners, items), 0.0)

    in_cpp: Callable[..., Tensor] = torch.compile(around, dynamic=False)
    for share in (0.3, 0.0, 1.0, 0.01):
        given = draw(40, 33, share)
        assert torch.equal(in_cpp(*given), around(*given))


def send(number: int) -> None:
    """Send this process a signal, whose handler runs before this returns, unless it waits."""
    os.kill(os.getpid(), number)
    time.sleep(0.01)


@pytest.fixture
def handlers() -> Iterator[None]:
    """Those of the command line, also where the tests run in the background, where a shell ignores Ctrl-C."""
    wanted = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: entry._terminate}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def interruption(
    request: pytest.FixtureRequest, handlers: None, monkeypatch: pytest.MonkeyPatch
) -> type[BaseException]:
    """What is raised for a signal that comes while items are picked."""
    picked = SparseFunction.counting

    def interrupted(self: SparseFunction, *args: Any) -> Tensor:
        send(request.param)
        return picked(self, *args)

    monkeypatch.setattr(SparseFunction, "counting", interrupted)
    return {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: SystemExit}[request.param]


def test_a_signal_waits_for_the_end_of_an_operator(interruption: type[BaseException]) -> None:
    """... also where operators call compiled code with operators of its own."""
    function, done = SparseFunction(shares, OTHERWISE), []
    vars(function)["compiled"] = shares

    def operate() -> None:
        with compiled.OutsideOperators(), compiled.OutsideOperators():
            done.append(torch.ops.negopipe.counting(function._key, len(OTHERWISE), *draw(40, 33, 0.3)))
            time.sleep(0.01)
            done.append(None)

    with pytest.raises(interruption):
        operate()
    assert len(done) == 2


@pytest.mark.usefixtures("handlers")
def test_a_signal_outside_an_operator_is_handled_at_once() -> None:
    done = []

    def wait() -> None:
        with compiled.OutsideOperators():
            send(signal.SIGINT)
            done.append(None)

    with pytest.raises(KeyboardInterrupt):
        wait()
    assert not done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.slow
def test_a_signal_in_compiled_code_stays_what_it_is(
    interruption: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """C++ would make a RuntimeError of it, which ended a training with a traceback instead of `interrupted`."""
    monkeypatch.setattr(sparse, "CHUNK", 64)
    function = SparseFunction(shares, OTHERWISE)
    in_cpp = compiled.compiled(lambda *given: function(*given) + 1.0)
    for _ in range(2):  # the first call compiles
        with pytest.raises(interruption):
            in_cpp(*draw(40, 33, 0.3))
