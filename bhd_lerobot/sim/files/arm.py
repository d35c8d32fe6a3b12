"""The body of an arm, from an MJCF or URDF that somebody else wrote.

Of a scene the robot alone is taken, and put onto our table: its base above the origin, turned by a multiple of 90
degrees so that it works along x. Floor, lights, sensors, keyframes and physics options of the file are left out, and so
are springs of the arm's joints and contact margins: its servos carry the arm, within the torque that they have.
Position servos keep the gains of the file, and the damping of a joint counts as its servo's; other joints get a servo
whose natural frequency is `_STIFF` and whose damping is critical.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arm_file import ArmFile
from bhd_lerobot.bodies.body import (
    Arm,
    ArmChain,
    Body,
    CameraSpec,
    Capsule,
    GripperSpec,
    Handling,
    Inertia,
    Limits,
    Workspace,
)
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.chain import chain_from_mjcf
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.files.model import compiled, robot_alone
from bhd_lerobot.sim.files.robot import OPENING, RobotFile, Servo, each_of
from bhd_lerobot.sim.table_stage import ARM_BIT, TABLE_BIT

Array = NDArray[np.float64]

_STIFF = 25.0  # [rad/s] natural frequency of a servo that the file does not have
_ROTOR = 0.005  # [kg m^2 for each N m] of effort, rotor of such a joint if the file has none: as of known arms
_STRETCH = 0.03  # [rad] by so much at the most is a servo off while it accelerates
_MOST_ACCELERATION, _SPARE = 15.0, 0.5  # [rad/s^2]; share of the torque left by the weight that accelerations may need
_SPEED = 2.0  # [rad/s] of a joint of which nothing is known: small servos and large arms can do that
_NEAR = 0.003  # [m] that the arm stays away from itself and the table
_ON_AXIS = 0.001  # [m] from the first joint's axis: what is no farther turns on the spot
_LIKELY = 0.01  # share of the postures around home that tasks may ask for
_POSTURES = 4000  # that are drawn to find out what an arm reaches
_HELD_SHARE = 0.4  # of the payload, with which a joint has to arrive
_AHEAD = 0.05  # [m] nearer to the base's axis than this the tool is before it in no direction
# What the workspace of a UR5 is made for, which others have to scale [m]: its reach on the table, that to the farther
# corners of the part where things stand, the widest thing that its gripper grasps, and what a pick lifts things by.
_LIKE_UR5, _CORNER_UR5, _WIDEST_UR5, _LIFT = 0.8, 0.716, 0.076, 0.1


@lru_cache(maxsize=8)
def _described(file: ArmFile, changed: float) -> Body:
    return _Arm(file).body


def arm_body(
    file: ArmFile,
    *,
    load: float = 0.0,
    obstacles: Sequence[Capsule] = (),
    command_timeout_s: float = 0.14,
    camera_width: int = 320,
    camera_height: int = 240,
) -> Body:
    """Return the body of an arm in a file.

    Raises:
        ConfigError: the file is not there or not valid, or something has to be said that it does not say.
    """
    path = Path(file.path).expanduser().resolve()
    if not path.is_file():
        raise ConfigError(f"robot.mjcf is {file.path!r}, and there is no such file.")
    body = _described(replace(file, path=str(path)), path.stat().st_mtime)
    arm = body.need(Arm)
    if not 0.0 <= load <= arm.payload:
        raise ConfigError(
            f"The load (robot.payload) is {load} kg; the {file.name} carries between 0 and {arm.payload:.3g} kg."
        )
    chain = _among(arm.chain, obstacles, np.array(arm.home[: arm.chain.dof])) if obstacles else arm.chain
    limits = replace(arm.limits, command_timeout_s=command_timeout_s)
    cameras = {name: CameraSpec(name, camera_width, camera_height) for name in body.cameras}
    return replace(body, arm=replace(arm, chain=chain, limits=limits, load=load), cameras=cameras)


def _among(chain: ArmChain, obstacles: Sequence[Capsule], home: Array) -> ArmChain:
    """Return a chain whose distances from obstacles are checked, of all that its joints move.

    What turns on the spot with the first joint does not move. Where the arm stands on, or in, an obstacle, the first
    link is too near to it at home already, and says nothing about a posture.
    """
    rotation, position = np.array(chain.links[0].rotation), np.array(chain.links[0].position)

    def is_swept(capsule: Capsule) -> bool:
        ends = np.array([capsule.start, capsule.end]) @ rotation.T + position
        return bool(np.hypot(ends[:, 0], ends[:, 1]).max() > _ON_AXIS)

    first = [capsule.name for capsule in chain.capsules if capsule.frame == 1 and is_swept(capsule)]
    farther = [capsule.name for capsule in chain.capsules if capsule.frame > 1]
    chain = replace(chain, capsules=(*chain.capsules, *obstacles))
    pairs = [(obstacle.name, name) for obstacle in obstacles for name in first]
    apart = CollisionModel(replace(chain, disjoint=tuple(pairs))).each(home[None])[: len(pairs), 0]
    pairs = [pair for pair, distance in zip(pairs, apart, strict=True) if distance >= chain.min_distance]
    pairs += [(obstacle.name, name) for obstacle in obstacles for name in farther]
    return replace(chain, disjoint=(*chain.disjoint, *pairs))


class _Arm(RobotFile):
    """The body of an arm in a file.

    Attributes:
        body: the body.
    """

    def __init__(self, file: ArmFile) -> None:
        super().__init__(file)
        self.payload, self.slowest_hz, self.arrived_rad = 0.0, 100.0, 0.002
        self._prepare()
        self.body = self._body()

    # --- our model -----------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Make the spec one of the robot alone, with a site for the tool and without actuators."""
        model, spec = self.model, self.spec
        data = mujoco.MjData(model)
        self._set(data, self.home)
        mujoco.mj_kinematics(model, data)
        root = self._root(self.last)
        self.root = model.body(root).name
        where = self._stand(data)
        kept = set(self.names) | {
            model.joint(one).name for one in range(model.njnt) if self.joints[-1] in self._above(model.jnt_bodyid[one])
        }
        own = {model.geom(g).name for g in range(model.ngeom) if self._root(model.geom_bodyid[g]) == root}
        strange = [pair for pair in spec.pairs if not {pair.geomname1, pair.geomname2} <= own]
        others = {model.joint(one).name for one in range(model.njnt)} - kept
        tendons = [
            one
            for number, one in enumerate(spec.tendons)
            if others & {model.joint(joint).name for joint in self._wrapped(number)}
        ]
        others |= {one.name for one in tendons}
        coupled = (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON)
        equalities = [one for one in spec.equalities if one.type in coupled and others & {one.name1, one.name2}]
        for kind in (spec.keys, spec.sensors, spec.lights, spec.actuators, strange, equalities, tendons):
            for one in list(kind):
                spec.delete(one)
        for joint in list(spec.joints):
            if joint.name not in kept:
                spec.delete(joint)
            elif joint.name in self.names:
                number = self.names.index(joint.name)
                # In the unit of its own file, which may be attached to another one.
                unit = np.pi / 180 if getattr(joint, "compiler", spec.compiler).degree else 1.0
                for kind in ("damping", "stiffness", "springdamper"):
                    value = getattr(joint, kind)
                    setattr(joint, kind, 0.0 if np.isscalar(value) else [0.0] * len(value))
                effort = self.servos[number].effort
                joint.actfrcrange, joint.actfrclimited = [-effort, effort], True
                if self.file.servos:
                    joint.frictionloss = self.servos[number].friction
                joint.range, joint.limited = [self.lower[number] / unit, self.upper[number] / unit], True
                if not joint.armature and not self.servos[number].stiffness:
                    joint.armature = _ROTOR * self.servos[number].effort
        sky = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        for texture in [one for one in spec.textures if int(one.type) == sky]:
            spec.delete(texture)
        self._add_tool_site(model, data)
        self._set_contacts()
        if self.grip is not None and self.grip[0].tendon == OPENING:
            self._couple(self.grip[0])
        world = spec.worldbody
        for one in (*world.geoms, *world.cameras, *world.sites, *world.bodies):
            if one.name != self.root:
                spec.delete(one)
        self.model = compiled(spec, self.file.path)
        self._exclude()
        compiled(spec, self.file.path)
        self.mjcf = robot_alone(spec.to_xml(), where)
        self.model = mujoco.MjModel.from_xml_string(self.mjcf)
        grip_bodies = [b for b in range(self.model.nbody) if self._moved_by(b) == self.dof - 1]
        self.pads = tuple(
            self.model.geom(g).name
            for g in range(self.model.ngeom)
            if self.model.geom_bodyid[g] in grip_bodies and self.model.geom_contype[g]
        )

    def _set_contacts(self) -> None:
        """Let what collides touch table, objects and the arm, and draw what is seen."""
        seen = {geom.parent.name for geom in self.spec.geoms if not (geom.contype or geom.conaffinity)}
        for geom in self.spec.geoms:
            geom.group = 1
            geom.margin = geom.gap = 0.0  # what is near is no contact
            if geom.contype or geom.conaffinity:
                geom.contype, geom.conaffinity = ARM_BIT, ARM_BIT | TABLE_BIT
                geom.group = 3 if geom.parent.name in seen else 1

    def _set(self, data: Any, posture: Array | None) -> None:
        data.qpos[:] = self.model.qpos0
        middle = (self.lower + self.upper) / 2
        data.qpos[[self.model.jnt_qposadr[self.model.joint(name).id] for name in self.names]] = (
            middle if posture is None else posture
        )
        if self.grip is not None:
            for name, value in zip(self.grip[0].joints, self.grip[0].opened, strict=True):
                data.qpos[self.model.joint(name).qposadr[0]] = value

    def _stand(self, data: Any) -> Array:
        """Return the transform that puts the base onto the table's top, turned so that the tool is before it."""
        model, root = self.model, data.body(self.root)
        fixed = [
            geom
            for geom in range(model.ngeom)
            if self._root(model.geom_bodyid[geom]) == self._root(self.last) and not self._above(model.geom_bodyid[geom])
        ]
        origin = root.xpos.copy()
        lowest = min((_lowest(model, data, geom) for geom in fixed), default=float(origin[2]))
        postures = [self.home] if self.home is not None else []
        if not postures:
            postures = list(np.random.default_rng(0).uniform(self.lower, self.upper, (200, self.dof)))
        tools = []
        for posture in postures:
            self._set(data, posture)
            mujoco.mj_kinematics(model, data)
            tools.append(self._tool_point(data))
        ahead = np.mean(tools, axis=0) - origin
        turns = round(float(np.arctan2(ahead[1], ahead[0])) / (np.pi / 2)) if np.hypot(*ahead[:2]) > _AHEAD else 0
        c, s = (round(value) for value in (np.cos(turns * np.pi / 2), -np.sin(turns * np.pi / 2)))
        where = np.array([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, -lowest], [0.0, 0.0, 0.0, 1.0]])
        where[:2, 3] = -where[:2, :2] @ origin[:2]
        return where

    def _add_tool_site(self, model: Any, data: Any) -> None:
        """Add the tool frame: z out of the gripper, y from the left to the right finger; as in the file without one."""
        pose = self._tool_matrix(data)
        if self.grip is not None:
            fingers = [model.joint(name).bodyid[0] for name in self.grip[0].joints]
            mujoco.mj_comPos(model, data)
            first = data.subtree_com[fingers[0]]
            other = data.subtree_com[fingers[1]] if len(fingers) > 1 else pose[:3, 3]
            out = pose[:3, 3] - data.xanchor[self.joints[-1]]
            axis = data.xaxis[self.joints[-1]]
            out = (
                axis * np.sign(out @ axis) if abs(out @ axis) > 0.5 * np.linalg.norm(out) else out / np.linalg.norm(out)
            )
            across = other - first
            across -= out * (out @ across)
            if np.linalg.norm(across) > 1e-4:
                across /= np.linalg.norm(across)
                pose[:3, :3] = np.column_stack((np.cross(across, out), across, out))
        for site in list(self.spec.sites):
            if site.name == "tool":
                self.spec.delete(site)
        body = data.body(model.body(self.last).name)
        turn, own = body.xmat.reshape(3, 3), np.empty(4)
        mujoco.mju_mat2Quat(own, (turn.T @ pose[:3, :3]).reshape(-1))
        self.spec.body(model.body(self.last).name).add_site(
            name="tool", pos=turn.T @ (pose[:3, 3] - body.xpos), quat=own, group=4
        )

    def _couple(self, grip: GripperSpec) -> None:
        """Let two fingers that nothing couples move as one."""
        tendon = self.spec.add_tendon(name=grip.tendon)
        for name, one in zip(grip.joints, grip.per_joint, strict=True):
            tendon.wrap_joint(name, one)
        ratio = (grip.opened[0] - grip.closed[0]) / (grip.opened[1] - grip.closed[1])
        equality = self.spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
        equality.name1, equality.name2 = grip.joints
        equality.data[:5] = [grip.closed[0] - ratio * grip.closed[1], ratio, 0.0, 0.0, 0.0]
        equality.solref[:] = [0.004, 1.0]

    def _exclude(self) -> None:
        """Leave out contacts of links that touch when nothing is wrong: next to each other, or at home."""
        data = mujoco.MjData(self.model)
        self._set(data, self.home)
        mujoco.mj_forward(self.model, data)
        bodies = self.model.geom_bodyid
        pairs = {tuple(sorted((int(bodies[c.geom[0]]), int(bodies[c.geom[1]])))) for c in data.contact}
        chain = [int(self.model.joint(name).bodyid[0]) for name in self.names]
        pairs |= {(one, other) for one, other in zip(chain, chain[2:], strict=False)}
        for one, other in sorted(pairs):
            if one and other and one != other:
                self.spec.add_exclude(bodyname1=self.model.body(one).name, bodyname2=self.model.body(other).name)

    # --- what follows from it ------------------------------------------------------------------------------------

    def _touches(self, posture: Array) -> bool:
        """Return whether the arm touches itself in a posture."""
        data = mujoco.MjData(self.model)
        self._set(data, posture)
        mujoco.mj_forward(self.model, data)
        return bool(data.ncon)

    def _inertias(self, chain: ArmChain, opening_home: Array) -> tuple[Inertia, ...]:
        """Return what moves with each joint, the gripper open."""
        model, data = self.model, mujoco.MjData(self.model)
        self._set(data, opening_home)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        pose, found = chain.base.matrix(), []
        for number, name in enumerate(self.names):
            c, s = np.cos(opening_home[number]), np.sin(opening_home[number])
            turned = pose @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
            bodies = [b for b in range(1, model.nbody) if self._moved_by(b) == number]
            mass = float(sum(model.body_mass[b] for b in bodies))
            centre = sum((model.body_mass[b] * data.xipos[b] for b in bodies), np.zeros(3)) / max(mass, 1e-9)
            about = np.zeros((3, 3))
            for b in bodies:
                turn, off = data.ximat[b].reshape(3, 3), data.xipos[b] - centre
                about += turn @ np.diag(model.body_inertia[b]) @ turn.T
                about += model.body_mass[b] * (off @ off * np.eye(3) - np.outer(off, off))
            rotation = turned[:3, :3]
            rows = tuple(tuple(row) for row in (rotation.T @ about @ rotation).tolist())
            at = tuple((rotation.T @ (centre - turned[:3, 3])).tolist())
            found.append(Inertia(mass, at, rows, float(model.dof_armature[model.joint(name).dofadr[0]])))
            pose = turned @ chain.links[number].matrix()
        return tuple(found)

    def _moved_by(self, body: int) -> int:
        """Return the number of the last of the arm's joints that moves a body; -1 for none."""
        above = [self.model.joint(joint).name for joint in self._above(body)]
        return max((self.names.index(name) for name in above if name in self.names), default=-1)

    def _body(self) -> Body:
        """Return the body: what the motors can do in any posture decides what is asked of them."""
        chain = self._chain(self.home)
        middle = (self.lower + self.upper) / 2
        rng = np.random.default_rng(0)
        postures = rng.uniform(self.lower, self.upper, (_POSTURES // 20, self.dof))
        effort = np.array([servo.effort for servo in self.servos])
        body = self._with(
            chain,
            middle,
            np.ones(self.dof),
            self.servos,
            Workspace(
                tool=((0.0,) * 3, (1.0,) * 3), around_home=(1.0,) * self.dof, table=((0.0,) * 2, (1.0,) * 2), reach=1.0
            ),
        )
        terms = ArmDynamics(body).terms(postures, np.zeros_like(postures))
        inertia = np.diagonal(terms.mass, axis1=1, axis2=2)
        weight = np.abs(terms.gravity).max(axis=0)
        servos = [
            servo if servo.stiffness else _own_servo(servo, float(most))
            for servo, most in zip(self.servos, inertia.max(axis=0), strict=True)
        ]
        stiffness = np.array([servo.stiffness for servo in servos])
        acceleration = np.minimum(_STRETCH * stiffness, _SPARE * np.maximum(effort - weight, 0.2 * effort))
        acceleration = np.clip(acceleration / inertia.max(axis=0), 0.5, _MOST_ACCELERATION)
        if self.file.acceleration:
            acceleration = np.array(each_of(self.file.acceleration, self.dof, "robot.acceleration"))
        spare = np.maximum(0.8 * effort - np.abs(terms.gravity), 0.0) / (9.81 * np.abs(terms.jacobian[:, 2]) + 1e-9)
        self.payload = float(spare.min()) if self.file.payload is None else self.file.payload
        held = _HELD_SHARE * self.payload * 9.81 * np.abs(terms.jacobian[:, 2]).max(axis=0)
        off = (1.2 * np.array([servo.friction for servo in servos]) + held) / stiffness
        self.arrived_rad = max(self.arrived_rad, float(off.max()))
        self.slowest_hz = max(
            servo.damping / (4 * float(least)) for servo, least in zip(servos, inertia.min(axis=0), strict=True)
        )
        kinematics = ArmKinematics(chain, body.limits)
        workspace = self._workspace(kinematics)
        home = self._choose_home(kinematics, workspace)
        chain = self._chain(home)
        workspace = self._with_handling(ArmKinematics(chain, body.limits), workspace, home)
        return self._with(chain, home, acceleration, servos, workspace)

    def _chain(self, home: Array | None) -> ArmChain:
        given = (self.lower + self.upper) / 2 if home is None else home
        positions = dict(zip(self.names, given.tolist(), strict=True))
        if self.grip is not None:
            positions |= dict(zip(self.grip[0].joints, self.grip[0].opened, strict=True))
        return chain_from_mjcf(self.model, "tool", root="world", home=positions, min_distance=_NEAR)

    def _with(
        self, chain: ArmChain, home: Array, acceleration: Array, servos: Sequence[Servo], workspace: Workspace
    ) -> Body:
        """Return the body with these numbers."""
        grip, servo = self.grip or (None, None)
        every = [*servos, *([servo] if servo else [])]
        limits = self._limits(acceleration)
        if grip is not None:
            grip = replace(grip, pads=self.pads)
        arm = Arm(
            limits=limits,
            chain=chain,
            gripper=grip,
            servo_stiffness=tuple(one.stiffness or 1.0 for one in every),
            servo_damping=tuple(one.damping for one in every),
            actuators=(*self.names, *(("gripper",) if grip else ())),
            actuation="position",
            home=(*home.tolist(), *((grip.max_opening,) if grip else ())),
            workspace=workspace,
            payload=self.payload,
            inertias=self._inertias(chain, home),
            arrived_rad=self.arrived_rad,
        )
        on_arm = [self.model.camera(number).name for number in range(self.model.ncam)]
        return Body(
            name=self.file.name,
            mjcf=self.mjcf,
            root=self.root,
            arm=arm,
            cameras={name: CameraSpec(name, 320, 240) for name in ("scene", *on_arm)},
            physics_hz=500,
            control_hz=500,
            least_physics_hz=max(100, int(np.ceil(self.slowest_hz))),
            least_control_hz=50,
        )

    def _limits(self, acceleration: Array) -> Limits:
        """Return the limits of commands; those of the gripper's opening are in the proportions of a UR5's."""
        grip, servo = self.grip or (None, None)
        every = [*self.servos, *([servo] if servo else [])]
        opening = grip.max_opening if grip else 0.0
        velocity = self.file.velocity or self.speeds or (_SPEED,)
        speed = each_of(velocity, self.dof, "robot.velocity")
        fingers = (opening,) if grip else ()

        def both(of_joints: Any, per_metre: float) -> tuple[float, ...]:
            return (*map(float, of_joints), *(per_metre * one for one in fingers))

        return Limits(
            names=(*(f"{name}.pos" for name in self.names), *(("gripper.pos",) if grip else ())),
            lower=both(self.lower, 0.0),
            upper=both(self.upper, 1.0),
            velocity=both(speed, 1.8),
            acceleration=both(acceleration, 24.0),
            jerk=both(10 * acceleration, 470.0),
            stop_deceleration=both(1.4 * acceleration, 47.0),
            stop_jerk=both(50 * acceleration, 2350.0),
            effort=tuple(one.effort for one in every),
            command_timeout_s=0.14,
        )

    def _workspace(self, kinematics: ArmKinematics) -> Workspace:
        """Return boxes before the arm: those of a UR5, as much smaller or larger as its reach is."""
        rng = np.random.default_rng(1)
        postures = rng.uniform(self.lower, self.upper, (_POSTURES, self.dof))
        tools = kinematics.tool(postures)
        free = (kinematics.check(postures) == int(ResultCode.SUCCEEDED)) & (tools[:, 2, 3] > 0)
        away = np.hypot(tools[:, 0, 3], tools[:, 1, 3])
        largest = float(np.quantile(away[free], 0.98)) if free.any() else kinematics.chain.reach
        low = free & (tools[:, 2, 3] < 0.4 * largest) & (tools[:, 2, 2] < -0.9)
        reach = float(np.quantile(away[low], 0.9)) if low.sum() > 10 else 0.7 * largest
        k = reach / _LIKE_UR5
        return Workspace(
            tool=((0.20 * k, -0.45 * k, 0.10 * k), (0.70 * k, 0.45 * k, 0.60 * k)),
            around_home=tuple(np.minimum(1.2, self.upper - self.lower).tolist()),
            table=((0.35 * k, -0.30 * k), (0.65 * k, 0.30 * k)),
            reach=reach,
        )

    def _with_handling(self, kinematics: ArmKinematics, workspace: Workspace, home: Array) -> Workspace:
        """Return the workspace with how things are taken from the table, and where on it that is possible."""
        chain, grip = kinematics.chain, self.grip
        if grip is None:
            return workspace
        tool = kinematics.tool(home)
        inverse = np.linalg.inv(chain.tool.matrix())
        below, ahead = 0.0, []
        for capsule in chain.capsules:
            if capsule.frame == chain.dof:
                ends = [inverse[:3, :3] @ np.array(end) + inverse[:3, 3] for end in (capsule.start, capsule.end)]
                below = max(below, *(float(end[2]) + capsule.radius for end in ends))
                ahead.append(min(float(end[2]) for end in ends))
        scale = min(grip[0].widest / _WIDEST_UR5, workspace.reach / _LIKE_UR5)
        usual = Handling()
        lowest = below + chain.min_distance + 0.005
        travel = lowest + scale * (usual.travel - usual.lowest)
        lift, k = _LIFT + 0.015, workspace.reach / _LIKE_UR5
        handling = Handling(
            scale=scale,
            finger=usual.finger * min(1.0, scale / 0.5),
            palm=min(usual.palm, -0.6 * min(ahead, default=-usual.palm)),
            lowest=lowest,
            travel=travel,
            lift=lift,
            neutral=float(np.arctan2(tool[1, 1], tool[0, 1]) - np.arctan2(tool[1, 3], tool[0, 3])),
            fixed=self._fixed_finger(),
            hand_over=(0.4 * k, -0.4 * k, 0.35 * k),
        )
        # The rectangle of a UR5's table, as large as the arm points down at all heights in its farther corners.
        reach = 0.0
        for away in np.linspace(0.3, 1.0, 29) * workspace.reach * 1.1:
            heights = (lowest, travel, lowest + 0.6 * 0.12 * scale + lift)
            found = [kinematics.solve(_down(away, z), home).code == ResultCode.SUCCEEDED for z in heights]
            reach = away if all(found) else reach
        k = float(reach or workspace.reach) / _CORNER_UR5
        return replace(
            workspace,
            table=((0.35 * k, -0.30 * k), (0.65 * k, 0.30 * k)),
            reach=float(1.1 * reach or workspace.reach),
            handling=handling,
        )

    def _fixed_finger(self) -> float | None:
        """Return where the finger that does not move is, along the tool's y axis [m]: the closed jaw lies on it."""
        assert self.grip is not None
        grip, model, data = self.grip[0], self.model, mujoco.MjData(self.model)
        if len(grip.joints) > 1:
            return None
        self._set(data, None)
        data.qpos[model.joint(grip.joints[0]).qposadr[0]] = grip.closed[0]
        mujoco.mj_kinematics(model, data)
        tool, jaw = data.site("tool"), int(model.joint(grip.joints[0]).bodyid[0])
        across, faces = tool.xmat.reshape(3, 3)[:, 1], []
        for geom in range(model.ngeom):
            if model.geom_bodyid[geom] == jaw and model.geom_contype[geom]:
                turn = data.geom_xmat[geom].reshape(3, 3)
                middle = data.geom_xpos[geom] + turn @ model.geom_aabb[geom, :3] - tool.xpos
                faces.append(float(across @ middle + np.abs(across @ turn) @ model.geom_aabb[geom, 3:]))
        return max(faces, default=0.0)

    def _choose_home(self, kinematics: ArmKinematics, workspace: Workspace) -> Array:
        """Return the file's home, unless nothing that tasks ask for is near to it, then one over the table's middle."""
        rng, (low, high) = np.random.default_rng(2), np.array(workspace.tool)
        around = np.array(workspace.around_home)

        def share(home: Array, kinematics: ArmKinematics = kinematics) -> float:
            postures = home + rng.uniform(-around, around, (_POSTURES // 4, self.dof))
            tools = kinematics.tool(postures)[:, :3, 3]
            inside = ((tools > low) & (tools < high)).all(axis=1)
            return float((kinematics.check(postures[inside]) == 0).sum() / len(postures)) if inside.any() else 0.0

        if self.home is not None:
            code = ResultCode(int(kinematics.check(self.home[None])[0]))
            if code == ResultCode.SUCCEEDED and share(self.home) > _LIKELY:
                return self.home
            if self.file.home:
                problem = kinematics.explain(self.home) or "hardly a place of its workspace is near to it"
                raise ConfigError(f"robot.home is {list(self.file.home)}: {problem} Give another posture.")
        postures = rng.uniform(self.lower, self.upper, (5 * _POSTURES, self.dof))
        tools = kinematics.tool(postures)
        inner = np.abs(tools[:, :3, 3] - (low + high) / 2) < (high - low) / 4
        postures, tools = postures[inner.all(axis=1)], tools[inner.all(axis=1)]
        codes = kinematics.check(postures)
        free = codes == int(ResultCode.SUCCEEDED)
        overlap = not free.any()  # capsules that do so in most postures; those that do so at home are left out
        if overlap:
            free = (codes == int(ResultCode.SELF_COLLISION)) & np.array(
                [not self._touches(one) for one in postures], bool
            )
        postures, tools = postures[free], tools[free]
        if not len(postures):
            raise ConfigError(
                f"No posture was found whose tool is within {low.round(3).tolist()} and {high.round(3).tolist()} m, "
                "before the arm. Give one with robot.home."
            )
        off = np.abs(postures - (self.lower + self.upper) / 2) / (self.upper - self.lower)
        order = np.argsort(tools[:, 2, 2] + off.max(axis=1) + np.abs(tools[:, 1, 3]) / (high - low)[1])
        if overlap:
            limits = self._limits(np.ones(self.dof))
            return max(
                (postures[one] for one in order[:12]), key=lambda q: share(q, ArmKinematics(self._chain(q), limits))
            )
        return max((postures[one] for one in order[:12]), key=share)


def _down(x: float, z: float) -> Array:
    """Return the pose of a tool that points down, before the base."""
    pose = np.diag((1.0, -1.0, -1.0, 1.0))
    pose[:3, 3] = x, 0.0, z
    return pose


def _own_servo(servo: Servo, inertia: float) -> Servo:
    """Return the servo of a joint that has none in the file: critically damped, and stiff enough to be felt blocked."""
    stiffness = max(inertia * _STIFF**2, 10 * servo.effort)
    return replace(servo, stiffness=stiffness, damping=servo.damping + 2 * float(np.sqrt(stiffness * inertia)))


def _lowest(model: Any, data: Any, geom: int) -> float:
    """Return the height of a geom's lowest point, of its box."""
    middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    turn = data.geom_xmat[geom].reshape(3, 3)
    return float(data.geom_xpos[geom, 2] + turn[2] @ middle - np.abs(turn[2]) @ half)
