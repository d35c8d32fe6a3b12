"""Messages between brain, bridge and cerebellum.

Times are whole nanoseconds, so that a grid of ticks is exact and an age does not depend on how long a process has been
running. Arrays carry the simulation axis first; a robot is n = 1.
"""

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1_000_000_000
HORIZON_NS = 10 * NANOSECONDS
"""A command that is due later than this is refused [ns]: 100 frames at 10 fps, the action chunks of most policies."""

SEQUENCE_STEP = 1 << 31
"""A command whose sequence number is further than this after that of the command before it is refused."""


class Mode(IntEnum):
    """What the cerebellum is doing.

    `UNCONFIGURED -> INACTIVE -> HOLD <-> TRACKING -> STOPPING -> HOLD | SAFE_OFF`. `ESTOP` and `FAULT` latch.
    """

    UNCONFIGURED = 0
    """No plant reading has been taken yet; no command is accepted."""
    INACTIVE = 1
    """Configured, at rest, no command is accepted before `activate`."""
    HOLD = 2
    """At rest, and ready: the next setpoint starts motion."""
    TRACKING = 3
    """Following setpoints."""
    STOPPING = 4
    """Ramping to rest, because the command is too old or because the robot is being deactivated."""
    SAFE_OFF = 5
    """Deactivated: at rest, no command is accepted before `reset` and `activate`."""
    ESTOP = 6
    """Emergency stop, latched."""
    FAULT = 7
    """The plant reported something impossible, or the robot ran into something; latched."""


class Reason(IntEnum):
    """Why a command or a request was accepted or refused."""

    ACCEPTED = 0
    NON_FINITE = 1
    WRONG_WIDTH = 2
    OUT_OF_ORDER = 3
    STALE = 4
    FIFO_FULL = 5
    NOT_ACTIVE = 6
    ESTOP = 7
    FAULT = 8
    WRONG_MODE = 9
    NOT_AT_REST = 10
    NO_POSTURE = 11
    BEYOND_HORIZON = 12
    PRESSED = 13

    @property
    def explanation(self) -> str:
        """What it means, and what to do about it."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Reason.ACCEPTED: "accepted",
    Reason.NON_FINITE: "the command holds NaN or an infinity",
    Reason.WRONG_WIDTH: "the command has another number of values than the robot has command dimensions",
    Reason.OUT_OF_ORDER: "the command's sequence number or due time is not after that of the command before it, or its "
    f"sequence number is more than {SEQUENCE_STEP:,} after it; a queue takes the commands of one sender",
    Reason.STALE: "the command was due longer ago than the command time-out",
    Reason.FIFO_FULL: "the command queue is full; send later or make it longer",
    Reason.NOT_ACTIVE: "the robot is not active; call activate() first, after a deactivation reset() and activate()",
    Reason.ESTOP: "the emergency stop is latched; clear its cause, then call reset() and activate()",
    Reason.FAULT: "a fault is latched: the robot ran into something (an arm: protective stop), or the plant reported "
    "a fault, fell silent or was too late; clear the cause, then call reset() and activate()",
    Reason.WRONG_MODE: "the request does not apply in the present mode",
    Reason.NO_POSTURE: "no admissible posture of the arm puts the tool there",
    Reason.BEYOND_HORIZON: f"the command is due more than {HORIZON_NS // NANOSECONDS} s from now; send shorter action "
    "chunks, more often",
    Reason.NOT_AT_REST: "the robot is still stopping; ask again when it is at rest",
    Reason.PRESSED: "the robot presses on something, or something presses on it; remove it, then ask again",
}


def mode_reason(mode: Mode) -> Reason:
    """Return why a robot in this mode takes no commands, or `ACCEPTED` if it does."""
    if mode in (Mode.HOLD, Mode.TRACKING, Mode.STOPPING):
        return Reason.ACCEPTED
    return {Mode.ESTOP: Reason.ESTOP, Mode.FAULT: Reason.FAULT}.get(mode, Reason.NOT_ACTIVE)


class Limit(IntFlag):
    """What the safety filter changed about a command during a frame."""

    NONE = 0
    NON_FINITE = 1
    """The reference was not finite and the robot was stopped."""
    VELOCITY = 2
    """Clipped to the velocity limit, of the command or of a wheel."""
    ACCELERATION = 4
    """Slowed to the acceleration limit."""
    EFFORT = 8
    """The commanded effort is above the servo's largest: the servo gives its largest, the command stays as it is."""
    POSITION = 16
    """Clipped to the range of the joint."""
    POSTURE = 32
    """A tool pose was refused, because no posture reaches it, or none without a jump: the arm holds the last one."""
    CLEARANCE = 64
    """A setpoint would have brought an arm too near to itself or to the table, or a base with a collision monitor too
    near to what its lidar sees: it was slowed down, or stopped."""


class Watchdog(IntFlag):
    """What the watchdogs noticed during a frame."""

    NONE = 0
    COMMAND_AGE = 1
    """The command became older than its time-out; the robot ramps to zero."""
    BLOCKED = 2
    """An arm stayed away from where it was commanded to be: a protective stop, mode FAULT."""
    BRAIN = 4
    """The brain's process showed no sign of life for its time-out; the robot decelerates and holds."""
    RECORDER = 8
    """In recordings of versions before 0.4: the recorder's process was silent; the robot decelerated and held."""
    PLANT = 16
    """The plant showed no sign of life for its time-out, reported a stop of its own, or its readings were no
    measurements of the present (not finite, too old, from the future, faster than a joint can turn) or contradicted
    each other: mode FAULT."""
    MISSES = 32
    """So many ticks in a row came too late that the loop is no control loop any more: mode FAULT."""
    GUARD = 64
    """What was to be written to an actuator was not finite, out of its range, too far from the last, or bent too
    suddenly: mode FAULT, and the last safe commands are continued at a falling speed until the stop begins."""
    FORCE = 128
    """An arm pressed with more than its largest force: a protective stop, mode FAULT."""
    SPEED = 256
    """A tool under impedance control, or a joint of its arm, moved too fast: a protective stop, mode FAULT."""


class Request(IntEnum):
    """A request to the mode machine."""

    CONFIGURE = 0
    ACTIVATE = 1
    DEACTIVATE = 2
    RESET = 3


@dataclass(frozen=True)
class Setpoint:
    """An action with a due time.

    Attributes:
        sequence: counts up with every setpoint of one sender, by `SEQUENCE_STEP` at the most.
        due_ns: when it is to take effect, on the cerebellum's clock [ns].
        values: the command, shape (n, width), in the units of the action features.
        replaces: whether it takes the place of what was sent before and is not due yet: the first of a new action
            chunk, or one for now. Otherwise it must not be due before what was sent before.
    """

    sequence: int
    due_ns: int
    values: NDArray[np.float64]
    replaces: bool = False


@dataclass(frozen=True)
class SendResult:
    """The outcome of a setpoint in each simulation.

    Attributes:
        reasons: a `Reason` for each simulation, shape (n,).
    """

    reasons: NDArray[np.int8]

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Whether each simulation took it, shape (n,)."""
        return self.reasons == Reason.ACCEPTED


@dataclass(frozen=True)
class CerebellumState:
    """What the cerebellum publishes; a copy, not a view.

    Attributes:
        stamp_ns: time of the tick [ns].
        joint_positions: joint or wheel angles [rad], a gripper's opening [m], shape (n, joints).
        joint_velocities: their speeds [rad/s, m/s], shape (n, joints).
        joint_efforts: torques of the joints [N m], force of a gripper [N], shape (n, joints); measured if possible.
        contact_wrench: what the surroundings put on the tools [N, N m], see `Controller.contact_wrench`, shape (n, 6).
        pressed: the force with which each robot at rest and something press on each other [N], shape (n,); 0 where it
            is small enough to reset and to activate the robot, and where it is not known.
        command: the command applied, after all limits, shape (n, width).
        measured: where the robot really is in the space of the commands, shape (n, width).
        odometry: x [m], y [m] and yaw [rad] since the last reset, from the encoders, shape (n, 3); shape (n, 0) for a
            robot that does not drive.
        mode: a `Mode` for each simulation, shape (n,).
        is_moving: whether any joint is faster than 0.01 rad/s, shape (n,).
        emergency_stop: whether the emergency stop is latched, shape (n,).
    """

    stamp_ns: int
    joint_positions: NDArray[np.float64]
    joint_velocities: NDArray[np.float64]
    joint_efforts: NDArray[np.float64]
    contact_wrench: NDArray[np.float64]
    pressed: NDArray[np.float64]
    command: NDArray[np.float64]
    measured: NDArray[np.float64]
    odometry: NDArray[np.float64]
    mode: NDArray[np.int8]
    is_moving: NDArray[np.bool_]
    emergency_stop: NDArray[np.bool_]
