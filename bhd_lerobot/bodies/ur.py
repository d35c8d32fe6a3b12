"""Arms of Universal Robots with a parallel gripper: the UR5, and the UR3e, UR5e and UR10e of the e-Series.

One description, `ur.xml`, with the numbers of each arm. Sources:

[dh]       Universal Robots, "DH parameters for calculations of kinematics and dynamics": link lengths, offsets and
           twists, link masses and centres of mass in the Denavit-Hartenberg frames.
[manual]   Universal Robots, technical specifications: speeds, 360 deg to either side, payload, diameter of the foot.
           The last joint of a UR3e turns without an end; here it ends like the others. A UR10e is rated for
           10 kg, and 12.5 kg with less acceleration; with this gripper its elbow has torque for 8 kg in any posture.
[torque]   Universal Robots, "Max. joint torques", by the size of the joint.
[urdf]     Universal Robots, `ur_description` for ROS 2, `physical_parameters.yaml`: inertias of the e-Series, of which
           the products, at most 0.016 kg m^2, are left out; where the tubes of upper arm and forearm lie. From its
           collision meshes the radii of the joints.
[gripper]  A generic parallel gripper with the figures of Robotiq's 2F-85 data sheet: 85 mm opening, 20 to 150 mm/s,
           20 to 235 N, about 0.9 kg.

Estimates of ours: link inertias of the UR5, from solid cylinders of the links' outlines, because the wrist inertias
that circulate are an order of magnitude too large for 1.2 kg; the gripper's inertia, from a cylinder and two bars; the
capsules of the collision checks, from the arm's outlines, those of the e-Series by the proportions of their joints; the
reflected rotor inertias, and 0.3 kg on each finger; the servos' gains, with which 1 kg in the gripper at full reach
lowers the tool of a UR5 by 0.4 mm, and a joint is where a small step commands it after 60 ms, with 4 % overshoot at the
most; the brakes of an arm with torque motors; accelerations and jerks, which Universal Robots does not publish: with
the payload at full reach they need less than the joints' torque limits.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import resources
from typing import Literal

from bhd_lerobot.bodies.body import Arm, ArmChain, Body, CameraSpec, Capsule, GripperSpec, Handling, Limits, Workspace
from bhd_lerobot.errors import ConfigError, unknown_name

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
MAX_OPENING = 0.085  # [m], [gripper]

_ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)  # [rad], [dh]
_BRAKING_SPEED = 0.35  # [rad/s] the speed at which a brake gives a joint's largest torque
_SLIP = 0.1  # share of a joint's largest torque with which its brake slips


@dataclass(frozen=True)
class _Joint:
    """A size of joint: torque [N m, torque], radius [m, urdf]; rotor [kg m^2] and stiffness [N m/rad], estimates."""

    torque: float
    radius: float
    rotor: float
    stiffness: float


_SIZES = (
    _Joint(12.0, 0.0322, 0.06, 4_000.0),
    _Joint(28.0, 0.0390, 0.15, 8_000.0),
    _Joint(56.0, 0.0470, 0.25, 16_000.0),
    _Joint(150.0, 0.0595, 0.5, 40_000.0),
    _Joint(330.0, 0.0764, 1.1, 88_000.0),
)


@dataclass(frozen=True, kw_only=True)
class _Model:
    """The numbers of one arm.

    Attributes:
        a: link lengths [m, dh].
        d: link offsets [m, dh].
        masses: of the links [kg, dh].
        centres: of mass, in the frames behind the joints [m, dh].
        inertias: about the centres of mass, along the axes of these frames [kg m^2, urdf].
        sizes: of the joints, numbers of `_SIZES` [torque].
        speeds: of the joints [deg/s, manual].
        foot: radius of the foot [m, manual].
        offsets: of the tubes of upper arm and forearm along the second joint's axis [m, urdf].
        payload: [kg, manual].
        damping: of the servos [N m s/rad].
        briskness: accelerations and jerks beside those of the UR5.
        reach: horizontal distance from the base beyond which a tool that points down does not get; at most as far as
            the table before it is long [m].
    """

    a: tuple[float, ...]
    d: tuple[float, ...]
    masses: tuple[float, ...]
    centres: tuple[tuple[float, float, float], ...]
    inertias: tuple[tuple[float, float, float], ...]
    sizes: tuple[int, ...]
    speeds: tuple[float, ...]
    foot: float
    offsets: tuple[float, float]
    payload: float
    damping: tuple[float, ...]
    briskness: float
    reach: float

    def numbers(self) -> dict[str, float]:
        """Return what ur.xml calls by names."""
        upper, forearm = self.offsets
        radii = [_SIZES[size].radius for size in self.sizes]
        return {
            **{f"d{k}": self.d[k - 1] for k in (1, 4, 5, 6)},
            **{f"z{k}": round(self.d[k - 1], 3) for k in (1, 4, 5)},
            **{"a2": -self.a[1], "a3": -self.a[2], "so": upper, "eo": forearm, "b": self.foot / _FOOT},
            **{"s": radii[1] / _SIZES[3].radius, "e": radii[2] / _SIZES[3].radius, "w": radii[3] / _SIZES[1].radius},
        }


_FOOT, _REACH = 0.0745, 0.80  # [m] of a UR5
_MODELS: Mapping[str, _Model] = {
    "ur3e": _Model(
        a=(0.0, -0.24355, -0.2132, 0.0, 0.0, 0.0),
        d=(0.15185, 0.0, 0.0, 0.13105, 0.08535, 0.0921),
        masses=(1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
        centres=(
            *((0.0, -0.02, 0.0), (0.13, 0.0, 0.1157), (0.05, 0.0, 0.0238)),
            *((0.0, 0.0, 0.01), (0.0, 0.0, 0.01), (0.0, 0.0, -0.02)),
        ),
        inertias=(
            *((0.0027657, 0.0021501, 0.0025626), (0.0042623, 0.0460284, 0.0448947), (0.0010511, 0.0113396, 0.0110895)),
            *((0.0008174, 0.0006844, 0.0005497), (0.0006059, 0.0005837, 0.0003831), (0.000108, 0.0001086, 0.0001371)),
        ),
        sizes=(2, 2, 1, 0, 0, 0),
        speeds=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
        foot=0.064,
        offsets=(0.120, 0.027),
        payload=3.0,
        damping=(285.0, 285.0, 120.0, 42.0, 42.0, 42.0),
        briskness=1.0,
        reach=0.46,
    ),
    "ur5": _Model(
        a=(0.0, -0.425, -0.39225, 0.0, 0.0, 0.0),
        d=(0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823),
        masses=(3.7, 8.393, 2.33, 1.219, 1.219, 0.1879),
        centres=(
            *((0.0, -0.02561, 0.00193), (0.2125, 0.0, 0.11336), (0.15, 0.0, 0.0265)),
            *((0.0, -0.0018, 0.01634), (0.0, 0.0018, 0.01634), (0.0, 0.0, -0.001159)),
        ),
        inertias=(
            *((0.0102675, 0.00666, 0.0102675), (0.0151074, 0.215298, 0.215298), (0.00235912, 0.0459156, 0.0459156)),
            *((0.00207992, 0.00207992, 0.00123424),) * 2,
            (8.46959e-05, 8.46959e-05, 0.000132117),
        ),
        sizes=(3, 3, 3, 1, 1, 1),
        speeds=(180.0,) * 6,
        foot=_FOOT,
        offsets=(0.136, 0.0165),
        payload=5.0,
        damping=(800.0, 800.0, 450.0, 80.0, 80.0, 80.0),
        briskness=1.0,
        reach=_REACH,
    ),
    "ur5e": _Model(
        a=(0.0, -0.425, -0.3922, 0.0, 0.0, 0.0),
        d=(0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996),
        masses=(3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
        centres=(
            *((0.0, -0.02561, 0.00193), (0.2125, 0.0, 0.11336), (0.15, 0.0, 0.0265)),
            *((0.0, -0.0018, 0.01634), (0.0, 0.0018, 0.01634), (0.0, 0.0, -0.001159)),
        ),
        inertias=(
            *((0.0070021, 0.00648091, 0.00657286), (0.01505885, 0.33388086, 0.33247207)),
            *((0.00399632, 0.07879254, 0.0784851), (0.00165491, 0.00135962, 0.00126279)),
            *((0.00135617, 0.00127827, 0.00096614), (0.00018694, 0.00018908, 0.00025756)),
        ),
        sizes=(3, 3, 3, 1, 1, 1),
        speeds=(180.0,) * 6,
        foot=0.0745,
        offsets=(0.138, 0.007),
        payload=5.0,
        damping=(860.0, 860.0, 475.0, 85.0, 85.0, 85.0),
        briskness=1.0,
        reach=0.80,
    ),
    "ur10e": _Model(
        a=(0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0),
        d=(0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655),
        masses=(7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
        centres=(
            *((0.021, 0.0, 0.027), (0.38, 0.0, 0.158), (0.24, 0.0, 0.068)),
            *((0.0, 0.007, 0.018), (0.0, 0.007, 0.018), (0.0, 0.0, -0.026)),
        ),
        inertias=(
            *((0.03408, 0.03529, 0.02156), (0.02814, 0.77068, 0.76943), (0.01014, 0.30928, 0.30646)),
            *((0.00296, 0.00222, 0.00258), (0.00296, 0.00222, 0.00258), (0.0004, 0.00041, 0.00034)),
        ),
        sizes=(4, 4, 3, 2, 2, 2),
        speeds=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
        foot=0.095,
        offsets=(0.1762, 0.0393),
        payload=8.0,
        damping=(2_100.0, 2_100.0, 700.0, 145.0, 145.0, 145.0),
        briskness=0.6,
        reach=1.0,
    ),
}
MODELS = tuple(_MODELS)
"""The arms, by the names that Universal Robots gives them."""

# Outlines: name, frame, both ends and the radius as in ur.xml. The tubes of upper arm and forearm lie beside the planes
# that the chain's frames lie in.
_CAPSULES = (
    ("base", 0, "0 0 0", "0 0 z1", ".075b"),
    ("shoulder", 1, "0 0 0", "0 0 so", ".065s"),
    ("upper_arm", 2, "a2 0 so", "0 0 so", ".06s"),
    ("elbow", 2, "0 0 eo", "0 0 so", ".055e"),
    ("forearm", 3, "a3 0 eo", "0 0 eo", ".05e"),
    ("wrist_1", 3, "0 0 eo", "0 0 d4", ".045w"),
    ("wrist_2", 4, "0 0 0", "0 0 d5", ".045w"),
    ("wrist_3", 5, "0 0 0", "0 0 d6", ".04w"),
    ("palm", 6, "0 0 0", "0 0 .04", ".045"),
    ("hand", 6, "0 -.045 .05", "0 .045 .05", ".03"),
    ("finger_left", 6, "0 -.05 .07", "0 -.05 .152", ".012"),
    ("finger_right", 6, "0 .05 .07", "0 .05 .152", ".012"),
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


def _value(terms: str, numbers: Mapping[str, float]) -> float:
    """Return a sum of multiples of numbers, such as ``so-.062s`` or ``.04``, rounded to a nanometre."""
    found = re.findall(r"([+-]?[\d.]*)([a-z]+\d?|)", terms)
    factors = [(float(f"{factor}1" if factor in "+-" else factor), name) for factor, name in found if factor or name]
    return round(sum(factor * (numbers[name] if name else 1.0) for factor, name in factors), 9) + 0.0  # no -0.0


def _text(*values: float) -> str:
    return " ".join(map(repr, values))


@lru_cache
def _described(name: str) -> tuple[str, tuple[Capsule, ...]]:
    """Return the MJCF of an arm, and its capsules."""
    model = _MODELS[name]
    numbers = model.numbers()
    capsules = []
    for part, frame, start, end, radius in _CAPSULES:
        (ax, ay, az), (bx, by, bz) = ([_value(one, numbers) for one in point.split()] for point in (start, end))
        capsules.append(Capsule(part, frame, (ax, ay, az), (bx, by, bz), _value(radius, numbers)))
    texts = {"model": name} | {
        one.name: f'fromto="{_text(*one.start, *one.end)}" size="{_text(one.radius)}"' for one in capsules
    }
    for number, size in enumerate(model.sizes):
        joint, twist = _SIZES[size], round(_ALPHA[number] / (math.pi / 2))
        (x, y, z), (about_x, about_y, about_z) = model.centres[number], model.inertias[number]
        # From the frame behind the joint into that of the body, which turns with the joint.
        across, along = (-twist * z, twist * y) if twist else (y, z)
        place = (round(value, 9) + 0.0 for value in (model.a[number] + x, across, model.d[number] + along))
        about = (about_x, about_z, about_y) if twist else (about_x, about_y, about_z)
        mass = _text(model.masses[number])
        texts[f"link_{number + 1}"] = f'pos="{_text(*place)}" mass="{mass}" diaginertia="{_text(*about)}"'
        torque = _text(-joint.torque, joint.torque)
        texts[f"motor_{number + 1}"] = f'actuatorfrcrange="{torque}" armature="{_text(joint.rotor)}"'
    template = resources.files(__package__).joinpath("ur.xml").read_text(encoding="utf-8")
    mjcf = re.sub(r"\{(.+?)\}", lambda found: texts.get(found[1]) or _text(_value(found[1], numbers)), template)
    return mjcf, tuple(capsules)


def ur(
    name: str,
    *,
    actuation: Literal["position", "torque"] = "position",
    load: float = 0.0,
    obstacles: Sequence[Capsule] = (),
    command_timeout_s: float = 0.14,
    camera_width: int = 320,
    camera_height: int = 240,
) -> Body:
    """Return an arm with its gripper.

    Args:
        name: one of `MODELS`.
        actuation: ``"position"`` for position servos, ``"torque"`` for joint torques.
        load: mass that the gripper is declared to carry [kg].
        obstacles: what else is known to stand on the table, or to hang above it: capsules of frame 0.
        command_timeout_s: age at which a setpoint is no longer trusted [s].
        camera_width: width of the cameras' images [px].
        camera_height: height of the cameras' images [px].

    Raises:
        ConfigError: a value is out of range.
    """
    if name not in _MODELS:
        raise ConfigError(unknown_name("arm", name, MODELS))
    if actuation not in ("position", "torque"):
        raise ConfigError(unknown_name("actuation", actuation, ("position", "torque")))
    model = _MODELS[name]
    if not 0.0 <= load <= model.payload:
        raise ConfigError(
            f"The load (robot.payload) is {load} kg; a {name.replace('ur', 'UR')} carries between 0 and "
            f"{model.payload:g} kg."
        )
    mjcf, capsules = _described(name)
    joints = [_SIZES[size] for size in model.sizes]
    turn, torque = 2 * math.pi, actuation == "torque"
    effort = tuple(joint.torque for joint in joints)
    k = model.reach / _REACH  # beside a UR5's
    small = min(1.0, k)  # the gripper is the same

    def brisk(*values: float) -> tuple[float, ...]:
        return tuple(value * model.briskness for value in values)

    return Body(
        name=name,
        mjcf=mjcf,
        root="base",
        arm=Arm(
            limits=Limits(
                names=(*(f"{joint}.pos" for joint in JOINTS), "gripper.pos"),
                lower=(*(-turn,) * 6, 0.0),
                upper=(*(turn,) * 6, MAX_OPENING),
                velocity=(*map(math.radians, model.speeds), 0.150),
                acceleration=(*brisk(8.0, 8.0, 10.0, 15.0, 15.0, 15.0), 2.0),
                jerk=(*brisk(80.0, 80.0, 100.0, 150.0, 150.0, 150.0), 40.0),
                stop_deceleration=(*brisk(12.0, 12.0, 15.0, 20.0, 20.0, 20.0), 4.0),
                stop_jerk=(*brisk(400.0, 400.0, 500.0, 700.0, 700.0, 700.0), 200.0),
                effort=(*effort, 60.0),
                command_timeout_s=command_timeout_s,
            ),
            chain=ArmChain.from_dh(
                joints=JOINTS,
                a=model.a,
                d=model.d,
                alpha=_ALPHA,
                tool=(0.0, 0.0, 0.150),
                capsules=(*capsules, *obstacles),
                disjoint=(*_DISJOINT, *((obstacle.name, link) for obstacle in obstacles for link in _MOVING)),
                min_distance=0.005,
                min_manipulability=0.003 * k**3,
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
            servo_stiffness=(*(joint.stiffness for joint in joints), 8_000.0),
            servo_damping=(*model.damping, 150.0),
            actuators=(*JOINTS, "gripper"),
            actuation=actuation,
            brake_damping=tuple(most / _BRAKING_SPEED for most in effort) if torque else (),
            brake_slip=tuple(_SLIP * most for most in effort) if torque else (),
            # The tool points down; that of a UR5 0.49 m before the base and 0.11 m to its left, 0.28 m above the table.
            home=(math.pi, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0, MAX_OPENING),
            workspace=Workspace(
                tool=((0.20 * k, -0.45 * k, 0.10 * k), (0.70 * k, 0.45 * k, 0.60 * k)),
                # Elbow up and the tool somewhere before the arm: a random posture is nearly always behind it.
                around_home=(1.0, 0.9, 0.9, 1.2, 1.2, math.pi),
                table=((0.35 * k, -0.30 * k), (0.65 * k, 0.30 * k)),
                reach=model.reach,
                handling=Handling(
                    scale=small,
                    travel=0.22 - 0.196 * (1.0 - small),
                    # [rad] The fingers stand one behind the other at home: see `Handling.neutral`.
                    neutral=math.pi - math.atan2(model.d[3], round(model.d[4] - model.a[2], 9)),
                    hand_over=(0.40 * k, -0.40 * k, 0.35 * k),
                ),
            ),
            payload=model.payload,
            load=load,
        ),
        cameras={camera: CameraSpec(camera, camera_width, camera_height) for camera in ("scene", "wrist")},
        physics_hz=500,
        control_hz=500,
        # A servo at its largest effort, which the implicit integrator does not damp, turns a joint to and fro for ever
        # in steps longer than 4 inertia / damping. Wrist 3 has the least inertia.
        least_physics_hz=math.ceil(model.damping[5] / (4 * joints[5].rotor)),
        # At less, a joint at full speed is farther from its reference than `blocked_rad` for a tick; by torques, the
        # observer of the contact is faster than a tick.
        least_control_hz=math.ceil(25 * max(model.speeds) / 180.0) if actuation == "position" else 50,
    )


ur5 = partial(ur, "ur5")
