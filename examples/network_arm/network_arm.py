"""An arm on the network, and the plant that drives it: a complete example of a robot that is not simulated by MuJoCo.

As a program this is the robot, in a process of its own: six joints and a gripper that follow commanded positions with a
time constant each, get them late, and lose some of them.

    python examples/network_arm/network_arm.py --port=47654

It has what a robot's controller has: a watchdog, which holds the joints where they are when commands cease, a status,
and an emergency stop (`kill -USR1`). `NetworkPlant` is its plant. It imports neither LeRobot nor torch, because it
lives in the real-time process.
"""

import argparse
import contextlib
import random
import select
import signal
import socket
import struct
import time
from collections import deque
from typing import Any

import numpy as np

import bhd_lerobot as bhd

JOINTS = 7  # six joints [rad], and the gripper's opening [m] last
HOLD, FOLLOW, RECOVER = range(3)
COMMAND = struct.Struct(f"<BQ{JOINTS}d")  # what to do, number, positions
STATE = struct.Struct(f"<BQ{2 * JOINTS}d")  # SafetyStatus, number, positions and speeds
LAG_S = np.array([0.02, 0.02, 0.01125, 0.01, 0.01, 0.01, 0.01875])  # as the servos of the UR5 that it stands for
FASTEST = np.array([3.2] * 6 + [0.16])  # [rad/s, m/s]
START = np.array([np.pi, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0, 0.085])


class NetworkPlant(bhd.Plant):
    """The arm as the cerebellum sees it.

    Args:
        config: the robot's configuration; its `address` says where the arm is, as ``"host:port"``.
        body: its hardware.
    """

    n = 1

    def __init__(self, config: Any, body: bhd.Body) -> None:
        host, _, port = config.address.partition(":")
        if not port.isdecimal():
            raise ValueError(f"robot.address is {config.address!r}; write host:port, such as 127.0.0.1:47654")
        self._address = host, int(port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._number = self._seen = self._stamp_ns = 0
        self._state: Any = None
        self._doing = HOLD

    def open(self) -> None:
        """Ask the arm for its state; it answers for as long as it is spoken to."""
        self._socket.connect(self._address)
        self._socket.setblocking(False)
        end = time.monotonic() + 5.0
        while self._state is None:
            if time.monotonic() > end:
                raise TimeoutError(f"no arm answers at {self._address[0]}:{self._address[1]}")
            self._send(HOLD, np.zeros(JOINTS))
            time.sleep(0.05)
            self._receive()

    def enable(self) -> None:
        """Let it follow from the next command on."""
        self._doing = FOLLOW

    def read(self, out: bhd.PlantReading) -> None:
        """Take the newest state; its time is when it came, for the arm has another clock."""
        self._receive()
        if self._doing == HOLD:
            self._send(HOLD, np.zeros(JOINTS))  # it goes on answering
        status, _, *values = self._state
        out.position[0], out.velocity[0] = values[:JOINTS], values[JOINTS:]
        out.safety[0] = status
        out.stamp_ns[0] = self._stamp_ns

    def write(self, ctrl: np.ndarray) -> None:
        """Send positions."""
        if self._doing == FOLLOW:
            self._send(FOLLOW, ctrl[0])

    def set_mode(self, mode: np.ndarray) -> None:
        """Let go of the arm where no motion is to come: its own controller holds it then."""
        if mode[0] in (bhd.Mode.SAFE_OFF, bhd.Mode.UNCONFIGURED):
            self._doing = HOLD

    def recover(self) -> bool:
        """Leave a stop of the arm's own."""
        self._send(RECOVER, np.zeros(JOINTS))
        return True  # it has stopped where it was, not where it was commanded to be

    def close(self) -> None:
        """Disconnect; the arm's watchdog holds it."""
        self._socket.close()

    def _send(self, what: int, values: np.ndarray) -> None:
        self._number += 1
        with contextlib.suppress(OSError):  # nobody is there now: that is seen by the age of the newest state
            self._socket.send(COMMAND.pack(what, self._number, *values))

    def _receive(self) -> None:
        while True:
            try:
                state = STATE.unpack(self._socket.recv(STATE.size))
            except OSError:  # nothing is waiting, or nobody is there
                return
            if state[1] > self._seen:
                self._seen, self._state, self._stamp_ns = state[1], state, time.monotonic_ns()


class Robot:
    """The arm itself: joints, latency, losses, watchdog.

    Args:
        port: where it listens, on this machine; any free one if 0.
        latency_s: time until a command acts [s].
        losses: share of the commands, and of the states, that are lost.
        watchdog_s: time without a command until it stops [s].
        rate_hz: states a second [Hz].
    """

    def __init__(self, port: int, latency_s: float, losses: float, watchdog_s: float, rate_hz: float) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._latency, self._losses, self._watchdog = latency_s, losses, watchdog_s
        self._period = 1 / rate_hz
        self._random = random.Random(0)
        self._position, self._velocity, self._target = START.copy(), np.zeros(JOINTS), START.copy()
        self._status, self._follows, self._number, self._commanded = bhd.SafetyStatus.NORMAL, False, 0, 0.0
        self._waiting: deque[tuple[float, np.ndarray]] = deque()
        self._peer: Any = None
        signal.signal(signal.SIGUSR1, self._press)

    def run(self) -> None:
        """Live until the process is killed."""
        print(f"arm at 127.0.0.1:{self._socket.getsockname()[1]}", flush=True)
        due = time.monotonic()
        while True:
            due += self._period
            while (left := due - time.monotonic()) > 0:
                if select.select([self._socket], [], [], left)[0]:
                    self._take(*self._socket.recvfrom(COMMAND.size))
            self._step(time.monotonic())
            if self._peer is not None and self._random.random() >= self._losses:
                self._number += 1
                state = STATE.pack(self._status, self._number, *self._position, *self._velocity)
                self._socket.sendto(state, self._peer)

    def _take(self, data: bytes, peer: Any) -> None:
        if len(data) != COMMAND.size or self._random.random() < self._losses:
            return
        self._peer = peer
        what, _, *values = COMMAND.unpack(data)
        self._follows = what == FOLLOW
        if what == RECOVER and self._status == bhd.SafetyStatus.STOPPED:
            self._status = bhd.SafetyStatus.NORMAL
            self._hold()
        if what == FOLLOW:
            self._commanded = time.monotonic()
            self._waiting.append((self._commanded + self._latency, np.array(values)))

    def _step(self, now: float) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            _, target = self._waiting.popleft()
            if self._follows and self._status == bhd.SafetyStatus.NORMAL:
                self._target = target
        if self._follows and self._status == bhd.SafetyStatus.NORMAL and now - self._commanded > self._watchdog:
            self._status = bhd.SafetyStatus.STOPPED
            self._hold()
        share = 1 - np.exp(-self._period / LAG_S)
        most = FASTEST * self._period
        step = np.clip(share * (self._target - self._position), -most, most)
        self._position, self._velocity = self._position + step, step / self._period

    def _hold(self) -> None:
        self._waiting.clear()
        self._target = self._position.copy()

    def _press(self, *_: Any) -> None:
        """Press the emergency stop, or release it."""
        pressed = self._status == bhd.SafetyStatus.EMERGENCY_STOP
        self._status = bhd.SafetyStatus.NORMAL if pressed else bhd.SafetyStatus.EMERGENCY_STOP
        self._hold()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="An arm on the network.")
    parser.add_argument("--port", type=int, default=47654)
    parser.add_argument("--latency", type=float, default=0.008, help="until a command acts [s]")
    parser.add_argument("--losses", type=float, default=0.02, help="share of packets that are lost")
    parser.add_argument("--watchdog", type=float, default=0.2, help="without commands until it stops [s]")
    parser.add_argument("--rate", type=float, default=500.0, help="states a second [Hz]")
    options = parser.parse_args()
    Robot(options.port, options.latency, options.losses, options.watchdog, options.rate).run()
