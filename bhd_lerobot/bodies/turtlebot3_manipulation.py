"""TurtleBot3 Waffle Pi with an OpenMANIPULATOR-X, with the source of every number.

Sources:

[manual]   ROBOTIS e-Manual, TurtleBot3, "Features: specifications", Waffle Pi: 0.26 m/s, 1.82 rad/s, 1.8 kg.
[omx]      ROBOTIS e-Manual, OpenMANIPULATOR-X: reach 0.38 m, gripper's stroke 20 to 75 mm.
[urdf]     ROBOTIS `turtlebot3_manipulation_description`: where wheels, casters, scanner, camera and the arm's joints
           are, the joints' ranges, boxes of the outlines, masses, centres of mass and inertias of the links. As of the
           Burger, see turtlebot3.py, the base's centre of mass and the scanner's inertia are ours; the base is made
           heavier, and its inertia in the same ratio, until the robot without the arm has the published mass.
[nav]      ROBOTIS `turtlebot3_navigation2`, `waffle_pi.yaml`: 3.2 rad/s^2.
[servo]    ROBOTIS e-Manual, XM430-W350, of the arm: 4.1 N m of stall torque at 12 V; XM430-W210, of the wheels: 2.7 N m
           at 11.1 V; 4096 pulses per revolution.

Estimates of ours: the stiffness of the arm's servos, whose position loop has an integral part: 80 N m/rad, where the
proportional part alone has 19; their damping, their largest speed, which is a third of that without a load, and the
reflected rotor inertias; friction; thickness and height of the fingers, which meet when the gripper is closed and open
by as much as the published strokes differ; the gripper's force; other accelerations and jerks, with which the base
neither rocks nor tips, on wheels that have no caster before them; the payload: 0.25 kg at full reach ahead tip it over;
and what is an estimate in turtlebot3.py.
"""

import math
from collections.abc import Sequence
from importlib import resources

from bhd_lerobot.bodies.body import (
    Arm,
    ArmChain,
    Body,
    CameraSpec,
    Capsule,
    Drive,
    GripperSpec,
    Handling,
    Inertia,
    LidarSpec,
    Limits,
    Placement,
    Workspace,
)
from bhd_lerobot.bodies.turtlebot3 import LIDAR_BEAMS, RANGE_MAX, RANGE_MIN, WHEEL_RADIUS
from bhd_lerobot.errors import ConfigError

JOINTS = ("joint1", "joint2", "joint3", "joint4")
MAX_OPENING = 0.055  # [m], [omx]
MAX_LINEAR, MAX_ANGULAR = 0.26, 1.82  # [m/s], [rad/s], [manual]
WHEEL_SEPARATION = 0.288  # [m], [urdf]
PAYLOAD = 0.15  # [kg]

_SHOULDER, _UPPER_ARM, _FOREARM, _HAND = 0.0595, (0.024, 0.128), 0.124, 0.126  # [m], [urdf]
_MOUNT = (-0.080, 0.0, 0.118)  # [m] where joint 1 is, [urdf]
# The frames behind joints 2 to 4 have their z axes along the joints', which is the base's y axis when joint 1 is at 0;
# their x axes point ahead when all joints are at 0, and so their y axes down.
_TURNED = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
_TOOL = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))

# What stands still: deck, front, rear and sides of the hull, wheels, camera, scanner, and the foot of the arm.
_FIXED = tuple(
    Capsule(name, 0, start, end, radius)
    for name, start, end, radius in (
        ("deck_0", (-0.177, -0.113, 0.092), (-0.177, 0.113, 0.092), 0.023),
        ("deck_1", (-0.139, -0.113, 0.092), (-0.139, 0.113, 0.092), 0.023),
        ("deck_2", (-0.102, -0.113, 0.092), (-0.102, 0.113, 0.092), 0.023),
        ("deck_3", (-0.064, -0.113, 0.092), (-0.064, 0.113, 0.092), 0.023),
        ("deck_4", (-0.026, -0.113, 0.092), (-0.026, 0.113, 0.092), 0.023),
        ("deck_5", (0.011, -0.113, 0.092), (0.011, 0.113, 0.092), 0.023),
        ("deck_6", (0.049, -0.113, 0.092), (0.049, 0.113, 0.092), 0.023),
        ("front_high", (0.049, -0.113, 0.061), (0.049, 0.113, 0.061), 0.023),
        ("front_low", (0.049, -0.113, 0.030), (0.049, 0.113, 0.030), 0.023),
        ("rear_high", (-0.177, -0.113, 0.061), (-0.177, 0.113, 0.061), 0.023),
        ("rear_low", (-0.177, -0.113, 0.030), (-0.177, 0.113, 0.030), 0.023),
        ("left_high", (-0.177, 0.113, 0.061), (0.049, 0.113, 0.061), 0.023),
        ("left_low", (-0.177, 0.113, 0.030), (0.049, 0.113, 0.030), 0.023),
        ("right_high", (-0.177, -0.113, 0.061), (0.049, -0.113, 0.061), 0.023),
        ("right_low", (-0.177, -0.113, 0.030), (0.049, -0.113, 0.030), 0.023),
        ("wheel_left", (0.0, 0.144, 0.033), (0.0, 0.144, 0.033), 0.035),
        ("wheel_right", (0.0, -0.144, 0.033), (0.0, -0.144, 0.033), 0.035),
        ("eye", (0.074, -0.006, 0.107), (0.074, 0.006, 0.107), 0.018),
        ("lds_0", (-0.025, -0.035, 0.1255), (0.007, -0.035, 0.1255), 0.023),
        ("lds_1", (-0.044, 0.0, 0.1255), (0.026, 0.0, 0.1255), 0.023),
        ("lds_2", (-0.025, 0.035, 0.1255), (0.007, 0.035, 0.1255), 0.023),
        ("foot", (-0.104, 0.0, 0.117), (-0.080, 0.0, 0.117), 0.024),
    )
)
_LINKS = (
    Capsule("shoulder", 1, (0.0, 0.0235, 0.0), (0.0, 0.0, 0.0), 0.024),
    Capsule("upper_arm", 2, (-0.024, 0.116, 0.0), (-0.024, -0.005, 0.0), 0.022),
    Capsule("elbow", 2, (-0.024, 0.0, 0.0), (0.0, 0.0, 0.0), 0.022),
    Capsule("forearm", 3, (-0.112, 0.0, 0.0), (-0.005, 0.0, 0.0), 0.021),
    Capsule("wrist", 4, (0.0, 0.0, 0.0), (0.030, 0.0, 0.0), 0.022),
    Capsule("palm", 4, (0.0555, -0.007, -0.035), (0.0555, -0.007, 0.035), 0.040),
    Capsule("fingers", 4, (0.1117, 0.0, 0.0), (0.1600, 0.0, 0.0), 0.0147),
    Capsule("finger_left", 4, (0.1117, 0.0, 0.0335), (0.1600, 0.0, 0.0335), 0.0147),
    Capsule("finger_right", 4, (0.1117, 0.0, -0.0335), (0.1600, 0.0, -0.0335), 0.0147),
)
_TOOLING = ("palm", "fingers", "finger_left", "finger_right")
_DISJOINT = (
    *((fixed.name, link) for fixed in _FIXED for link in ("forearm", "wrist", *_TOOLING)),
    *((fixed.name, "elbow") for fixed in _FIXED if fixed.name.startswith(("deck", "lds"))),
    *((fixed.name, "upper_arm") for fixed in _FIXED if fixed.name.startswith("lds")),
    *((near, link) for near in ("shoulder", "upper_arm") for link in ("wrist", *_TOOLING)),
    ("shoulder", "forearm"),
)
_MOVING = ("upper_arm", "elbow", "forearm", "wrist", *_TOOLING)


def turtlebot3_manipulation(
    *,
    load: float = 0.0,
    obstacles: Sequence[Capsule] = (),
    lidar_noise_std: float = 0.01,
    command_timeout_s: float = 0.14,
    camera_width: int = 320,
    camera_height: int = 240,
) -> Body:
    """Return the Waffle Pi with its arm; the arm's base frame is the robot's, on the floor between the wheels.

    Args:
        load: mass that the gripper is declared to carry [kg].
        obstacles: what else is mounted on the base: capsules of frame 0.
        lidar_noise_std: standard deviation of the range noise [m]; 0 turns it off.
        command_timeout_s: age at which a command is no longer trusted [s].
        camera_width: width of the front camera's image [px].
        camera_height: height of the front camera's image [px].

    Raises:
        ConfigError: a value is out of range.
    """
    if not 0.0 <= load <= PAYLOAD:
        raise ConfigError(
            f"The load (robot.payload) is {load} kg; a TurtleBot3 with an OpenMANIPULATOR-X carries between 0 and "
            f"{PAYLOAD:g} kg."
        )
    return Body(
        name="turtlebot3_manipulation",
        mjcf=resources.files(__package__).joinpath("turtlebot3_manipulation.xml").read_text(encoding="utf-8"),
        root="base",
        drive=Drive(
            limits=Limits(
                names=("x.vel", "theta.vel"),
                velocity=(MAX_LINEAR, MAX_ANGULAR),
                acceleration=(1.0, 3.2),
                stop_deceleration=(1.0, 6.0),
                command_timeout_s=command_timeout_s,
            ),
            joints=("wheel_left", "wheel_right"),
            actuators=("wheel_left", "wheel_right"),
            wheel_radius=WHEEL_RADIUS,
            wheel_separation=WHEEL_SEPARATION,
            max_wheel_speed=MAX_ANGULAR * WHEEL_SEPARATION / 2 / WHEEL_RADIUS,
            max_torque=2.7,
            servo_gain=0.15,
            encoder_ticks=4096,
            radius=0.238,  # the rear corners of the hull
            height=0.45,
            # The hull; camera and, at home, the open fingers; and the wheels.
            outline=((-0.197, 0.069, 0.133), (0.069, 0.0865, 0.042), (-0.033, 0.033, 0.153)),
        ),
        arm=Arm(
            limits=Limits(
                names=(*(f"{joint}.pos" for joint in JOINTS), "gripper.pos"),
                lower=(-0.9 * math.pi, -0.57 * math.pi, -0.3 * math.pi, -0.57 * math.pi, 0.0),
                upper=(0.9 * math.pi, 0.5 * math.pi, 0.44 * math.pi, 0.65 * math.pi, MAX_OPENING),
                velocity=(1.5, 1.5, 1.5, 1.5, 0.10),
                acceleration=(3.0, 3.0, 3.0, 4.0, 1.0),
                jerk=(30.0, 30.0, 30.0, 40.0, 20.0),
                stop_deceleration=(5.0, 5.0, 5.0, 6.0, 2.0),
                stop_jerk=(150.0, 150.0, 150.0, 200.0, 100.0),
                effort=(4.1, 4.1, 4.1, 4.1, 20.0),
                command_timeout_s=command_timeout_s,
            ),
            chain=ArmChain(
                joints=JOINTS,
                base=Placement(_MOUNT),
                links=(
                    Placement((0.0, 0.0, _SHOULDER), _TURNED),
                    Placement((_UPPER_ARM[0], -_UPPER_ARM[1], 0.0)),
                    Placement((_FOREARM, 0.0, 0.0)),
                    Placement(),
                ),
                tool=Placement((_HAND, 0.0, 0.0), _TOOL),
                capsules=(*_FIXED, *_LINKS, *obstacles),
                disjoint=(*_DISJOINT, *((obstacle.name, link) for obstacle in obstacles for link in _MOVING)),
                min_distance=0.005,
                min_manipulability=1e-5,
            ),
            gripper=GripperSpec(
                joints=("gripper_left", "gripper_right"),
                actuator="gripper",
                body="link5",
                tendon="opening",
                pads=("pad_left", "pad_right"),
                max_opening=MAX_OPENING,
                widest=0.045,
            ),
            servo_stiffness=(80.0, 80.0, 80.0, 80.0, 2000.0),
            servo_damping=(3.0, 3.0, 2.4, 1.6, 40.0),
            actuators=(*JOINTS, "gripper"),
            actuation="position",
            # The tool points ahead, over the scanner, and all of the arm is over the base.
            home=(0.0, -0.79, -0.19, 0.98, MAX_OPENING),
            workspace=Workspace(
                tool=((0.10, -0.15, 0.05), (0.26, 0.15, 0.35)),
                around_home=(0.8, 1.0, 0.9, 1.2),
                table=((0.20, -0.06), (0.25, 0.06)),
                reach=0.30,
                handling=Handling(
                    scale=0.5,
                    finger=0.012,
                    palm=0.030,
                    lowest=0.047,
                    travel=0.15,
                    highest=0.12,
                    lift=0.06,
                    neutral=-math.pi / 2,
                    hand_over=(0.25, 0.0, 0.30),
                ),
            ),
            payload=PAYLOAD,
            load=load,
            inertias=(
                _inertia(0.0984, (0.0, 0.0005, 0.0474), (3.45e-5, 3.27e-5, 1.89e-5)),
                _inertia(0.1385, (0.0103, -0.1017, 0.0004), (3.306e-4, 6.03e-5, 3.429e-4)),
                _inertia(0.1327, (0.0909, -0.0002, 0.0004), (3.07e-5, 2.516e-4, 2.423e-4)),
                # With the fingers, as at home.
                _inertia(0.1633, (0.0552, -0.0078, 0.0), (1.0e-4, 2.34e-4, 2.18e-4)),
            ),
            arrived_rad=0.03,
        ),
        lidar=LidarSpec(
            site="lidar",
            beams=LIDAR_BEAMS,
            range_min=RANGE_MIN,
            range_max=RANGE_MAX,
            rate_hz=5,
            noise_std=lidar_noise_std,
            ahead=-0.024,
        ),
        cameras={"front": CameraSpec("front", camera_width, camera_height)},
        physics_hz=500,
        control_hz=500,
        least_physics_hz=250,
        least_control_hz=50,
    )


def _inertia(mass: float, centre: tuple[float, float, float], about: tuple[float, float, float]) -> Inertia:
    """Return what moves with a joint, with its rotor; its principal axes are those of the joint's frame."""
    a, b, c = about
    return Inertia(mass, centre, ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c)), 0.01)
