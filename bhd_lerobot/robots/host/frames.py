"""What a robot on the wall clock published, as the frames of an episode."""

from collections.abc import Callable
from typing import Any

import numpy as np

from bhd_lerobot.control.messages import NANOSECONDS, SendResult
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.realtime.frame_reader import Boundary
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.robots import Frame, FrameReport
from bhd_lerobot.robots.host.state import raised


def frame_of(mirror: Host, state: Any, seen_ns: int, origin_ns: int) -> Frame:
    """Return a published state as an observation.

    Args:
        mirror: a host like the one that published it.
        state: a record of `published_dtype`.
        seen_ns: when it is observed, monotonic [ns].
        origin_ns: when the episode began, monotonic [ns].
    """
    sensed = int(state["sensed_ns"])
    age = max(0, seen_ns - sensed) + int(state["oldest_ns"])
    physics = {keys.PHYSICS_STATE: state["physics"].copy()} if mirror.world is not None else {}
    return Frame(
        mirror.completed(state["observation"].copy()), np.array([sensed - origin_ns]), np.array([age]), physics
    )


def report_of(
    mirror: Host,
    before: Boundary,
    after: Boundary,
    *,
    requested: str,
    truth: Callable[[], Any],
    origin_ns: int,
) -> FrameReport:
    """Return the report of the frame between two boundaries.

    Args:
        mirror: a host like the one that published them.
        before: the boundary that it begins with.
        after: the boundary that it ends with.
        requested: the field of the record that says what was requested by its end.
        truth: returns what a task judges by at its end.
        origin_ns: when the episode began, monotonic [ns].
    """
    begun, end = before.state, after.state
    limits, watchdog = raised(begun, end)
    state, cerebellum = end["state"], mirror.cerebellum
    command, asked = (state[name][None, : cerebellum.width] for name in ("command", requested))
    columns = {
        **mirror.recorded(state[None], end["now_ns"]),
        keys.LATENESS: np.array([after.lateness_ns / NANOSECONDS]),
        keys.OVERRUNS: np.array([int(end["overruns"] - begun["overruns"])]),
        keys.SKIPPED: np.array([int(end["skipped"] - begun["skipped"])]),
    }
    return FrameReport(
        applied=mirror.to_action(command),
        requested=mirror.to_action(asked),
        sent=SendResult(np.zeros(1, np.int8)),
        limits=np.array([limits]),
        watchdog=np.array([watchdog]),
        mode=np.array([state["mode"]]),
        truth=truth,
        columns=columns,
        number=before.frame,
        # A brain that did not observe it did not wait for it.
        seen=frame_of(mirror, begun, int(begun["sensed_ns"]), origin_ns),
    )
