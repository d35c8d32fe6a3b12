"""What a file says of an arm: its joints, ranges, servos, home, tool and gripper; and what it does not say."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arm_file import ArmFile
from bhd_lerobot.bodies.body import GripperSpec
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.files.model import compiled, joint_speeds, load_model

Array = NDArray[np.float64]

OPENING = "opening_of_gripper"
"""The tendon of two fingers that nothing in the file couples."""
_FEWEST, _MOST = 4, 7  # joints of an arm
_GRIP_N = 20.0  # [N] of a gripper whose force the file does not bound
_OF_JOINTS = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_OF_TENDONS = int(mujoco.mjtTrn.mjTRN_TENDON)
_TOOL_WORDS = ("tcp", "frame", "tool", "pinch", "grasp", "grip", "attach", "eef", "ee", "hand")


@dataclass(frozen=True)
class Servo:
    """Stiffness, damping and largest torque of a servo, friction of its joint; of a gripper those of its opening."""

    stiffness: float
    damping: float
    effort: float
    friction: float = 0.0


class RobotFile:
    """What a file says of an arm, in the order in which it is needed.

    Args:
        file: the file.
    """

    def __init__(self, file: ArmFile) -> None:
        self.file = file
        self.spec = load_model(file.path)
        self.model = compiled(self.spec, file.path)
        self._name_all()
        self.joints, self.last = self._find_chain()
        self.names = [self.model.joint(joint).name for joint in self.joints]
        self.dof = len(self.joints)
        self.lower, self.upper = self._ranges()
        self.fingers, self.actuator = self._find_gripper()
        self.home = self._file_home()
        known = joint_speeds(file.path)
        self.speeds = tuple(known[name] for name in self.names) if set(self.names) <= known.keys() else ()
        self.servos = [self._servo(number) for number in range(self.dof)]
        self.grip = self._gripper()

    # --- the file ------------------------------------------------------------------------------------------------

    def _name_all(self) -> None:
        """Give a name to what has none: everything is found by its name later."""
        for kind in ("bodies", "joints", "geoms", "cameras"):
            for number, one in enumerate(getattr(self.spec, kind)):
                one.name = one.name or f"{kind}_{number}"
        self.model = compiled(self.spec, self.file.path)

    def _above(self, body: int) -> list[int]:
        """Return the joints between the world and a body, from the world on."""
        found: list[int] = []
        while body:
            first = int(self.model.body_jntadr[body])
            found = [*range(first, first + int(self.model.body_jntnum[body])), *found]
            body = int(self.model.body_parentid[body])
        return found

    def _find_chain(self) -> tuple[list[int], int]:
        """Return the arm's joints, and the body that carries the tool."""
        model, file = self.model, self.file
        sites = {model.site(i).name: int(model.site_bodyid[i]) for i in range(model.nsite) if model.site(i).name}
        bodies = {model.body(i).name: i for i in range(1, model.nbody)}
        places = bodies | sites
        if file.tool and file.tool not in places:
            raise ConfigError(unknown_name("site or body of the tool (robot.tool)", file.tool, [*sites, *bodies]))
        self.tool = file.tool or self._guess_tool(sites, bodies)
        body = places[self.tool]
        joints = self._above(body)
        hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
        for joint in joints:
            if model.jnt_type[joint] == slide:
                raise ConfigError(
                    f"The joint {model.joint(joint).name!r} before the tool {self.tool!r} is a slide; an arm's "
                    "joints turn. Name a tool before it with robot.tool, or fix it in the file."
                )
            if model.jnt_type[joint] != hinge:
                raise ConfigError(
                    f"The joint {model.joint(joint).name!r} before the tool {self.tool!r} is free or a ball: the arm "
                    "is fixed to nothing. Remove it from the file; an arm stands on our table."
                )
        if not _FEWEST <= len(joints) <= _MOST:
            found = ", ".join(model.joint(joint).name for joint in joints) or "none"
            raise ConfigError(
                f"The tool {self.tool!r} has {len(joints)} joints before it ({found}); an arm has {_FEWEST} to "
                f"{_MOST}. Name the tool with robot.tool. Sites: {_listed(sites)}. Bodies: {_listed(bodies)}."
            )
        return joints, body

    def _guess_tool(self, sites: dict[str, int], bodies: dict[str, int]) -> str:
        """Return the site that is the tool, or the last body of the only chain."""
        roots = {self._root(joint_body) for joint_body in self.model.jnt_bodyid if self._hinges(int(joint_body))}
        if len(roots) > 1:
            names = ", ".join(sorted(self.model.body(root).name for root in roots))
            raise ConfigError(f"The file has more than one tree with joints: {names}. Name the tool with robot.tool.")
        for places in (sites, bodies):
            ends = {name: len(self._above(body)) for name, body in places.items()}
            ends = {name: count for name, count in ends.items() if _FEWEST <= count <= _MOST}
            if places is bodies:  # of bodies only those that are named so
                ends = {
                    name: count for name, count in ends.items() if any(_has_word(name, word) for word in _TOOL_WORDS)
                }
            ends = {name: count for name, count in ends.items() if count == max(ends.values())}
            named = ([name for name in ends if _has_word(name, word)] for word in _TOOL_WORDS)
            for candidates in (list(ends), *named):
                if len(candidates) == 1:
                    return candidates[0]
        raise ConfigError(
            "The file does not say where the tool is. Name a site or a body with robot.tool, and where the tool centre "
            f"point is in it with robot.tool_offset. Sites: {_listed(sites)}. Bodies: {_listed(bodies)}."
        )

    def _hinges(self, body: int) -> bool:
        return any(self.model.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_FREE) for joint in self._above(body))

    def _root(self, body: int) -> int:
        return int(self.model.body_rootid[body])

    def _ranges(self) -> tuple[Array, Array]:
        model, lower, upper = self.model, np.empty(self.dof), np.empty(self.dof)
        given = {name: (low, high) for name, low, high in self.file.ranges}
        for name in given.keys() - set(self.names):
            raise ConfigError(unknown_name("joint of robot.ranges", name, self.names))
        missing = [
            n for n, j in zip(self.names, self.joints, strict=True) if not model.jnt_limited[j] and n not in given
        ]
        if missing:
            raise ConfigError(
                f"The file has no range for {_listed(missing)}. Say how far it may turn [rad]: --robot.ranges='"
                f"{{{', '.join(f'{name}: [-3.14, 3.14]' for name in missing)}}}'."
            )
        for number, (name, joint) in enumerate(zip(self.names, self.joints, strict=True)):
            lower[number], upper[number] = given.get(name, model.jnt_range[joint])
            if not lower[number] < upper[number]:
                raise ConfigError(
                    f"The range of {name} is {lower[number]:g} to {upper[number]:g} rad; the first must be smaller. "
                    "Give it with robot.ranges."
                )
        return lower, upper

    def _file_home(self) -> Array | None:
        """Return the posture that the option or the file gives, shape (dof,)."""
        keys = {self.model.key(number).name: number for number in range(self.model.nkey)}
        if self.file.home:
            home = np.array(self.file.home)
            if not np.isfinite(home).all():
                raise ConfigError(f"robot.home is {list(self.file.home)}; it needs finite numbers [rad].")
            if home.shape != (self.dof,):
                raise ConfigError(
                    f"robot.home has {len(home)} numbers; the arm has {self.dof} joints: {_listed(self.names)}."
                )
        elif "home" in keys:
            home = self.model.key_qpos[keys["home"], self.model.jnt_qposadr[self.joints]].copy()
        else:
            return None
        outside = (home < self.lower - 1e-6) | (home > self.upper + 1e-6)
        if outside.any():
            at = int(outside.argmax())
            raise ConfigError(
                f"{self.names[at]} is at {home[at]:.3f} rad at home; its range is {self.lower[at]:.3f} to "
                f"{self.upper[at]:.3f}. Give another posture with robot.home."
            )
        return home

    # --- servos --------------------------------------------------------------------------------------------------

    def _of_joint(self, joint: int) -> list[int]:
        """Return the actuators of a joint."""
        kinds, targets = self.model.actuator_trntype, self.model.actuator_trnid
        return [a for a in range(self.model.nu) if kinds[a] in _OF_JOINTS and targets[a, 0] == joint]

    def _servo(self, number: int) -> Servo:
        """Return the servo of a joint of the arm; that of the file if it has a position servo."""
        joint, name = self.joints[number], self.names[number]
        found = self._of_joint(joint)
        if len(found) > 1:
            names = _listed(self.model.actuator(one).name for one in found)
            raise ConfigError(f"The joint {name!r} has {len(found)} actuators, {names}; leave one of them in the file.")
        effort = self._effort(number, found)
        gains = _position_gains(self.model, found[0]) if found else None
        damping = float(self.model.dof_damping[self.model.jnt_dofadr[joint]])
        friction = float(self.model.dof_frictionloss[self.model.jnt_dofadr[joint]])
        stiffness, own = gains or (0.0, 0.0)
        measured = {one: values for one, *values in self.file.servos}
        if unknown := measured.keys() - set(self.names):
            raise ConfigError(unknown_name("joint of robot.servos", min(unknown), self.names))
        if name in measured:
            stiffness, own, friction = measured[name]
            return Servo(stiffness, own, effort, friction)
        return Servo(stiffness, own + damping, effort, friction)

    def _effort(self, number: int, actuators: Sequence[int]) -> float:
        if self.file.effort:
            return each_of(self.file.effort, self.dof, "robot.effort")[number]
        most, joint = [], self.joints[number]
        if self.model.jnt_actfrclimited[joint]:
            most.append(self.model.jnt_actfrcrange[joint, 1])
        for one in actuators:
            gear = abs(self.model.actuator_gear[one, 0])
            if self.model.actuator_forcelimited[one]:
                most.append(gear * self.model.actuator_forcerange[one, 1])
            elif _position_gains(self.model, one) is None and self.model.actuator_ctrllimited[one]:
                most.append(gear * self.model.actuator_gainprm[one, 0] * self.model.actuator_ctrlrange[one, 1])
        if not most:
            have = "no actuator" if not actuators else "an actuator whose force has no bound"
            raise ConfigError(
                f"The joint {self.names[number]!r} has {have}, so its largest torque is not known. Say the torques of "
                f"all joints [N m]: --robot.effort='[…]' for {_listed(self.names)}, or one for all."
            )
        return float(min(most))

    # --- the gripper ---------------------------------------------------------------------------------------------

    def _find_gripper(self) -> tuple[list[int], int | None]:
        """Return the joints that the opening is read from, and the actuator, if the file has one."""
        model, name = self.model, self.file.gripper.name
        below = [
            j for j in range(model.njnt) if j not in self.joints and self.joints[-1] in self._above(model.jnt_bodyid[j])
        ]
        if name == "none" or (not name and not below):
            return [], None
        by_joint = {model.joint(j).name: [j] for j in below}
        by_tendon = {model.tendon(t).name: joints for t in range(model.ntendon) if (joints := self._wrapped(t))}
        movers: dict[int, list[int]] = {}  # actuators, and the joints that they move
        for one in range(model.nu):
            target, kind = int(model.actuator_trnid[one, 0]), int(model.actuator_trntype[one])
            moved = self._wrapped(target) if kind == _OF_TENDONS else [target] * (kind in _OF_JOINTS)
            if moved and set(moved) <= set(below):
                movers[one] = moved
        by_actuator = {model.actuator(one).name: one for one in movers}
        if name:
            known = [*dict.fromkeys((*by_actuator, *by_tendon, *by_joint))]
            if name not in known:
                raise ConfigError(unknown_name("gripper (robot.gripper.name)", name, [*known, "none"]))
            if name in by_actuator:
                return movers[by_actuator[name]][:2], by_actuator[name]
            joints = (by_joint.get(name) or by_tendon[name])[:2]
            own = [one for one, moved in movers.items() if set(moved) & set(joints)]
            return joints, own[0] if own else None
        if len(movers) == 1:
            [(one, moved)] = movers.items()
            return self._with_coupled(moved)[:2], one
        if len(below) <= 2 and len(movers) != 1:
            return below, next(iter(movers), None) if len(below) == 1 else None
        raise ConfigError(
            f"Behind the last joint are {_listed(by_joint)}, and it is not clear what moves the gripper. Name an "
            f"actuator, a tendon or a joint with robot.gripper.name, or say none. Actuators: {_listed(by_actuator)}."
        )

    def _wrapped(self, tendon: int) -> list[int]:
        """Return the joints of a fixed tendon."""
        first, count = int(self.model.tendon_adr[tendon]), int(self.model.tendon_num[tendon])
        places = range(first, first + count)
        kind = int(mujoco.mjtWrap.mjWRAP_JOINT)
        return [int(self.model.wrap_objid[p]) for p in places if self.model.wrap_type[p] == kind]

    def _with_coupled(self, joints: Sequence[int]) -> list[int]:
        """Return joints, and one that an equality couples with the only one."""
        if len(joints) > 1:
            return list(joints)
        for number in range(self.model.neq):
            pair = [int(self.model.eq_obj1id[number]), int(self.model.eq_obj2id[number])]
            if self.model.eq_type[number] == int(mujoco.mjtEq.mjEQ_JOINT) and joints[0] in pair and pair[1] >= 0:
                return [joints[0], *(one for one in pair if one != joints[0])]
        return list(joints)

    def _ends(self, joint: int) -> tuple[float, float]:
        """Return where a joint of the gripper is when this is closed and when it is open."""
        model, given, name = self.model, self.file.gripper, self.model.joint(joint).name
        low, high = model.jnt_range[joint].tolist() if model.jnt_limited[joint] else (-np.inf, np.inf)
        closed, opened = (given.closed, given.open) if joint == self.fingers[0] else (None, None)
        if (closed is None or opened is None) and not model.jnt_limited[joint]:
            raise ConfigError(
                f"The gripper's joint {name!r} has no range. Say where it is open and closed: --robot.gripper.open=…, "
                "--robot.gripper.closed=…."
            )
        if closed is None or opened is None:
            away = [self._away(joint, end) for end in (low, high)]
            ends = (low, high) if away[1] > away[0] else (high, low)
            closed, opened = ends[0] if closed is None else closed, ends[1] if opened is None else opened
        for which, value in (("closed", closed), ("open", opened)):
            if not low - 1e-6 <= value <= high + 1e-6:
                raise ConfigError(
                    f"robot.gripper.{which} is {value:g}; the joint {name!r} goes from {low:g} to {high:g}."
                )
        if closed == opened:
            raise ConfigError(f"The gripper's joint {name!r} is at {closed:g} open and closed; they must differ.")
        return closed, opened

    def _away(self, joint: int, end: float) -> float:
        """Return how far what a joint of the gripper moves is from the tool centre point [m]."""
        model, data = self.model, mujoco.MjData(self.model)
        data.qpos[:] = model.qpos0
        data.qpos[model.jnt_qposadr[joint]] = end
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return float(np.linalg.norm(data.subtree_com[model.jnt_bodyid[joint]] - self._tool_point(data)))

    def _tool_point(self, data: Any) -> Array:
        return np.asarray(self._tool_matrix(data)[:3, 3])

    def _tool_matrix(self, data: Any) -> Array:
        """Return the pose of the site or body that the tool is in, with its offset, in the world."""
        is_site = self.tool in [self.model.site(i).name for i in range(self.model.nsite)]
        place = data.site(self.tool) if is_site else data.body(self.tool)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = place.xmat.reshape(3, 3), place.xpos
        pose[:3, 3] += pose[:3, :3] @ np.asarray(self.file.tool_offset, np.float64)
        return pose

    def _gripper(self) -> tuple[GripperSpec, Servo] | None:
        """Return the gripper and its servo, whose numbers are those of the opening."""
        if not self.fingers:
            return None
        model, joints, given = self.model, self.fingers, self.file.gripper
        names = tuple(model.joint(joint).name for joint in joints)
        if clash := {"gripper"} & set(self.names):
            raise ConfigError(
                f"A joint of the arm is named {clash.pop()!r}, which is what the gripper is called. Rename it."
            )
        ends = [self._ends(joint) for joint in joints]
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        ways = (abs(opened - closed) * self._lever(data, j) for j, (closed, opened) in zip(joints, ends, strict=True))
        opening = sum(ways) if given.opening is None else given.opening
        if not opening > 0:
            raise ConfigError(f"robot.gripper.opening is {opening}; it must be positive [m].")
        closed, opened = (tuple(one) for one in zip(*ends, strict=True))
        tendon, pull = "", (closed[0], opened[0] - closed[0])
        actuator, gains = self.actuator, None
        if actuator is not None and model.actuator_trntype[actuator] == _OF_TENDONS:
            number = int(model.actuator_trnid[actuator, 0])
            tendon = model.tendon(number).name
            first, last = (self._length(number, values) for values in (closed, opened))
            pull = first, last - first
        elif len(joints) == 2 and actuator is None:
            tendon = OPENING
        spec = GripperSpec(
            joints=names,
            actuator="gripper",
            body=model.body(model.jnt_bodyid[self.joints[-1]]).name,
            tendon=tendon,
            pads=(),
            max_opening=opening,
            widest=0.85 * opening,
            closed=closed,
            opened=opened,
            pull=pull,
        )
        if tendon == OPENING:
            spec = replace(spec, pull=(sum(a * b for a, b in zip(spec.per_joint, closed, strict=True)), opening))
        scale = abs(spec.pull[1]) / opening  # of what the actuator pulls, for each metre of the opening
        mujoco.mj_forward(model, data)
        inertia = sum(
            _inertia(model, data, joint) / (len(joints) * one) ** 2
            for joint, one in zip(joints, spec.per_joint, strict=True)
        )
        effort = _GRIP_N
        if actuator is not None:
            gains = _position_gains(model, actuator)
            if model.actuator_forcelimited[actuator]:
                gear = abs(float(model.actuator_gear[actuator, 0]))
                effort = gear * float(model.actuator_forcerange[actuator, 1]) * scale
        elif model.jnt_actfrclimited[joints[0]]:
            effort = float(model.jnt_actfrcrange[joints[0], 1]) / abs(spec.per_joint[0])
        if gains is None:
            stiffness = 10 * effort / opening
            return spec, Servo(stiffness, 2 * float(np.sqrt(stiffness * max(inertia, 0.05))), effort)
        return spec, Servo(gains[0] * scale**2, gains[1] * scale**2, effort)

    def _lever(self, data: Any, joint: int) -> float:
        """Return how far the tool centre point is from a hinge of the gripper [m]; 1 for a slide."""
        if self.model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE):
            return 1.0
        arm = self._tool_point(data) - data.xanchor[joint]
        return float(np.linalg.norm(arm - data.xaxis[joint] * (arm @ data.xaxis[joint])))

    def _length(self, tendon: int, values: Sequence[float]) -> float:
        """Return the length of a tendon when the gripper's joints are there."""
        data = mujoco.MjData(self.model)
        for joint, value in zip(self.fingers, values, strict=True):
            data.qpos[self.model.jnt_qposadr[joint]] = value
        mujoco.mj_fwdPosition(self.model, data)
        return float(data.ten_length[tendon])


def _position_gains(model: Any, actuator: int) -> tuple[float, float] | None:
    """Return stiffness and damping of a position servo; None of another actuator."""
    fixed = model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
    direct = model.actuator_dyntype[actuator] == int(mujoco.mjtDyn.mjDYN_NONE)
    stiffness, damping = -model.actuator_biasprm[actuator, 1:3] * model.actuator_gear[actuator, 0] ** 2
    return (float(stiffness), float(damping)) if fixed and affine and direct and stiffness > 0 else None


def _inertia(model: Any, data: Any, joint: int) -> float:
    """Return what a joint feels of the masses behind it."""
    unit, result = np.zeros(model.nv), np.zeros(model.nv)
    unit[model.jnt_dofadr[joint]] = 1.0
    mujoco.mj_mulM(model, data, result, unit)
    return float(result[model.jnt_dofadr[joint]])


def each_of(values: Sequence[float], count: int, key: str) -> tuple[float, ...]:
    """Return a number for each joint."""
    if len(values) not in (1, count) or not all(value > 0 and np.isfinite(value) for value in values):
        raise ConfigError(f"{key} is {list(values)}; it needs one positive number, or {count}: one for each joint.")
    return tuple(float(value) for value in (values if len(values) == count else (*values,) * count))


def _has_word(name: str, word: str) -> bool:
    return word in (re.split(r"[^a-z]+", name.lower()) if len(word) < 4 else name.lower())


def _listed(names: Any) -> str:
    return ", ".join(str(name) for name in names) or "none"
