"""Starts, feeds and ends a node's process and its guard."""

import contextlib
import fcntl
import hashlib
import math
import os
import socket
import subprocess
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import PlantLostError, RealtimeError
from bhd_lerobot.programs import start_program
from bhd_lerobot.ros2.live.channel import Channel, Word
from bhd_lerobot.ros2.live.network import require_cyclonedds
from bhd_lerobot.ros2.live.spec import NodeSpec

_START_S = 30.0
_END_S = 3.0
_TOLD_S = 2.0  # of waiting until it is told what for
_CHECKS = 3  # looks at who else is there, before a command is sent
_RECEIVED_S = 8.0  # that it may take until nodes are found that receive commands
_GHOST_S = 25.0  # a node that was killed counts for up to 20 s
SILENCE_S = 3.0  # so long without a sign of life a process counts as stopped; old readings are noticed sooner


class NodeLink:
    """A node in a process of its own."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec = spec
        self._channel: Channel | None = None
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._wake = -1
        self._record: Any = None
        self._lock = -1

    def open(self, patience_s: float | None = 15.0) -> None:
        """Start the processes, and wait until every topic that is received has sent something.

        Args:
            patience_s: how long at the most [s]; None to wait for none.

        Raises:
            RealtimeError: the processes do not start, a topic sends nothing, or another program commands the robot;
                names it, and why.
        """
        require_cyclonedds()
        self.close()
        lock = _locked(self.spec)
        channel = self._channel = Channel(self.spec)
        self._lock, self._wake = lock, os.eventfd(0, os.EFD_NONBLOCK)
        self._record = np.zeros((), channel.command_dtype)
        try:
            needs_guard = any(one.stop is not None for one in self.spec.outputs)
            for role in ("node", "guard") if needs_guard else ("node",):
                self._start(role)
            if patience_s is not None:
                self._wait_for_topics(time.monotonic() + patience_s)
            if self.spec.outputs and self.spec.is_alone:
                self._wait_for_others()
        except BaseException:
            self.close()
            raise

    def _start(self, role: str) -> None:
        assert self._channel is not None
        ours, theirs = socket.socketpair()
        descriptors = (theirs.fileno(), self._channel.descriptor, self._wake)
        with theirs:
            self._processes[role] = start_program(
                "bhd_lerobot.ros2.live.process", role, *descriptors, descriptors=descriptors
            )
        with Connection(ours.detach()) as connection:
            connection.send(self.spec)
            if not connection.poll(_START_S):
                raise RealtimeError(f"The process of the ROS 2 node did not start within {_START_S:g} s.")
            try:
                answer = connection.recv()
            except EOFError:
                answer = f"failed: its process ended with status {self._processes[role].wait()}"
        if answer != "ready":
            raise RealtimeError(f"The ROS 2 node {self.spec.name} {answer}")

    def _wait_for_topics(self, end: float) -> None:
        told = time.monotonic() + _TOLD_S
        while True:
            state = self.state
            heard = state is not None and all(
                count or not one.is_required for one, count in zip(self.spec.inputs, state["count"], strict=True)
            )
            if (heard or not self.spec.inputs) and all(len(images) for images in self.channel.images):
                return
            if time.monotonic() > end:
                raise RealtimeError(self.problem or "No topic has sent anything yet.")
            if time.monotonic() > told:
                told = math.inf
                why = self.problem.partition(". ")[0] or "No topic has sent anything yet"
                print(f"Waiting for the robot, {end - time.monotonic():.0f} s more: {why}.", file=sys.stderr)
            self.check()
            time.sleep(0.01)

    def _wait_for_others(self) -> None:
        """Wait until the robot receives commands, and no other node's; one that was killed counts for a while."""
        words, start = self.channel.words, time.monotonic()
        while words[Word.CHECKS] < _CHECKS or words[Word.OTHERS] or words[Word.UNRECEIVED]:
            if time.monotonic() - start > (_GHOST_S if words[Word.OTHERS] else _RECEIVED_S):
                raise RealtimeError(self.problem or "The ROS 2 node has not looked who else commands the robot.")
            self.check()
            time.sleep(0.01)

    @property
    def channel(self) -> Channel:
        """The shared memory."""
        if self._channel is None:
            raise RealtimeError("The ROS 2 node is not open.")
        return self._channel

    @property
    def pids(self) -> dict[str, int]:
        """Process numbers, of ``node`` and ``guard``."""
        return {role: process.pid for role, process in self._processes.items()}

    @property
    def state(self) -> Any:
        """The newest state, see `Channel`; None before the first."""
        return self.channel.states.latest()

    @property
    def problem(self) -> str:
        """What is wrong with the topics, as text; empty if nothing."""
        state = self.state
        return "" if state is None else bytes(state["problem"]).decode(errors="ignore")

    def check(self, silence_s: float = SILENCE_S) -> None:
        """Raise if the node or its guard has ended or is stopped.

        Args:
            silence_s: so long without a sign of life one counts as stopped [s].
        """
        for role, word in (("node", Word.ALIVE), ("guard", Word.GUARD_ALIVE)):
            process = self._processes.get(role)
            if process is None:
                continue
            if process.poll() is not None:
                raise PlantLostError(f"The process of the ROS 2 {role} ended with status {process.returncode}.")
            if self.channel.silence_s(word) > silence_s:
                raise RealtimeError(f"The process of the ROS 2 {role} is stopped.")

    def write(self, values: NDArray[np.float64]) -> None:
        """Send a command, shape (numbers of all outputs,); never waits. The node is woken by one that is new."""
        record = self._record
        is_new = (record["values"] != values).any()
        record["stamp_ns"] = time.monotonic_ns()
        record["values"] = values
        self.channel.commands.publish(record)
        if is_new:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        """Stop the robot if it has a stop, and end the processes. May be called twice."""
        if self._channel is None:
            return
        self._channel.words[Word.END] = 1
        for process in self._processes.values():
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()
        self._channel.close()
        self._channel = None
        os.close(self._wake)
        self._wake = -1
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def _locked(spec: NodeSpec) -> int:
    """Return the descriptor of a lock on the robot that a node commands; -1 if it commands none.

    The second of two programs on one machine would otherwise stop the robot of the first before it is refused.
    """
    if not spec.outputs or not spec.is_alone:
        return -1
    robot = repr((spec.network.domain_number, [one.topic for one in spec.outputs]))
    name = f"bhd-ros2-{os.getuid()}-{hashlib.sha256(robot.encode()).hexdigest()[:16]}.lock"
    descriptor = os.open(Path(tempfile.gettempdir()) / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        topics = ", ".join(one.topic for one in spec.outputs)
        raise RealtimeError(
            f"Another program of this machine commands {topics} in ROS domain {spec.network.domain_number}. End it "
            "first."
        ) from error
    return descriptor
