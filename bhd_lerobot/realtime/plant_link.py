"""A cerebellum and a plant in two processes: what passes between them, and when the plant stops by itself.

Actuator commands go one way and readings the other, each through a small `StateRing` in shared memory: both sides take
the newest entry and neither ever waits. Every command carries the time at which it was written; a plant that sees it
become too old stops the robot without asking anybody, as a motor controller does whose bus has gone quiet.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.guard import Guard
from bhd_lerobot.control.kernels import largest_change
from bhd_lerobot.control.plant import Plant, PlantReading, SafetyStatus
from bhd_lerobot.realtime.block import LiveBlock

_GENTLE = 0.1  # of the difference that two changes may have: by so much may catching up speed up, or slow down
_ROUNDING = 1e-9
_COMMANDS = 8  # capacity of the ring; only the newest counts
_START_TICKS = 4  # a first command may be so many ticks' largest change away from where the robot is


class PlantPhase(IntEnum):
    """Who commands the actuators."""

    WAITING = 0
    """Nobody yet: no command has come since the robot was placed or its loop started; the world stands still."""
    DRIVEN = 1
    """The cerebellum."""
    STOPPED = 2
    """The plant itself: it stopped the robot and holds it, until a fresh command acknowledges the stop."""


@dataclass(frozen=True)
class PlantShape:
    """Sizes of what a plant publishes.

    Attributes:
        joints: joints and actuators.
        positions: generalised positions of the physics.
        velocities: generalised velocities of the physics.
        features: floats in an observation.
        touches: kinds of touches.
        sensors: further values that the plant measures, see `PlantReading.sensors`.
        capacity: states that can still be read.
    """

    joints: int
    positions: int
    velocities: int
    features: int
    touches: int
    sensors: int
    capacity: int

    @property
    def command_dtype(self) -> np.dtype:
        """Return the dtype of commands.

        - ``number``: counts from 1; ``stamp_ns``: when it was written, monotonic.
        - ``acknowledged``: up to which of its own stops the plant may be driven again.
        - ``mode``: the `Mode` that the robot is in.
        - ``actuators``: wheel speeds [rad/s], or joint positions [rad] or torques [N m] and the opening [m].
        """
        numbers = [(name, np.int64) for name in ("number", "stamp_ns", "acknowledged", "mode")]
        return np.dtype([*numbers, ("actuators", np.float64, (1, self.joints))])

    @property
    def state_dtype(self) -> np.dtype:
        """Return the dtype of states. Times are monotonic [ns].

        - ``index``, ``due_ns``, ``start_ns``: the tick on the plant's grid.
        - ``phase``: a `PlantPhase`; ``stops``: how often the plant has stopped by itself; ``stopped_ns``: the tick at
          which it last did.
        - ``command``, ``command_ns``: number and stamp of the newest command; ``actuators``: what the actuators got in
          this tick.
        - ``stamp_ns``: when what follows was read; ``tick``, ``oldest``: the simulation's tick, and that of the oldest
          reading in the observation.
        - ``touches``: in how many ticks there was each kind of touch; ``observation``; ``position``, ``velocity``,
          ``effort``: of the joints; ``qpos``, ``qvel``: of the physics.
        - ``sensors``: the newest further values; ``sensors_ns``: when the oldest of them was measured.
        """
        names = "index due_ns start_ns phase stops stopped_ns command command_ns stamp_ns tick oldest sensors_ns"
        numbers = [(name, np.int64) for name in names.split()]
        sizes = dict.fromkeys(("actuators", "position", "velocity", "effort"), self.joints)
        sizes |= {"observation": self.features, "qpos": self.positions, "qvel": self.velocities}
        sizes["sensors"] = self.sensors
        floats = [(name, np.float64, (1, size)) for name, size in sizes.items()]
        return np.dtype([*numbers, ("touches", np.int64, (self.touches,)), *floats])

    def sections(self) -> dict[str, int]:
        """Return what sections a block needs, and their sizes [bytes]."""
        return {
            "plant_commands": StateRing.nbytes(self.command_dtype, _COMMANDS),
            "plant_states": StateRing.nbytes(self.state_dtype, self.capacity),
        }

    def as_dict(self) -> dict[str, int]:
        """Return the sizes by name, for the description of a block under the key ``plant``."""
        return asdict(self)


class PlantLink:
    """The two rings between a cerebellum and a plant.

    Attributes:
        shape: the sizes.
        commands: what the cerebellum writes, of `PlantShape.command_dtype`.
        states: what the plant writes, of `PlantShape.state_dtype`.

    Args:
        shape: the sizes.
        commands: memory of the size that `PlantShape.sections` says; new memory if None.
        states: the same for the states.
    """

    def __init__(self, shape: PlantShape, commands: Any = None, states: Any = None) -> None:
        self.shape = shape
        self.commands = StateRing(shape.command_dtype, _COMMANDS, commands)
        self.states = StateRing(shape.state_dtype, shape.capacity, states)

    @classmethod
    def of(cls, block: LiveBlock) -> Self | None:
        """Return the link in a block, or None if its robot has no plant in a process of its own."""
        if "plant" not in block.about:
            return None
        shape = PlantShape(**block.about["plant"])
        return cls(shape, block.section("plant_commands"), block.section("plant_states"))


class RemotePlant(Plant):
    """The plant as the cerebellum's process sees it.

    Attributes:
        state: the newest state, of `PlantShape.state_dtype`; None before there is one.

    Args:
        link: the rings.
        clock: monotonic time [ns].
    """

    n = 1

    def __init__(self, link: PlantLink, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._states, self._commands, self._clock = link.states, link.commands, clock
        self._record = np.zeros((), link.shape.command_dtype)
        self._record["number"] = len(link.commands)
        self._seen = 0
        self._stamp_ns = np.zeros(1, np.int64)
        self.state: Any = None

    def refresh(self) -> Any:
        """Take the newest state, and return it."""
        published = len(self._states)
        if published != self._seen:
            self._seen, newest = published, self._states.latest()
            self.state = self.state if newest is None else newest
        return self.state

    @property
    def has_stopped(self) -> bool:
        """Whether the plant has stopped by itself, by the state taken last, and that was not acknowledged yet."""
        return self.state is None or bool(self.state["stops"] > self._record["acknowledged"])

    def recover(self) -> bool:
        """Let the plant be driven again after the stops that the state taken last reports; return if there were any."""
        if self.state is None or not self.has_stopped:
            return False
        self._record["acknowledged"] = self.state["stops"]
        return True

    def read(self, out: PlantReading) -> None:
        """Write the newest readings into `out`; a stop that was not acknowledged is a fault."""
        state = self.refresh()
        if state is not None:
            out.position[:], out.velocity[:] = state["position"], state["velocity"]
            out.effort[:], out.has_effort = state["effort"], True
            out.stamp_ns = self._stamp_ns
            out.stamp_ns[0] = state["stamp_ns"]
            out.sensors[:], out.sensors_ns[0] = state["sensors"], state["sensors_ns"]
        out.safety[:] = SafetyStatus.STOPPED if self.has_stopped else SafetyStatus.NORMAL

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Send the mode, shape (1,), with the next commands."""
        self._record["mode"] = mode[0]

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Send actuator commands, shape (1, joints)."""
        record = self._record
        record["number"] += 1
        record["actuators"] = ctrl
        record["stamp_ns"] = self._clock()
        self._commands.publish(record)


class CommandGuard:
    """The plant's judgement of the commands that it gets: who commands the actuators in this tick.

    A stop is latched. It ends with a fresh command that acknowledges it, never with commands alone: a cerebellum that
    was away for a while has not seen where the robot went meanwhile.

    Attributes:
        phase: who commands.
        stops: how often the plant has stopped by itself.
        stopped_ns: when it last did [ns].
        number: number of the newest command.
        stamp_ns: when that was written [ns].
        actuators: what is to be written: the commands in force, or what leads to them gradually, shape (1, joints).
        mode: the robot's `Mode` when they were written, shape (1,).

    Args:
        link: the rings.
        timeout_ns: age at which a command is too old, and so long may the plant itself be away [ns].
        wire: what may be written to the actuators; a command beyond it stops the plant.
        period_ns: of a tick [ns].
    """

    def __init__(self, link: PlantLink, timeout_ns: int, wire: Guard, period_ns: int) -> None:
        self._commands, self._timeout_ns, self._wire, self._period_ns = link.commands, timeout_ns, wire, period_ns
        self.phase = PlantPhase.WAITING
        self.stops = self.stopped_ns = self.number = self.stamp_ns = 0
        self.actuators: NDArray[np.float64] = wire.written.copy()
        self._catches_up, self._extra = False, np.zeros_like(self.actuators)
        self.mode = np.zeros(1, np.int8)
        self._begun = self._acknowledged = self._seen = self._taken_ns = 0
        self._checked_ns: int | None = None
        self._is_safe = True

    def place(self) -> None:
        """Forget a stop: the robot was put somewhere else, at rest."""
        self.phase = PlantPhase.WAITING
        self.begin()

    def begin(self) -> None:
        """Begin a segment: commands from before it do not count. A stop stays latched."""
        self._begun = len(self._commands)
        self._checked_ns = None
        if self.phase == PlantPhase.DRIVEN:
            self.phase = PlantPhase.WAITING

    def check(self, now_ns: int, position: NDArray[np.float64]) -> PlantPhase:
        """Return who commands the actuators now.

        Args:
            now_ns: the time [ns].
            position: of the joints as they were read last, shape (1, joints).
        """
        self._take(now_ns, position)
        before, self._checked_ns = self._checked_ns, now_ns
        away = before is not None and now_ns - before > self._timeout_ns
        age = now_ns - self.stamp_ns
        good = self.number > self._begun and self._is_safe and -self._timeout_ns <= age <= self._timeout_ns
        if self.phase == PlantPhase.DRIVEN:
            if away or not good:
                self.phase = PlantPhase.STOPPED
                self.stops += 1
                self.stopped_ns = now_ns
        elif good and (self.phase == PlantPhase.WAITING or self._acknowledged >= self.stops):
            self.phase = PlantPhase.DRIVEN
        if self.phase == PlantPhase.DRIVEN:
            self.follow()
        return self.phase

    def _take(self, now_ns: int, position: NDArray[np.float64]) -> None:
        written = len(self._commands)
        if written == self._seen:
            return
        self._seen = written
        command: Any = self._commands.latest()
        if command is None:
            return  # nothing that is whole: the last one grows old
        # What was sent since the last tick counts, but no more of it than there was time for.
        ticks = min(int(command["number"]) - self.number, (now_ns - self._taken_ns) // self._period_ns + 1)
        if self.phase != PlantPhase.DRIVEN:
            self._wire.start(command["actuators"], position)
            self.actuators[:], self._extra[:] = self._wire.written, 0.0
            ticks = _START_TICKS
        self.number, self.stamp_ns = int(command["number"]), int(command["stamp_ns"])
        self._acknowledged, self._taken_ns = int(command["acknowledged"]), now_ns
        self.mode[0] = command["mode"]
        self._is_safe = self._wire.check(command["actuators"], position, ticks) is None
        near = np.abs(self._wire.written - self.actuators) <= self._wire.limits.change
        self._catches_up |= ticks > 1 and (self.phase == PlantPhase.DRIVEN or not near.all())

    def follow(self) -> None:
        """Let `actuators` follow the commands by one tick; `check` has done it for its own.

        Of commands that were missed no more is made up in one write than a tick may change, and gradually: the rest
        follows in the next ones.
        """
        wire, now, extra = self._wire, self.actuators, self._extra
        if not self._catches_up:
            now[:] = wire.written
            return
        behind, limits = wire.written - now, wire.limits
        late = behind - wire.rate  # beyond the change of the newest command
        bend = np.where(np.isfinite(limits.bend), _GENTLE * limits.bend, limits.change)
        most = np.minimum(largest_change(np.abs(late) / bend) * bend, np.maximum(extra * np.sign(late), 0.0) + bend)
        extra[:] = np.copysign(np.minimum(most, np.abs(late)), late)
        step = np.minimum(np.maximum(wire.rate + extra, -limits.change), limits.change) * np.sign(behind)
        now += np.copysign(np.minimum(np.maximum(step, 0.0), np.abs(behind)), behind)
        self._catches_up = bool((np.abs(wire.written - now) > _ROUNDING).any())
