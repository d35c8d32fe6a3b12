"""Hands the commands of a brain to a bridge, and notes what was accepted of them."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.bridge import Bridge
from bhd_lerobot.control.commands import BrainCommand, Chunk, Command, Goals
from bhd_lerobot.control.messages import Reason, SendResult
from bhd_lerobot.robots.host.robots import Acceptance

Mask = NDArray[np.bool_]
Refusals = dict[int, tuple[Reason, str]]
ToSetpoints = Callable[[NDArray[np.float64], Mask, NDArray[np.float64] | None], tuple[NDArray[np.float64], Refusals]]
"""Turns actions into setpoints, see `Host.to_setpoints`."""


class CommandSender:
    """Sends commands to n robots.

    Args:
        bridge: where they go.
        to_setpoints: turns actions into setpoints.
    """

    def __init__(self, bridge: Bridge, to_setpoints: ToSetpoints) -> None:
        self._bridge, self._to_setpoints = bridge, to_setpoints

    def send(self, command: Command, running: Mask, start_ns: int | None = None) -> Acceptance:
        """Send a command.

        Args:
            command: what the robots are to do; None continues with the last chunk or goal.
            running: the robots that are in an episode, shape (n,).
            start_ns: when a chunk begins [ns]; now if None.
        """
        receipt = Acceptance(SendResult(np.zeros(len(running), np.int8)))
        match command:
            case None:
                pass
            case Chunk(actions):
                self._send_chunk(actions, running, start_ns, receipt)
            case Goals(commands):
                self._submit(commands, receipt)
            case _:
                self._send_setpoint(command, running, receipt)
        return receipt

    def _send_setpoint(self, action: NDArray[np.float64], mask: Mask, receipt: Acceptance) -> None:
        if not mask.any():
            return
        setpoints, refused = self._to_setpoints(action, mask, None)
        if refused:
            mask = mask.copy()
            mask[list(refused)] = False
        receipt.sent = self._bridge.send(setpoints, mask)
        receipt.refuse(refused)

    def _send_chunk(
        self, actions: NDArray[np.float64], running: Mask, start_ns: int | None, receipt: Acceptance
    ) -> None:
        rows: list[NDArray[np.float64]] = []
        for action in actions:
            setpoints, refused = self._to_setpoints(action, running, rows[-1] if rows else None)
            receipt.refuse(refused)
            if refused:
                break  # the actions before it are sent
            rows.append(setpoints)
        results = self._bridge.send_chunk(np.array(rows), running, start_ns) if rows else []
        if results:
            # Of each robot, the first reason that is a refusal.
            reasons = np.array([result.reasons for result in results])
            first = reasons[(reasons != 0).argmax(axis=0), np.arange(len(running))]
            sent = receipt.sent.reasons
            sent[sent == Reason.ACCEPTED] = first[sent == Reason.ACCEPTED]

    def _submit(self, commands: Mapping[int, Sequence[BrainCommand]], receipt: Acceptance) -> None:
        for sim, goals in commands.items():
            refusals = [refusal for goal in goals if (refusal := self._bridge.submit(goal, sim)) is not None]
            if refusals:
                receipt.results[sim] = refusals
