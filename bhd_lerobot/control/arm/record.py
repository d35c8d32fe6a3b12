"""The records of an arm: what a tick of it reads or changes, the numbers that it goes by, and its geometry."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import record
from bhd_lerobot.control.record import JOINTS

SHAPES = 64
"""Most capsules of an arm, of what stands around it, and of what it holds."""
PAIRS = 512
"""Most pairs of these whose distance is checked."""
SAMPLES = 5
"""Times of a stop at which distances are checked."""
NEVER = np.iinfo(np.int64).max
"""Tick in which nothing arrives."""

_f, _i, _b, _vector = np.float64, np.int64, np.bool_, (np.float64, (JOINTS,))
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
        ("rest_ticks", _i),  # for which a stopped arm's reference has followed nothing
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
        ("wrench", _f, (6,)),
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
        # Goals and what is in their way.
        ("blocked_rad", _f),
        ("latency_s", _f),
        ("acceleration", *_vector),
        ("blocked_ticks", _i),
        ("settled_ticks", _i),
        ("settling_ticks", _i),
        ("gripping_ticks", _i),
        ("stall_ticks", _i),
        ("holds", _b),  # what the gripper holds is found out
        # Forces.
        ("feels", _b),
        ("has_wrench", _b),
        ("has_effort", _b),
        ("most_force", _f),
        ("felt_ticks", _i),
        ("felt_hz", _f),
        ("most_lost", _i),
        ("most_hung", _i),
        ("certain", *_vector),
        # Rigid bodies: placement and axis of each joint, inertia of each link about its centre of mass.
        ("turn", _f, (JOINTS, 3, 3)),
        ("offset", _f, (JOINTS, 3)),
        ("axis", _f, (JOINTS, 3)),
        ("mass", *_vector),
        ("centre", _f, (JOINTS, 3)),
        ("inertia", _f, (JOINTS, 3, 3)),
        ("rotor", *_vector),
    ],
)

GEOMETRY = record(
    "geometry",
    [
        ("dof", _i),
        ("a", *_vector),
        ("d", *_vector),
        ("cos_alpha", *_vector),
        ("sin_alpha", *_vector),
        ("tool", _f, (3,)),
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


def new_arms(n: int) -> NDArray[Any]:
    """Return the records of n arms that have done nothing yet, shape (n,)."""
    arms = np.zeros(n, ARM)
    arms["arrival"], arms["share"], arms["distances"], arms["is_fresh"] = NEVER, 1.0, -1.0, True
    return arms
