"""Requests of a caller to a cerebellum in another process, and the replies and results that come back.

Each request has a number, and is answered by one reply with the same number. Results come when goals end.
"""

import time
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, Reason, Request
from bhd_lerobot.control.motion.goal_codec import (
    NAME_BYTES,
    RESULT_DTYPE,
    check_encodable,
    decode_goal,
    decode_name,
    decode_result,
    encode_goal,
    encode_name,
    encode_result,
    goal_dtype,
)
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.mailbox import Mailbox

TIMEOUT_S = 1.0  # [s] a cerebellum that does not answer for so long is not running


class RequestKind(IntEnum):
    """Kinds of requests."""

    MODE = 0
    """A change of mode; the reply is a `Reason`."""
    GOAL = 1
    """To take a goal; the reply is that it was accepted, or the refusal."""
    CANCEL = 2
    """To cancel a goal; the reply is a `ResultCode`."""


class EventKind(IntEnum):
    """Kinds of events from the cerebellum."""

    REPLY = 0
    RESULT = 1


def request_dtype(dof: int) -> np.dtype:
    """Return the dtype of requests to a robot whose arm has so many joints; 0 if it has none."""
    return np.dtype(
        [
            ("number", np.int64),
            ("expires_ns", np.int64),
            ("kind", np.int8),
            ("mode", np.int8),
            ("press", np.int64),
            ("goal", goal_dtype(dof)),
        ],
        align=True,
    )


EVENT_DTYPE = np.dtype(
    [
        ("number", np.int64),
        ("kind", np.int8),
        ("code", np.int8),
        ("refused", np.bool_),
        ("result", RESULT_DTYPE),
    ],
    align=True,
)
"""A reply to the request of this number: its code, and the refusal of a goal; or a result."""


class RequestServer:
    """The cerebellum's side. One robot: simulation 0.

    Args:
        requests: where requests come from, of dtype `request_dtype(dof)`.
        events: where replies and results go to, of dtype `EVENT_DTYPE`.

    Attributes:
        expired: how many requests were not carried out because they came too late.
        invalid: how many requests were dropped because no client writes such.
    """

    def __init__(self, cerebellum: Cerebellum, requests: Mailbox, events: Mailbox) -> None:
        self.expired = self.invalid = 0
        self._cerebellum, self._requests, self._events = cerebellum, requests, events
        self._unposted: deque[CommandResult] = deque()  # results that there was no room for

    def serve(self, now_ns: int) -> None:
        """Carry out the next request, and post its reply and the results that have come; to be called once a tick.

        One request a tick bounds what a tick costs. What there is no room for stays where it is, and nothing is lost.

        Args:
            now_ns: the present time on the caller's clock [ns].
        """
        if not self._events.full and (request := self._requests.take()) is not None:
            self._answer(request, now_ns)
        results = self._cerebellum.controller.take_results(0)
        if results:
            self._unposted.extend(results)
        if self._unposted:
            self._post()

    def _answer(self, request: Any, now_ns: int) -> None:
        cerebellum = self._cerebellum
        if now_ns > int(request["expires_ns"]):
            # The caller does not wait for it any more, and does not expect it to happen now.
            self.expired += 1
            return
        try:
            kind, mode = RequestKind(int(request["kind"])), Request(int(request["mode"]))
            goal, name = decode_goal(request["goal"]), decode_name(request["goal"])
        except (ValueError, IndexError):  # another process wrote garbage
            self.invalid += 1
            return
        event = np.zeros(1, EVENT_DTYPE)[0]
        event["number"], event["kind"] = request["number"], EventKind.REPLY
        if kind == RequestKind.MODE:
            event["code"] = cerebellum.request(mode, press=int(request["press"])).reasons[0]
        elif kind == RequestKind.GOAL:
            refusal = cerebellum.submit(0, goal)
            if refusal is not None:
                event["refused"], event["code"], event["result"] = True, refusal.code, encode_result(refusal)
        else:
            event["code"] = cerebellum.controller.cancel(0, name)
        self._events.post(event)

    def _post(self) -> None:
        while self._unposted and not self._events.full:
            event = np.zeros(1, EVENT_DTYPE)[0]
            event["kind"] = EventKind.RESULT
            event["result"] = encode_result(self._unposted.popleft())
            self._events.post(event)


class RequestClient:
    """The caller's side, for one thread at a time.

    A request that is not answered in time raises an error. It is not carried out later; but if it was carried out and
    its reply is what came too late, a goal may have been taken: its result comes with `take_results`.

    Args:
        requests: where requests go to, of dtype `request_dtype(dof)`.
        events: where replies and results come from, of dtype `EVENT_DTYPE`.
        timeout_s: how long a reply may take [s].
        clock_ns: the time on the clock that the cerebellum's side uses, too [ns].
    """

    def __init__(
        self,
        requests: Mailbox,
        events: Mailbox,
        wait: Callable[[], None],
        timeout_s: float = TIMEOUT_S,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._requests, self._events, self._wait, self._clock_ns = requests, events, wait, clock_ns
        self._timeout_ns = round(timeout_s * NANOSECONDS)
        self._dof = int(requests.dtype["goal"]["joint_target"].shape[0])
        self._number = clock_ns()  # a reply to an earlier user of the mailboxes is not taken for an own one
        self._reply: Any = None
        self._live: set[str] = set()  # goals that were accepted and whose result has not come yet
        self._results: list[CommandResult] = []

    def request(self, request: Request, press: int = 0) -> Reason:
        """Ask for a change of mode, and return the outcome of it; a reset acknowledges this press of the stop only."""
        return Reason(int(self._ask(RequestKind.MODE, mode=request, press=press)["code"]))

    def submit(self, command: BrainCommand) -> CommandResult | None:
        """Send a goal.

        A goal that does not fit into a record is refused here.

        Returns:
            None if it was accepted: its one result comes later, by `take_results`. Otherwise the refusal, which is also
            among the results, except for a goal that has the name of one that is followed or waits.
        """
        failure = check_encodable(command, self._dof)
        if failure is not None:
            refusal = CommandResult(command.task_id, False, failure.code, failure.message)
            self._take_events()
            if str(command.task_id) not in self._live:
                self._results.append(refusal)
            return refusal
        reply = self._ask(RequestKind.GOAL, goal=encode_goal(command, self._dof), name=command.task_id)
        return decode_result(reply["result"]) if reply["refused"] else None

    def cancel(self, task_id: str) -> ResultCode:
        """Cancel a goal: decelerate, then hold. Return `SUCCEEDED`, or `UNKNOWN_ID` if there is no such goal."""
        if not isinstance(task_id, str) or len(task_id.encode("utf-8", "surrogatepass")) > NAME_BYTES:
            return ResultCode.UNKNOWN_ID  # no goal can have this name
        return ResultCode(int(self._ask(RequestKind.CANCEL, goal=encode_name(task_id, self._dof))["code"]))

    def take_results(self) -> list[CommandResult]:
        """Return the results that were not taken yet, in the order in which the goals ended."""
        self._take_events()
        results, self._results = self._results, []
        return results

    def _ask(
        self, kind: RequestKind, mode: Request = Request.CONFIGURE, goal: Any = None, name: str = "", press: int = 0
    ) -> Any:
        self._number += 1
        self._reply = None
        end_ns = self._clock_ns() + self._timeout_ns
        record = np.zeros(1, self._requests.dtype)[0]
        record["number"], record["expires_ns"], record["kind"], record["mode"] = self._number, end_ns, kind, mode
        record["press"] = press
        if goal is not None:
            record["goal"] = goal
        posted = False
        while True:
            posted = posted or self._requests.post(record)
            self._take_events(kind, name)
            if self._reply is not None:
                return self._reply
            if self._clock_ns() > end_ns:
                raise RealtimeError(
                    f"The cerebellum has not answered a {kind.name} request within {self._timeout_ns / NANOSECONDS:g} "
                    "s: its process has ended, is stopped, or gets no processor time. Disconnect and connect again."
                )
            self._wait()

    def _take_events(self, kind: RequestKind | None = None, name: str = "") -> None:
        """Take what has come; note the reply to the last request, which was of this kind and about this goal."""
        while (event := self._events.take()) is not None:
            if event["kind"] == EventKind.RESULT:
                result = decode_result(event["result"])
                self._live.discard(result.task_id)
                self._results.append(result)
            elif event["number"] == self._number and self._reply is None:
                self._reply = event
                if kind == RequestKind.GOAL and not event["refused"]:
                    self._live.add(name)
