"""The two ends of what goes through a block beyond setpoints and states: requests, results, goals and their plans."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.realtime.mailbox import Mailbox
from bhd_lerobot.realtime.requests import EVENT_DTYPE, RequestClient, RequestServer, request_dtype

if TYPE_CHECKING:  # planning takes 100 MB, and a base plans nothing
    from bhd_lerobot.realtime.planning_link import PlanningLink, PlanServer

_REQUESTS, _EVENTS = 16, 64
_REST_S = 0.002  # between two checks of the planner for a request


def _dof(cerebellum: Cerebellum) -> int:
    arm = cerebellum.body.arm
    return 0 if arm is None else len(arm.chain.joints)


def _goals_of(cerebellum: Cerebellum) -> Any:
    """Return the goals of a robot that takes goals, else None."""
    return getattr(cerebellum.controller, "goals", None)


def section_sizes(cerebellum: Cerebellum) -> dict[str, int]:
    """Return what sections a block needs for one robot, and their sizes [bytes]."""
    sizes = {
        "requests": Mailbox.nbytes(request_dtype(_dof(cerebellum)), _REQUESTS),
        "events": Mailbox.nbytes(EVENT_DTYPE, _EVENTS),
    }
    if _goals_of(cerebellum) is not None:
        from bhd_lerobot.realtime.planning_link import PlanningLink

        sizes["plan"] = PlanningLink.nbytes(_dof(cerebellum), cerebellum.control_hz)
    return sizes


def planning_link(block: LiveBlock, dof: int, control_hz: int) -> "PlanningLink | None":
    """Return the planning of an arm whose goals the brain's process plans; None for a robot that takes none."""
    if not block.has("plan"):
        return None
    from bhd_lerobot.realtime.planning_link import PlanningLink

    return PlanningLink(block.section("plan"), dof, control_hz)


def cerebellum_side(block: LiveBlock, cerebellum: Cerebellum) -> Callable[[int], None]:
    """Return what answers requests, to be called once a tick with the cerebellum's time."""
    requests = Mailbox(request_dtype(_dof(cerebellum)), _REQUESTS, block.section("requests"))
    server = RequestServer(cerebellum, requests, Mailbox(EVENT_DTYPE, _EVENTS, block.section("events")))

    def serve(now_ns: int) -> None:
        server.serve(time.monotonic_ns())  # requests expire on the clock that both processes share

    return serve


class BrainSide:
    """The brain's process.

    Attributes:
        client: sends requests for modes and goals.
        planner: plans goals; None for a robot that takes no goals.
        serve: plans goals until its argument returns true, for a thread; None for a robot that takes no goals.

    Args:
        block: the block.
        cerebellum: one like that of the other side; its planner is used.
        wait: waits for about a tick, and raises if there is nothing to wait for any more.
    """

    def __init__(self, block: LiveBlock, cerebellum: Cerebellum, wait: Callable[[], None]) -> None:
        requests = Mailbox(request_dtype(_dof(cerebellum)), _REQUESTS, block.section("requests"))
        self.client = RequestClient(requests, Mailbox(EVENT_DTYPE, _EVENTS, block.section("events")), wait)
        self.serve: Callable[[Callable[[], bool]], None] | None = None
        self.planner: PlanServer | None = None
        if (goals := _goals_of(cerebellum)) is not None:
            from bhd_lerobot.realtime import planning_link as planning

            server = self.planner = planning.PlanServer(block.section("plan"), goals.planner)

            def serve(stop: Callable[[], bool]) -> None:
                server.serve(stop, lambda: time.sleep(_REST_S))

            self.serve = serve
