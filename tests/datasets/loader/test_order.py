"""The order of samples: a pure function of seed and epoch, dealt to ranks, taken up again after any batch."""

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from bhd_lerobot.datasets.loader.order import BatchOrder
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case

SAMPLES = torch.arange(100, 137)


def epochs(order: BatchOrder, count: int) -> list[list[list[int]]]:
    return [[batch.tolist() for batch in order] for _ in range(count)]


def flat(batches: list[list[int]]) -> list[int]:
    return [sample for batch in batches for sample in batch]


@pytest.mark.law
def test_every_epoch_has_every_sample_once_in_another_order() -> None:
    first, second = (flat(epoch) for epoch in epochs(BatchOrder(SAMPLES, 5, 3), 2))
    assert sorted(first) == sorted(second) == SAMPLES.tolist()
    assert first != second
    assert epochs(BatchOrder(SAMPLES, 5, 3), 2) == epochs(BatchOrder(SAMPLES, 5, 3), 2)
    assert epochs(BatchOrder(SAMPLES, 5, 3), 1) != epochs(BatchOrder(SAMPLES, 5, 4), 1)
    assert flat(epochs(BatchOrder(SAMPLES, 5, 3, shuffle=False), 1)[0]) == SAMPLES.tolist()


@given(count=st.integers(1, 40), batch_size=st.integers(1, 12), world_size=st.integers(1, 4), drop_last=st.booleans())
def test_the_ranks_share_an_epoch(count: int, batch_size: int, world_size: int, drop_last: bool) -> None:
    samples = torch.arange(count)
    if drop_last and count < batch_size * world_size:
        with pytest.raises(ConfigError, match="drop_last leaves no batch"):
            BatchOrder(samples, batch_size, 1, drop_last=drop_last, world_size=world_size)
        return
    orders = [
        BatchOrder(samples, batch_size, 1, drop_last=drop_last, rank=rank, world_size=world_size)
        for rank in range(world_size)
    ]
    dealt = [epochs(order, 1)[0] for order in orders]
    assert {len(batches) for batches in dealt} == {len(orders[0])}
    in_turns = flat([batch for turn in zip(*dealt, strict=True) for batch in turn])
    whole = orders[0].epoch_order(0).tolist()
    if drop_last:
        assert in_turns == whole[: len(in_turns)]
        assert count - len(in_turns) < batch_size * world_size
    elif world_size == 1:
        assert in_turns == whole
    else:
        assert {len(batch) for batches in dealt for batch in batches} == {batch_size}
        assert in_turns == [whole[i % count] for i in range(len(in_turns))]
        assert 0 <= len(in_turns) - count < batch_size * world_size


def test_the_ranks_are_dealt_what_accelerate_deals() -> None:
    from accelerate.data_loader import BatchSamplerShard
    from torch.utils.data import BatchSampler

    for count, batch_size, world_size in ((37, 5, 2), (40, 5, 2), (41, 4, 3), (9, 4, 3)):
        samples = torch.arange(count)
        whole = BatchOrder(samples, batch_size, 7).epoch_order(0).tolist()
        for rank in range(world_size):
            theirs = BatchSamplerShard(BatchSampler(whole, batch_size, False), world_size, rank)
            ours = BatchOrder(samples, batch_size, 7, rank=rank, world_size=world_size)
            assert epochs(ours, 1)[0] == list(theirs), (count, batch_size, world_size, rank)


@pytest.mark.law
@given(batches=st.integers(0, 40), world_size=st.integers(1, 2), drop_last=st.booleans(), weighted=st.booleans())
def test_it_goes_on_after_any_batch(batches: int, world_size: int, drop_last: bool, weighted: bool) -> None:
    def make() -> BatchOrder:
        weights = torch.linspace(0, 1, len(SAMPLES)) if weighted else None
        return BatchOrder(SAMPLES, 4, 3, drop_last=drop_last, weights=weights, world_size=world_size)

    def endless(order: BatchOrder) -> Any:
        while True:
            epoch = iter(order)
            first = next(epoch, None)
            assert first is not None, "an epoch without a batch"
            yield first
            yield from epoch

    order = make()
    stream = endless(order)
    for _ in range(batches):
        next(stream)
    state = order.state_dict()
    wanted = [next(stream).tolist() for _ in range(12)]
    again, by_count = make(), make()
    again.load_state_dict(state)
    by_count.seek(batches)
    for resumed in (endless(again), endless(by_count)):
        assert [next(resumed).tolist() for _ in range(12)] == wanted


def test_the_state_counts_what_came_out_not_what_went_in() -> None:
    order = BatchOrder(SAMPLES, 5, 3)

    def ahead(batches: Any) -> Any:
        yield from list(batches)

    stream = order.follow(ahead)
    next(stream)
    next(stream)
    assert order.state_dict() == {"epoch": 0, "position": 10}


def test_an_iteration_that_was_left_is_not_gone_on_with() -> None:
    order = BatchOrder(SAMPLES, 5, 3)
    left = iter(order)
    next(left)
    first, second = epochs(BatchOrder(SAMPLES, 5, 3), 2)
    assert [batch.tolist() for batch in order] == second
    assert [batch.tolist() for batch in left] == first[1:]
    assert order.state_dict() == {"epoch": 2, "position": 0}


def test_weights_say_how_often_a_sample_is_drawn() -> None:
    weights = torch.tensor([0.0, 1.0, 3.0])
    order = BatchOrder(torch.tensor([7, 8, 9]), 2, 0, weights=weights)
    drawn = torch.tensor([flat(epoch) for epoch in epochs(order, 4000)]).flatten()
    assert order.epoch_order(0).shape == (2,)  # as many as may be drawn
    counts = {value: int((drawn == value).sum()) for value in (7, 8, 9)}
    assert counts[7] == 0
    assert counts[9] / counts[8] == pytest.approx(3.0, rel=0.1)


@each_case(
    ("options", "message"),
    [
        ({"weights": torch.zeros(37)}, "all weights are 0"),
        ({"weights": torch.zeros(3)}, "weights for"),
        ({"weights": torch.full((37,), -1.0)}, "finite and not negative"),
        ({"weights": torch.full((37,), torch.nan)}, "finite and not negative"),
        ({"weights": torch.ones(37), "shuffle": False}, "shuffle=True"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        BatchOrder(SAMPLES, **{"batch_size": 4, "seed": 0, **options})


@pytest.mark.parametrize("state", [{"epoch": 0, "position": 38}, {"epoch": -1, "position": 0}])
def test_a_state_of_another_dataset_is_refused(state: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="has 37 samples"):
        BatchOrder(SAMPLES, 4, 0).load_state_dict(state)


def test_no_samples() -> None:
    empty: Tensor = torch.arange(0)
    with pytest.raises(ConfigError, match="No sample is left"):
        BatchOrder(empty, 4, 0)
