"""The room of the stand-in for a robot, and how a peer ends."""

import math
import signal
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.ros2.peer_env import HERE, Peer


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Import the room, which needs no ROS."""
    monkeypatch.syspath_prepend(str(HERE / "peers"))
    import room

    yield room
    del sys.modules["room"]


def test_the_nearest_of_many_rays_is_the_clearance(room: Any) -> None:
    world, random = room.Room(), np.random.default_rng(0)
    angles = np.linspace(0, math.tau, 5_000)
    for x, y in random.uniform(-1.9, 1.9, (100, 2)):
        if (clearance := world.clearance(x, y)) > 0:
            assert world.ranges(x, y, angles).min() == pytest.approx(clearance, abs=1e-3)


def test_a_base_that_is_driven_into_a_wall_counts_one_contact_and_stays_in_the_room(room: Any) -> None:
    base = room.Base(room.Room(), x=0.0, y=-0.6, command=(0.2, 0.0))
    for _ in range(1500):
        base.step(0.01)
    assert base.contacts == 1
    assert base.x == pytest.approx(2.0 - room.BODY_RADIUS, abs=0.01)
    base.command = (-0.2, 0.0)
    for _ in range(100):
        base.step(0.01)
    assert base.contacts == 1
    assert base.x < 1.8


def test_a_peer_that_does_not_listen_to_sigint_is_killed(domain: int) -> None:
    with Peer("topic.py", "list", domain=domain) as peer:
        peer.wait_event("list")
        peer.signal(signal.SIGSTOP)
        assert peer.stop() == 0  # SIGCONT comes first
    with Peer("topic.py", "list", domain=domain) as peer:
        assert peer.stop(seconds=0) in (-signal.SIGKILL, -signal.SIGINT, 0)
