"""UR5 with a parallel gripper, with the source of every number.

Sources:

[dh]       Universal Robots, "DH parameters for calculations of kinematics and dynamics" (UR5): link lengths, offsets
           and twists, link masses and centres of mass in the Denavit-Hartenberg frames.
[manual]   Universal Robots, UR5 technical specification: 180 deg/s on every joint, 360 deg to either side, 5 kg
           payload, 850 mm reach.
[torque]   Universal Robots, "Max. joint torques" (UR5): 150 N m on the first three joints, 28 N m on the wrists.
[gripper]  A generic parallel gripper with the figures of Robotiq's 2F-85 data sheet: 85 mm opening, 20 to 150 mm/s,
           20 to 235 N, about 0.9 kg.

Estimates of ours: link inertias, from solid cylinders of the links' outlines, because the wrist inertias that circulate
are an order of magnitude too large for 1.2 kg; the gripper's inertia, from a cylinder and two bars; the capsules of the
collision checks, from the arm's outlines; the reflected rotor inertias: 0.5 kg m^2 on the first three joints, 0.15 on
the wrists, 0.3 kg on each finger; the servos' gains, with which 1 kg in the gripper at full reach lowers the tool by
0.4 mm, and a joint is where a small step commands it after 60 ms, with 4 % overshoot at the most; the brakes of an arm
with torque motors; accelerations and
jerks, which Universal Robots does not publish: with the payload at full reach they need less than the joints' torque
limits.
"""

import math
from collections.abc import Sequence
from importlib import resources
from typing import Literal

from bhd_lerobot.bodies.body import Arm, ArmChain, Body, CameraSpec, Capsule, GripperSpec, Handling, Limits, Workspace
from bhd_lerobot.errors import ConfigError, unknown_name

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
MAX_OPENING = 0.085  # [m], [gripper]
MAX_JOINT_SPEED = math.pi  # [rad/s], [manual]

_A = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)  # [m], [dh]
_D = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)  # [m], [dh]
_ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)  # [rad], [dh]

# Outlines. The tubes of upper arm and forearm lie beside the planes that the chain's frames lie in.
_CAPSULES = (
    Capsule("base", 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.089), 0.075),
    Capsule("shoulder", 1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.136), 0.065),
    Capsule("upper_arm", 2, (0.425, 0.0, 0.136), (0.0, 0.0, 0.136), 0.060),
    Capsule("elbow", 2, (0.0, 0.0, 0.0165), (0.0, 0.0, 0.136), 0.055),
    Capsule("forearm", 3, (0.39225, 0.0, 0.0165), (0.0, 0.0, 0.0165), 0.050),
    Capsule("wrist_1", 3, (0.0, 0.0, 0.0165), (0.0, 0.0, 0.10915), 0.045),
    Capsule("wrist_2", 4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.09465), 0.045),
    Capsule("wrist_3", 5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0823), 0.040),
    Capsule("palm", 6, (0.0, 0.0, 0.0), (0.0, 0.0, 0.040), 0.045),
    Capsule("hand", 6, (0.0, -0.045, 0.050), (0.0, 0.045, 0.050), 0.030),
    Capsule("finger_left", 6, (0.0, -0.050, 0.070), (0.0, -0.050, 0.152), 0.012),
    Capsule("finger_right", 6, (0.0, 0.050, 0.070), (0.0, 0.050, 0.152), 0.012),
)
_TOOLING = ("palm", "hand", "finger_left", "finger_right")
_DISJOINT = (
    *(("base", other) for other in ("forearm", "wrist_1", "wrist_2", "wrist_3", *_TOOLING)),
    *(("shoulder", other) for other in ("forearm", "wrist_1", "wrist_2", "wrist_3", *_TOOLING)),
    *(("upper_arm", other) for other in ("wrist_1", "wrist_2", "wrist_3", *_TOOLING)),
    *(("elbow", other) for other in ("wrist_2", "wrist_3", *_TOOLING)),
    *(("forearm", other) for other in ("wrist_3", *_TOOLING)),
    *(("wrist_1", other) for other in ("hand", "finger_left", "finger_right")),
)
_MOVING = ("upper_arm", "elbow", "forearm", "wrist_1", "wrist_2", "wrist_3", *_TOOLING)

# [rad] The fingers stand one behind the other at home: see `Handling.neutral`.
NEUTRAL = math.pi - math.atan2(0.10915, 0.48690)
_PAYLOAD = 5.0  # [kg]
_BRAKING_SPEED = 0.35  # [rad/s] the speed at which a brake gives a joint's largest torque
_SLIP = 0.1  # share of a joint's largest torque with which its brake slips


def ur5(
    *,
    actuation: Literal["position", "torque"] = "position",
    load: float = 0.0,
    obstacles: Sequence[Capsule] = (),
    command_timeout_s: float = 0.14,
    camera_width: int = 320,
    camera_height: int = 240,
) -> Body:
    """Return the UR5 with its gripper.

    Args:
        actuation: ``"position"`` for position servos, ``"torque"`` for joint torques.
        load: mass that the gripper is declared to carry [kg].
        obstacles: what else is known to stand on the table, or to hang above it: capsules of frame 0.
        command_timeout_s: age at which a setpoint is no longer trusted [s].
        camera_width: width of the cameras' images [px].
        camera_height: height of the cameras' images [px].

    Raises:
        ConfigError: a value is out of range.
    """
    if actuation not in ("position", "torque"):
        raise ConfigError(unknown_name("actuation", actuation, ("position", "torque")))
    if not 0.0 <= load <= _PAYLOAD:
        raise ConfigError(f"The load (robot.payload) is {load} kg; a UR5 carries between 0 and {_PAYLOAD:g} kg.")
    turn = 2 * math.pi
    effort = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)  # [N m], [torque]
    torque = actuation == "torque"
    return Body(
        name="ur5",
        mjcf=resources.files(__package__).joinpath("ur5.xml").read_text(encoding="utf-8"),
        root="base",
        arm=Arm(
            limits=Limits(
                names=(*(f"{joint}.pos" for joint in JOINTS), "gripper.pos"),
                lower=(*(-turn,) * 6, 0.0),
                upper=(*(turn,) * 6, MAX_OPENING),
                velocity=(*(MAX_JOINT_SPEED,) * 6, 0.150),
                acceleration=(8.0, 8.0, 10.0, 15.0, 15.0, 15.0, 2.0),
                jerk=(80.0, 80.0, 100.0, 150.0, 150.0, 150.0, 40.0),
                stop_deceleration=(12.0, 12.0, 15.0, 20.0, 20.0, 20.0, 4.0),
                stop_jerk=(400.0, 400.0, 500.0, 700.0, 700.0, 700.0, 200.0),
                effort=(*effort, 60.0),
                command_timeout_s=command_timeout_s,
            ),
            chain=ArmChain.from_dh(
                joints=JOINTS,
                a=_A,
                d=_D,
                alpha=_ALPHA,
                tool=(0.0, 0.0, 0.150),
                capsules=(*_CAPSULES, *obstacles),
                disjoint=(*_DISJOINT, *((obstacle.name, link) for obstacle in obstacles for link in _MOVING)),
                min_distance=0.005,
                min_manipulability=0.003,
            ),
            gripper=GripperSpec(
                joints=("finger_left", "finger_right"),
                actuator="gripper",
                body="gripper",
                tendon="opening",
                pads=("pad_left", "pad_right"),
                max_opening=MAX_OPENING,
                widest=0.076,
            ),
            servo_stiffness=(40_000.0, 40_000.0, 40_000.0, 8_000.0, 8_000.0, 8_000.0, 8_000.0),
            servo_damping=(800.0, 800.0, 450.0, 80.0, 80.0, 80.0, 150.0),
            actuators=(*JOINTS, "gripper"),
            actuation=actuation,
            brake_damping=tuple(most / _BRAKING_SPEED for most in effort) if torque else (),
            brake_slip=tuple(_SLIP * most for most in effort) if torque else (),
            # The tool points down, 0.49 m before the base and 0.11 m to its left, 0.28 m above the table.
            home=(math.pi, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0, MAX_OPENING),
            workspace=Workspace(
                tool=((0.20, -0.45, 0.10), (0.70, 0.45, 0.60)),
                # Elbow up and the tool somewhere before the arm: a random posture is nearly always behind it.
                around_home=(1.0, 0.9, 0.9, 1.2, 1.2, math.pi),
                table=((0.35, -0.30), (0.65, 0.30)),
                reach=0.80,
                handling=Handling(neutral=NEUTRAL),
            ),
            payload=_PAYLOAD,
            load=load,
        ),
        cameras={name: CameraSpec(name, camera_width, camera_height) for name in ("scene", "wrist")},
        physics_hz=500,
        control_hz=500,
        # A servo at its largest effort, which the implicit integrator does not damp, turns a joint to and fro for ever
        # in steps longer than 4 inertia / damping. Of wrist 3: 80 / (4 * 0.15).
        least_physics_hz=134,
        # At less, a joint at full speed is farther from its reference than `blocked_rad` for a tick; by torques, the
        # observer of the contact is faster than a tick.
        least_control_hz=25 if actuation == "position" else 50,
    )
