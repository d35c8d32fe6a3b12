"""The record of a robot: everything that a tick reads or changes, and the numbers of its body that it goes by.

In lockstep a robot is a row of an array of records. Their size is fixed, so that the tick is compiled once for every
robot; values beyond the robot's own joints stay 0.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import group, record
from bhd_lerobot.control.messages import Mode, Reason
from bhd_lerobot.errors import ConfigError

JOINTS = 8
"""Most joints of a robot, and most values of a command."""
QUEUE = 256
"""Most commands that wait."""
LOOKS = 64
"""Most looks at the wheels' progress within a robot's latency."""
SHAPES = 64
"""Most capsules of an arm, of what stands around it, and of what it holds."""
PAIRS = 1024
"""Most pairs of these whose distance is checked."""
SAMPLES = 5
"""Times of a stop at which distances are checked."""
NEVER = np.iinfo(np.int64).max
"""Due time of no command [ns], and tick in which nothing arrives."""

_f, _i, _b, _vector = np.float64, np.int64, np.bool_, (np.float64, (JOINTS,))

STATE_FIELDS: dict[str, dict[str, tuple[Any, tuple[int, ...], str]]] = {
    "Readings, as far as they are measurements": {
        "position": (*_vector, "positions [rad], a gripper's opening [m]"),
        "velocity": (*_vector, "speeds [rad/s, m/s]"),
        "effort": (*_vector, "efforts [N m, N]"),
        "has_effort": (_b, (), "whether they are measured"),
        "stamp_ns": (_i, (), "when the hardware measured them, on the clock of the ticks' origin [ns]"),
        "safety": (np.int8, (), "`SafetyStatus`"),
    },
    "What readings are checked with": {  # see `reading_check`
        "near": (*_vector, "positions that joints can have got to [rad, m]"),
        "last": (*_vector, "the last positions that were measurements [rad, m]"),
        "read_ns": (_i, (), "stamp of the reading before [ns]"),
        "elapsed_ns": (_i, (), "time between the two [ns]"),
        "seen_position": (*_vector, "of torque motors, positions in the tick before [rad, m]"),
        "seen_velocity": (*_vector, "speeds in the tick before [rad/s, m/s]"),
        "seen_ns": (_i, (), "their stamp [ns]"),
        "same_ticks": (np.int64, (JOINTS,), "for how many ticks a position has been the same while motors are on"),
        "same_effort": (*_vector, "torque that was written when it changed last [N m]"),
        "off": (*_vector, "by how much positions and speeds have disagreed lately [rad]"),
        "way": (*_vector, "how far joints have turned meanwhile [rad]"),
        "problem": (_i, (), "what was wrong first with a reading; 0 if nothing was"),
        "problem_joint": (_i, (), "with which joint"),
        "problem_value": (_f, (), "by how much it changed [rad, m]"),
        "problem_ns": (_i, (), "in which time, or how far ahead the stamp is [ns]"),
        "silence_ns": (_i, (), "age of the last reading that was refused for its age [ns]; 0 if none was"),
        "is_distrusted": (_b, (), "positions of this tick are made up"),
    },
    "Modes": {
        "mode": (np.int8, (), "`Mode`"),
        "mode_is_new": (_b, (), "the plant has not been told it"),
        "is_configured": (_b, (), "it was, since it was put where it is"),
        "is_deactivating": (_b, (), "the stop that has begun ends in `SAFE_OFF`"),
        "by_goal": (_b, (), "it moves because of a goal, not because of setpoints"),
        "watchdog": (_i, (), "`Watchdog` flags raised since they were last taken"),
        "limits": (_i, (), "`Limit` flags raised since they were last taken"),
        "refusals": (np.int64, (len(Reason),), "how many commands were refused, by `Reason`"),
    },
    "Commands": {
        "requested": (*_vector, "the setpoint that was taken last, before all limits"),
        "setpoints_taken": (_i, (), "how many were"),
        "due_ns": (_i, (), "when it was due [ns]"),
        "taken_sequence": (_i, (), "its sequence number"),
        "next_due_ns": (_i, (), "when the next in the queue is due [ns]; `NEVER` if none waits"),
        "next_entry": (_i, (), "its place in the queue"),
        "seen_head": (_i, (), "the head of the queue when that was found"),
    },
    "To the controller, for its next run": {
        "entered": (_i, (), "modes that were entered, as bits"),
        "has_setpoint": (_b, (), "there is a new setpoint"),
        "goes_back": (_b, (), "its reference is to be again what is written"),
    },
    "From the controller": {
        "command": (*_vector, "what is applied, after all limits"),
        "actuators": (*_vector, "what it wants to write"),
        "busy": (_b, (), "see `Controller.busy`"),
        "follows_goal": (_b, (), "it follows one, and does not brake after one"),
        "is_at_rest": (_b, (), "of an arm in `STOPPING`, when the tick began"),
        "protective_stop": (_i, (), "`Watchdog` flag of a stop of its own that has just begun"),
    },
    "The guard": {
        "written": (*_vector, "what may be written"),
        "written_rate": (*_vector, "its last change, for each tick"),
    },
    "Wheels: twist, odometry, and how they turned since the last look": {
        "target": (_f, (2,), "twist that is headed for [m/s, rad/s]"),
        "before": (_f, (2,), "command of the tick before [m/s, rad/s]"),
        "rate": (_f, (2,), "its last change, for each tick"),
        "brakes_hard": (_b, (), "as far as a stop allows"),
        "encoder": (_f, (2,), "[counts]"),
        "odometry": (_f, (3,), "x, y [m], yaw [rad]"),
        "ticks": (_i, (), "so far"),
        "look_at": (np.int64, (3,), "tick of the next look, of the last one, and the reading's stamp then"),
        "looks": (np.int64, (3,), "that found the two wheels and the gyroscope wrong, in a row"),
        "asked": (_f, (2,), "[rad/s] times ticks that were commanded since the last look"),
        "turned": (_f, (), "[rad/s] times ticks that the gyroscope read since then"),
        "start": (_f, (2,), "[rad] of the wheels then"),
        "first": (_f, (2,), "[rad] when it was configured"),
        "stopped_for": (_i, (), "`Watchdog` flag of the last stop of its own"),
        "stood": (_b, (), "the wheels had not turned at all then"),
        "stopped_at": (_f, (4,), "[rad/s] of the wheels then, commanded and read"),
        "late": (_f, (2, LOOKS), "[rad/s] commanded between looks, the newest first"),
    },
    "Reports: nothing in a tick goes by them": {
        "measured": (*_vector, "where it is in the space of the commands"),
        "torque": (*_vector, "of the joints [N m], a gripper's force [N]: measured if possible, otherwise commanded"),
        "wrench": (_f, (6,), "that the surroundings put on the tool [N, N m]; 0 where it is not estimated"),
        "pressed": (_f, (), "force that forbids to activate it [N]"),
    },
}
"""Type, shape and meaning of the fields of a robot's record, by name, in groups."""
STATE = record("state", [(name, *field[:2]) for group in STATE_FIELDS.values() for name, field in group.items()])

WAITING = record(
    "queue",
    [
        # The sender alone moves the head and the tick alone the tail; an entry is complete before the head moves.
        ("head", _i),
        ("tail", _i),
        ("sequence", np.int64, (QUEUE,)),
        ("due_ns", np.int64, (QUEUE,)),
        ("waits", np.int8, (QUEUE,)),
        ("values", np.float64, (QUEUE, JOINTS)),
    ],
)

LIMITS = record(
    "limits",
    [
        ("joints", _i),
        ("width", _i),  # values of a command
        ("hz", _f),
        ("timeout_ns", _i),  # age of a setpoint at which the robot stops
        ("has_stamps", _b),
        ("has_sensors", _b),
        ("oldest_ns", _i),  # largest age of a reading
        ("ahead_ns", _i),  # by how much a stamp may be ahead of the tick
        ("origin_ns", _i),  # time 0 of the ticks, on the clock of the stamps
        # Of readings, for each nanosecond, for a period, and for the periods by which stamps may be off.
        ("fastest", *_vector),
        ("step", *_vector),
        ("slack", *_vector),
        ("is_torque", _b),  # the motors take torques, and readings are checked against each other
        ("period_s", _f),
        ("frozen_ticks", _i),
        ("least_torque", *_vector),
        # Of what is written: see `guard.WireLimits`.
        ("lower", *_vector),
        ("upper", *_vector),
        ("change", *_vector),
        ("bend", *_vector),
        # Of a drive: commands, for each tick; wheels; encoders; looks at the wheels' progress.
        ("is_drive", _b),
        ("arm_values", _i),  # of a command, before the drive's, and as many joints; 0 of a base alone
        ("takes_twist", _b),
        ("velocity", _f, (2,)),
        ("acceleration", _f, (2,)),
        ("stop", _f, (2,)),
        ("jerk", _f, (2,)),
        ("per_speed", _f),  # [rad/m] a wheel's speed for each forward speed
        ("per_yaw", _f),  # [rad/rad] and for each yaw rate
        ("most_wheel_speed", _f),
        ("half_radius", _f),  # [m/rad] forward speed of both wheels' speeds
        ("turn", _f),  # [rad/rad] yaw rate of the difference of their speeds
        ("largest_error", _f),  # [rad/s] of a wheel's speed with which its servo gives its largest torque
        ("servo_gain", _f),  # [N m s/rad]
        ("counts", _f),  # [1/rad] of the encoders
        ("per_count", _f),  # [m] forward for a count of each wheel
        ("yaw_per_count", _f),
        ("period_ticks", _i),
        ("late", _i),  # looks within the latency
        ("gyro", _i),  # the sensor that is the yaw rate of a gyroscope; -1 if there is none
    ],
)


_frames = (np.float64, (JOINTS + 1, 3, 4))

ARM = record(
    "arm",
    [
        ("stage", _i),  # `Stage` that its tick waits in for the controller; 0 between ticks
        ("at_tick", _i),  # how many ticks of goals went by
        # The reference, whose position is the command.
        ("speed", *_vector),  # [rad/s], of the gripper's opening [m/s]
        ("change", *_vector),  # [rad/s^2, m/s^2]
        ("before", *_vector),  # the servos' commands of the tick before
        # Setpoints: see `setpoints`.
        ("follows_setpoints", _b),
        ("has_left", _b),  # setpoints in this tick
        ("runs", _i),  # ticks in which setpoints were followed
        ("arrival", _i),  # the one in which the target arrives
        ("target", *_vector),
        ("goal", *_vector),
        ("step", *_vector),
        ("feed", *_vector),
        ("wanted", *_vector),  # speeds
        # Clearance: see `clearance`.
        ("geometry", _i),  # which record its shapes are
        ("share", _f),  # of the wanted speeds that is permitted
        ("due", _i),  # run of the next check
        ("known", *_vector),  # where `distances` were computed
        ("distances", _f, (PAIRS + SHAPES,)),  # [m] of pairs, then from the table; below 0: not known
        ("ways", _f, (SAMPLES, JOINTS)),
        ("lengths", _f, (SAMPLES,)),
        ("reached", *_vector),
        ("frames", *_frames),
        ("starts", _f, (SHAPES, 3)),
        ("along", _f, (SHAPES, 3)),
        # The trajectory that is played: rows of the player.
        ("row", _i),
        ("end", _i),
        # Goals: see `supervision`.
        ("is_judged", _b),
        ("brakes", _b),
        ("waits", _b),
        ("verdict", _i),
        ("aim", *_vector),  # where the goal's trajectory ends
        ("moves_arm", _b),
        ("moves_gripper", _b),
        ("age", _i),  # ticks since the goal began
        ("deadline", _i),
        ("since_end", _i),
        ("still", _i),  # ticks for which the gripper has stood still
        ("away", *_vector),  # [rad] from the reference
        ("most", *_vector),  # [rad] that are permitted
        # What the gripper holds: see `held`.
        ("held_ticks", _i),
        ("held_at", *_vector),  # [rad] where the arm was when that began
        # Latency and silence.
        ("late_s", _f),  # of the servos, beyond the body's
        ("latency_s", _f),  # of all
        ("read_ns", _i),
        ("silent_ticks", _i),
        # Stops of its own.
        ("is_stopped", _b),  # hard, since it was last reset
        ("yields", _b),
        ("gives_way", _b),
        ("follows", _b),  # a trajectory, with its reference
        ("rest_ticks", _i),  # for which a stopped arm's reference has followed nothing
        ("relief_ticks", _i),  # for which it has been settled
        ("is_blind", _b),  # it is not known where it is
        ("off_ticks", _i),  # for which a joint has been too far from its reference
        ("is_blocked", _b),
        ("is_driven", _b),  # its motors are on: before, and after SAFE_OFF, that is not known
        ("wrong", np.int64, (JOINTS,)),  # joints whose encoders were found wrong since the stop
        # How hard it presses: see `force_limit`.
        ("sum", *_vector),  # of efforts
        ("ticks", _i),  # in this period
        ("zeros", _i),  # of them without any effort
        ("lost_periods", _i),
        ("is_fresh", _b),
        ("felt_position", *_vector),
        ("felt_velocity", *_vector),
        ("torque", *_vector),
        ("force", _f),
        ("pressing", _f),
        ("pull", _f),
        ("hung", _i),
        ("presses", _b),  # more than it may
        ("is_measured", _b),
        ("is_lost", _b),
        # Room for dynamics.
        ("turns", _f, (JOINTS, 3, 3)),
        ("spin", _f, (JOINTS, 3)),
        ("forces", _f, (JOINTS, 3)),
        ("moments", _f, (JOINTS, 3)),
        ("needs", *_vector),
        ("room", _f, (3, JOINTS)),
        ("jacobian", _f, (6, JOINTS)),
        ("square", _f, (6, 6)),
        ("side", _f, (6,)),
    ],
)

ARM_LIMITS = record(
    "arm_limits",
    [
        ("dof", _i),
        ("width", _i),
        ("hz", _f),
        ("lower", *_vector),
        ("upper", *_vector),
        # Setpoints.
        ("frame_ticks", _i),
        ("near_lower", *_vector),
        ("near_upper", *_vector),
        ("fastest", *_vector),
        ("hardest", *_vector),
        ("ramp", *_vector),
        ("jerk", *_vector),
        ("is_gradual", _b),
        ("gain", _f),
        # Clearance.
        ("keeps_clear", _b),
        ("look_ticks", _i),
        ("look_s", _f),
        ("ramp_s", *_vector),
        ("least", _f),
        # Servos.
        ("lead", *_vector),
        ("largest_error", *_vector),
        ("stiffness", *_vector),
        ("damping", *_vector),
        ("effort", *_vector),
        # Goals and what is in their way.
        ("blocked_rad", _f),
        ("arrived_rad", _f),
        ("latency_s", _f),
        ("acceleration", *_vector),
        ("blocked_ticks", _i),
        ("settled_ticks", _i),
        ("relief_period", _i),
        ("settling_ticks", _i),
        ("gripping_ticks", _i),
        ("stall_ticks", _i),
        ("holds", _b),  # what the gripper holds is found out
        # Forces.
        ("feels", _b),
        ("has_wrench", _b),
        ("most_force", _f),
        ("felt_ticks", _i),
        ("felt_hz", _f),
        ("most_lost", _i),
        ("most_hung", _i),
        ("certain", *_vector),
        # Impedance: see `spring`.
        ("most_reach", _f),  # [m] of the tool's position, in each direction
        ("most_speed", *_vector),  # [rad/s] beyond these the arm is stopped
        ("most_tool_speed", _f, (2,)),  # [m/s, rad/s]
        ("most_torque", *_vector),  # [N m] of the surroundings
        ("most_swings", _f),
        # Rigid bodies: placement and axis of each joint, inertia of each link about its centre of mass, tool frame.
        ("turn", _f, (JOINTS, 3, 3)),
        ("offset", _f, (JOINTS, 3)),
        ("axis", _f, (JOINTS, 3)),
        ("mass", *_vector),
        ("centre", _f, (JOINTS, 3)),
        ("inertia", _f, (JOINTS, 3, 3)),
        ("rotor", *_vector),
        ("tool_turn", _f, (3, 3)),
        ("tool_offset", _f, (3,)),
    ],
)

SPRING = record(
    "spring",
    [
        # The equilibrium: see `equilibrium`. Orientations are quaternions w, x, y, z.
        ("place", _f, (3,)),  # [m]
        ("turn", _f, (4,)),
        ("opening", _f),  # [m]
        ("speed", _f, (6,)),  # [m/s, rad/s]
        ("opening_speed", _f),
        ("is_active", _b),  # a setpoint is followed
        ("left", _i),  # ticks until the target is at the setpoint
        ("target", _f, (3,)),
        ("target_turn", _f, (4,)),
        ("target_opening", _f),
        ("goal", _f, (3,)),
        ("goal_turn", _f, (4,)),
        ("goal_opening", _f),
        ("feed", _f, (6,)),
        ("opening_feed", _f),
        # What a brain has set: see `Compliance`.
        ("stiffness", _f, (6, 6)),
        ("wanted_stiffness", _f, (6, 6)),
        ("ratio", _f),
        ("is_fixed", _b),  # the damping is
        ("fixed_damping", _f, (6, 6)),
        ("largest", _f, (2,)),  # [N, N m]
        ("wrench", _f, (6,)),  # fed forward [N, N m]
        ("wanted_wrench", _f, (6,)),
        # Stops.
        ("is_braked", _b),  # in a mode without motion
        ("is_still", _b),
        ("is_refused", _b),  # the setpoint that was taken last: it was no pose
        ("position", *_vector),  # [rad] that was read last
        ("carried", *_vector),  # [rad] the posture whose weight is carried while it is braked
        ("swung", _f, (JOINTS + 6,)),  # last directions of joints and equilibrium
        ("swings", *_vector),  # how often the joints' turned
        # What the surroundings put on it: see `wrench`.
        ("torque", *_vector),  # [N m]
        ("expected", *_vector),
        ("rate", *_vector),
        ("is_fresh", _b),
        # Dynamics: see `rigid_bodies`.
        ("rotations", _f, (JOINTS, 3, 3)),
        ("origins", _f, (JOINTS, 3)),
        ("axes", _f, (JOINTS, 3)),
        ("levers", _f, (JOINTS, 3)),
        ("rates", _f, (JOINTS, 6)),
        ("masses", *_vector),
        ("firsts", _f, (JOINTS, 3)),
        ("inertias", _f, (JOINTS, 3, 3)),
        ("momenta", _f, (JOINTS, 6)),
        ("pulls", _f, (JOINTS, 6)),
        ("mass", _f, (JOINTS, JOINTS)),
        ("momentum", *_vector),
        ("gradient", *_vector),
        ("gravity", *_vector),
        ("own", *_vector),
        ("jacobian", _f, (6, JOINTS)),
        ("tool", _f, (3,)),
        ("tool_turn", _f, (4,)),
        ("mobility", _f, (6, 6)),
        # Room.
        ("turns", _f, (JOINTS, 3, 3)),
        ("spin", _f, (JOINTS, 3)),
        ("forces", _f, (JOINTS, 3)),
        ("moments", _f, (JOINTS, 3)),
        ("needs", *_vector),
        ("near", *_vector),
        ("still", *_vector),
        ("wanted", *_vector),
        ("tool_speed", _f, (6,)),
        ("error", _f, (6,)),
        ("push", _f, (6,)),
        ("lead", _f, (6,)),
        ("tethers", _f, (2,)),
        ("columns", _f, (JOINTS, 6)),
        ("root", _f, (6, 6)),
        ("square", _f, (6, 6)),
        ("modes", _f, (6, 6)),
        ("damping", _f, (6, 6)),
        ("side", _f, (6,)),
    ],
)

GEOMETRY = record(
    "geometry",
    [
        ("dof", _i),
        ("base", _f, (1, 3, 4)),  # the frame that the first joint turns in
        ("link", _f, (JOINTS, 3, 4)),  # the next frame in the one that turns with each joint
        ("tool", _f, (3, 4)),  # in the last frame
        ("shapes", _i),
        ("pairs", _i),
        ("frame", np.int64, (SHAPES,)),
        ("start", _f, (SHAPES, 3)),
        ("way", _f, (SHAPES, 3)),
        ("long", _f, (SHAPES,)),  # squared length [m^2]
        ("below_start", _f, (SHAPES,)),
        ("below_end", _f, (SHAPES,)),
        ("first", np.int64, (PAIRS,)),
        ("second", np.int64, (PAIRS,)),
        ("radii", _f, (PAIRS,)),
        ("slopes", _f, (PAIRS + SHAPES, JOINTS)),
        ("reach", *_vector),
    ],
)


@group
class RobotRecords(NamedTuple):
    """What ticks of n robots need, whatever parts they have.

    Attributes:
        states: their records, shape (n,).
        queues: their commands, shape (n,).
        estop: the words of their emergency stops, shape (3, n), see `EstopWord`.
        limits: the numbers of their body, shape (1,).
        sensors: further values that their plant measures, shape (n, sensors).
        sensors_ns: when the oldest of each robot's was measured [ns], shape (n,).
    """

    states: Any
    queues: Any
    estop: NDArray[np.int64]
    limits: Any
    sensors: NDArray[np.float64]
    sensors_ns: NDArray[np.int64]


@group
class ArmRecords(NamedTuple):
    """What ticks need of arms with position servos.

    Attributes:
        records: shape (n,).
        limits: the numbers of their body, shape (1,).
        geometries: what they are kept clear with, see `bhd_lerobot.control.arm.clearance`.
        rows: the trajectories that they play, shape (T, 3, width).
    """

    records: Any
    limits: Any
    geometries: Any
    rows: NDArray[np.float64]


@group
class SpringRecords(NamedTuple):
    """What ticks need of arms with torque motors.

    Attributes:
        records: those of their impedances, shape (n,).
        limits: the numbers of their body, shape (1,).
    """

    records: Any
    limits: Any


def new_states(n: int) -> NDArray:
    """Return the records of n robots that are not configured, shape (n,)."""
    states = np.zeros(n, STATE)
    states["near"] = states["seen_position"] = np.nan
    states["taken_sequence"] = states["seen_head"] = -1
    states["next_due_ns"], states["mode_is_new"] = NEVER, True
    return states


def new_arms(n: int) -> NDArray[Any]:
    """Return the records of n arms that have done nothing yet, shape (n,)."""
    arms = np.zeros(n, ARM)
    arms["arrival"], arms["share"], arms["distances"], arms["is_fresh"] = NEVER, 1.0, -1.0, True
    return arms


def new_springs(n: int) -> NDArray[Any]:
    """Return the records of the impedances of n arms that have done nothing yet, shape (n,)."""
    springs = np.zeros(n, SPRING)
    springs["turn"][:, 0] = springs["is_braked"] = springs["is_still"] = springs["is_fresh"] = True
    return springs


def command_age_ns(states: Any, now_ns: Any) -> Any:
    """Return how long ago the commands in force were due [ns]; 0 for a robot that follows none."""
    by_setpoint = (states["mode"] == Mode.TRACKING) & ~states["by_goal"]
    return np.where(by_setpoint, now_ns - states["due_ns"], 0)


def put(row: Any, field: str, values: Any) -> None:
    """Write values into the first places of a field of a record, or of an array of records.

    Raises:
        ConfigError: there are more of them than a record holds.
    """
    values = np.asarray(values)
    room = row[field].shape[-1]
    if values.shape[-1] > room:
        raise ConfigError(f"The robot has {values.shape[-1]} values of {field}; a record holds {room}.")
    row[field][..., : values.shape[-1]] = values
