"""Shares of a batch: what ranks compute together is what one process computes from the whole batch."""

from typing import Any

import pytest
import torch
from rank_threads import in_ranks
from torch import Generator, Tensor

from negopipe.tensors.ranks import LostRankError, Ranks
from negopipe.tensors.share import share_of

CPU = torch.device("cpu")
N, T = 5, 4
NUMBERS = (1, 2, 3, 5)


def randn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=Generator().manual_seed(sum(shape)))


@pytest.mark.parametrize("number", NUMBERS)
def test_rows_of_all_ranks_are_gathered_bit_by_bit(number: int) -> None:
    rows = {
        "real": randn(N, 3),
        "flag": randn(N) > 0,
        "count": torch.arange(N),
        "byte": torch.arange(N).byte()[:, None],
    }

    def gathered(ranks: Ranks) -> dict[str, Tensor]:
        share = share_of(ranks, N, CPU)
        return share.gather({name: share.own(each) for name, each in rows.items()})

    for result in in_ranks(number, gathered):
        assert all(torch.equal(result[name], each) for name, each in rows.items())


@pytest.mark.parametrize("number", NUMBERS)
def test_minibatches_of_chosen_cells_hold_the_rows_of_one_process(number: int) -> None:
    cells, mask = randn(T, 2 * N), randn(T, 2 * N) > 0
    more = randn(3)
    order = torch.randperm(int(mask.sum()) + len(more), generator=Generator().manual_seed(0))
    expected = torch.cat([cells[mask], more])[order]

    def batches(ranks: Ranks) -> list[Tensor]:
        agents = share_of(ranks, N, CPU).repeated(2)
        own = agents.own(cells, 1)[agents.own(mask, 1)]
        chosen, added = agents.chosen(mask), agents.slice_of(len(more))
        own, share = torch.cat([own, added.own(more)]), chosen.followed_by(added)
        assert share.n_all(len(own)) == len(order)
        parts = []
        for index in order.split(4):
            row, batch = share.take(index)
            first, n = batch.first(3), batch.n_first(3)
            parts += [batch.spread(own[row]), first.spread(own[row][:n])]
        ranks.add_up(parts)
        return parts

    for parts in in_ranks(number, batches):
        assert torch.equal(torch.cat(parts[::2]), expected)
        assert all(torch.equal(first, batch[:3]) for batch, first in zip(parts[::2], parts[1::2], strict=True))


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("n", [1, N])
def test_means_are_those_of_the_whole_batch_where_some_ranks_have_no_row(number: int, n: int) -> None:
    values = randn(n, 3)

    def means(ranks: Ranks) -> list[Tensor]:
        share = share_of(ranks, n, CPU)
        own = share.own(values)
        parts = [share.mean(own[:, 0]), share.part(own.mean(0))]
        share.add_up(parts)
        return parts

    for mean, by_column in in_ranks(number, means):
        torch.testing.assert_close(mean, values[:, 0].mean())
        torch.testing.assert_close(by_column, values.mean(0))


def test_all_ranks_learn_what_one_of_them_knows() -> None:
    def told(ranks: Ranks) -> tuple[Any, ...]:
        is_last = ranks.index == ranks.number - 1
        return ranks.any(is_last, False), ranks.each(ranks.index), ranks.first(lambda: {"rank": ranks.index})

    for number in NUMBERS:
        assert in_ranks(number, told) == [((True, False), list(range(number)), {"rank": 0})] * number


def test_a_rank_that_fails_ends_the_others_with_one_line() -> None:
    lines = []

    def work(ranks: Ranks) -> None:
        if ranks.index == 1:
            raise KeyError
        try:
            ranks.each(0)
        except LostRankError as error:
            lines.append(str(error))

    with pytest.raises(KeyError):
        in_ranks(3, work)
    assert len(lines) == 2
    assert all(line.startswith("one of 3 ranks has ended") and "\n" not in line for line in lines)
