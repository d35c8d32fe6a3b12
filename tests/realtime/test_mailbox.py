from collections import deque
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.mailbox import Mailbox
from tests.control.support import shared_block
from tests.forks import Fork
from tests.realtime.mail_support import CAPACITY, RECORD, post_numbers, record


def number_of(value: np.void | None) -> int | None:
    if value is None:
        return None
    assert (value["copies"] == value["number"]).all()
    assert value["flag"] == value["number"] % 2
    return int(value["number"])


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 7))
def test_it_behaves_like_a_bounded_queue(posts: list[bool], capacity: int) -> None:
    mailbox, model = Mailbox(RECORD, capacity), deque[int]()
    for number, is_post in enumerate(posts):
        if is_post:
            accepted = mailbox.post(record(number))
            assert accepted == (len(model) < capacity)
            if accepted:
                model.append(number)
        else:
            assert number_of(mailbox.take()) == (model.popleft() if model else None)
        assert len(mailbox) == len(model)
        assert mailbox.full == (len(model) == capacity)


@pytest.mark.parametrize("ends", [(2**62, 0), (0, 2**62), (-5, 3), (2**62, -(2**62))])
def test_ends_that_cannot_be_empty_the_mailbox_and_what_is_posted_next_arrives(ends: tuple[int, int]) -> None:
    mailbox = Mailbox(RECORD, 3)
    mailbox.post(record(1))
    mailbox._head[0], mailbox._tail[0] = ends
    assert 0 <= len(mailbox) <= 3
    assert mailbox.take() is None
    assert mailbox.post(record(2))
    assert number_of(mailbox.take()) == 2
    assert mailbox.take() is None


def test_a_mailbox_has_room_and_the_stated_size() -> None:
    with pytest.raises(ConfigError, match="0"):
        Mailbox(RECORD, 0)
    size = Mailbox.nbytes(RECORD, 3)
    assert size % 8 == 0  # whatever follows it is aligned
    mailbox = Mailbox(RECORD, 3, bytearray(size))
    assert [mailbox.post(record(number)) for number in range(4)] == [True] * 3 + [False]
    with pytest.raises(ValueError, match="buffer"):
        Mailbox(RECORD, 3, bytearray(size - 1))


def test_between_two_processes_nothing_is_lost_reordered_or_torn(tmp_path: Path) -> None:
    count, path = 1000, tmp_path / "block"
    mailbox = Mailbox(RECORD, CAPACITY, shared_block(path, Mailbox.nbytes(RECORD, CAPACITY)))
    process = Fork(post_numbers, path, count)
    for number in range(count):
        while (taken := mailbox.take()) is None:
            assert process.poll() is None or len(mailbox)
        assert number_of(taken) == number
    assert process.wait() == 0
    assert mailbox.take() is None
