"""What arms handle in n simulations, on their tables or in their arenas: objects, light and friction of each."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS, TableObject, TableScene
from bhd_lerobot.errors import SimulationError
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.table_stage import HANDLE_PARTS, PARKED, TABLE_TOP
from bhd_lerobot.sim.world import Ids, World

_TYPES = {name: int(getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")) for name in ("box", "capsule", "cylinder")}
_HIDDEN, _SEEN, _TOUCHED = 5, 1, 0  # geometry groups: the camera renders 0 and 1
_FIELDS = (
    *("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_group", "geom_rgba", "geom_friction"),
    *("body_mass", "body_inertia", "body_gravcomp", "body_pos", "body_quat"),
    *("pair_friction", "geom_aabb", "cam_pos", "cam_quat", "light_diffuse", "light_ambient", "light_dir"),
)
# The engine counts the bodies with a compensation that is not 0, and all simulations must have the same number.
_HEAVY = 1e-30
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_ALONG_X = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # turns z to x


class _Form(NamedTuple):
    """Kind, MuJoCo's size, and place in the body's frame of a geometry."""

    kind: str
    size: tuple[float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = _UPRIGHT


class Tabletop:
    """Lays the tables of a world's simulations, and states what lies where and what touches what.

    An arm on a base has stands in its arena in place of a table, which `World.place` puts there: objects are placed in
    the world frame then, and poses are those in the robot's frame, wherever it is.

    Flags and the tool's pose are of the last physics step's beginning, like every reading of a sensor; `World.forward`
    brings them up to date.

    Args:
        world: the simulations; their body is an arm.

    Raises:
        SimulationError: the body is no arm.
    """

    def __init__(self, world: World) -> None:
        if world.body.arm is None:
            raise SimulationError(f"A tabletop is for arms; {world.body.name!r} has none.")
        self.world, self.arm = world, world.body.arm
        model = world.model
        self._field = {name: world.model_field(name) for name in _FIELDS}
        self._bodies = np.array([model.body(f"object_{k}").id for k in range(MAX_OBJECTS)])
        self._geoms = [
            [
                model.geom(f"object_{k}{part}").id
                for part in ("", "_top", *(f"_handle_{j}" for j in range(HANDLE_PARTS)))
            ]
            for k in range(MAX_OBJECTS)
        ]
        self._pads = [model.geom(pad).id for pad in (self.arm.gripper.pads if self.arm.gripper else ())]
        self._pairs = [
            [i for i in range(model.npair) if self._geoms[k][0] in (model.pair_geom1[i], model.pair_geom2[i])]
            for k in range(MAX_OBJECTS)
        ]
        self._joints = world.joint_slice(self.arm.chain.joints)[0]
        self._fingers = world.joint_places(self.arm.gripper.joints)[0] if self.arm.gripper else []
        self._free = [int(model.joint(f"object_{k}").qposadr[0]) for k in range(MAX_OBJECTS)]
        self._free_values = np.add.outer(self._free, np.arange(7)).reshape(-1)
        self._target = model.body("target").id
        self._on_arm = [model.camera(name).id for name in world.body.cameras if name != "scene"]
        self._is_mobile = world.body.drive is not None
        if not self._is_mobile:
            self._scene, self._light = model.camera("scene").id, model.light("main").id
            self._top = model.geom(TABLE_TOP).id
            self._wood = model.mat_rgba[model.geom_matid[self._top], :3].copy()
        self._tool = world.site("tool")
        self._any = world.sensor("touch_any")[:, 0]
        self._table = world.sensor("touch_table")[:, 0]
        self._self = world.sensor("touch_self")[:, 0]
        first, last = (int(model.sensor(f"touch_object_{k}").adr[0]) for k in (0, MAX_OBJECTS - 1))
        self._grip = world.sensors(first, last + 1)
        self._ones = np.ones(MAX_OBJECTS)
        world.forward()

    # --- scenes ------------------------------------------------------------------------------------------------------

    def place(self, scenes: Sequence[TableScene], ids: Ids = None) -> None:
        """Start simulations anew: everything as the scene says, at rest, the servos holding the arm's posture.

        A base stays where it stands: `World.reset` puts it there before.

        Args:
            scenes: one for each simulation named.
            ids: the simulations, all if None.

        Raises:
            SimulationError: the number of scenes does not fit, or a posture does not fit the arm.
        """
        world = self.world
        ids = world.selected(ids)
        if len(scenes) != len(ids):
            raise SimulationError(f"{len(scenes)} scenes were given for {len(ids)} simulations.")
        for scene in scenes:
            if len(scene.posture) != len(self.arm.home) or not np.isfinite(scene.posture).all():
                raise SimulationError(
                    f"The posture of scene {scene.name!r} is {scene.posture}; it needs {len(self.arm.home)} numbers."
                )
        world.reset(ids, world.base_pose[ids] if self._is_mobile else None)
        for sim, scene in zip(ids, scenes, strict=True):
            self._surroundings(sim, scene)
            for number, thing in enumerate(scene.objects):
                self._object(sim, number, thing)
                for pair in self._pairs[number]:
                    self._field["pair_friction"][sim, pair, :2] = thing.friction * scene.variation.finger_friction
            for number in range(len(scene.objects), MAX_OBJECTS):
                self._field["geom_group"][sim, self._geoms[number]] = _HIDDEN
        world.update_constants(ids)
        for sim, scene in zip(ids, scenes, strict=True):
            dof = len(self.arm.chain.joints)
            world.qpos[sim, self._joints] = scene.posture[:dof]
            if self.arm.gripper is not None:
                world.qpos[sim, self._fingers] = self.arm.gripper.joints_at(scene.posture[dof])
            for number, thing in enumerate(scene.objects):
                turn = thing.yaw / 2
                at = self._free[number]
                world.qpos[sim, at : at + 3] = (thing.x, thing.y, scene.stand_m + thing.height / 2)
                world.qpos[sim, at + 3 : at + 7] = (math.cos(turn), 0.0, 0.0, math.sin(turn))
        world.hold(ids)

    def _surroundings(self, sim: int, scene: TableScene) -> None:
        """Set light, camera, the table's colour, pads and marker; of an arm on a base the last two."""
        field, model, variation = self._field, self.world.model, scene.variation
        field["geom_friction"][sim, self._pads] = model.geom_friction[self._pads]
        field["geom_friction"][sim, self._pads, 0] *= variation.finger_friction
        pose = (*PARKED[0], *_UPRIGHT) if scene.target_pose is None else scene.target_pose
        field["body_pos"][sim, self._target] = pose[:3]
        field["body_quat"][sim, self._target] = pose[3:]
        if self._is_mobile:
            return
        field["light_diffuse"][sim] = model.light_diffuse * variation.light
        field["light_ambient"][sim] = model.light_ambient * variation.light
        field["light_dir"][sim] = model.light_dir
        direction = model.light_dir[self._light] + (*variation.light_direction, 0.0)
        field["light_dir"][sim, self._light] = direction / math.hypot(*direction)
        field["cam_pos"][sim] = model.cam_pos
        field["cam_pos"][sim, self._scene] += variation.camera_shift
        field["cam_quat"][sim] = model.cam_quat
        turns = dict.fromkeys(self._on_arm, variation.wrist_turn) | {self._scene: variation.camera_turn}
        for camera, turn in turns.items():
            field["cam_quat"][sim, camera] = _turned(model.cam_quat[camera], turn)
        field["geom_rgba"][sim, self._top, :3] = np.clip(self._wood + variation.surface, 0.0, 1.0)

    def _object(self, sim: int, number: int, thing: TableObject) -> None:
        """Set shape, appearance, inertia and weight of an object."""
        field, body, geoms = self._field, self._bodies[number], self._geoms[number]
        field["geom_group"][sim, geoms] = _HIDDEN
        field["body_gravcomp"][sim, body] = _HEAVY
        colour = np.clip(np.add(COLOURS[thing.colour], thing.shade), 0.0, 1.0)
        a, b, h = thing.size_x, thing.size_y, thing.height / 2
        solid = _Form("box", (a, b, h)) if thing.kind == "box" else _Form("cylinder", (a, h, 0))
        self._geom(sim, geoms[0], solid, colour, group=_TOUCHED)
        field["geom_friction"][sim, geoms[0], 0] = thing.friction
        field["body_mass"][sim, body] = thing.mass
        if thing.kind == "box":
            squares = (b * b + h * h, a * a + h * h, a * a + b * b)
            field["body_inertia"][sim, body] = np.multiply(squares, thing.mass / 3)
        else:
            across = thing.mass * (3 * a * a + 4 * h * h) / 12
            field["body_inertia"][sim, body] = (across, across, thing.mass * a * a / 2)
        if thing.style == "plain":
            return
        if thing.style in ("marked", "other"):
            (self._marked if thing.style == "marked" else self._other)(sim, thing, geoms, colour)
            return
        if thing.kind == "box":
            x, y = (0.2 * a, b + 0.0003) if thing.style == "across" else (a + 0.0003, 0.2 * b)
            self._geom(sim, geoms[1], _Form("box", (x, y, h + 0.0003)), 0.55 + 0.45 * colour)
            return
        mouth = _Form("cylinder", (0.86 * a, 0.0004, 0), (0, 0, h))
        self._geom(sim, geoms[1], mouth, 0.22 * colour)
        thick, reach = 0.10 * a, 0.55 * a
        for geom, z in ((geoms[2], 0.5 * h), (geoms[3], -0.4 * h)):
            bar = _Form("capsule", (thick, reach / 2, 0), (a + reach / 2 - thick / 2, 0, z), _ALONG_X)
            self._geom(sim, geom, bar, colour)
        grip = _Form("capsule", (thick, 0.45 * h, 0), (a + reach - thick / 2, 0, 0.05 * h))
        self._geom(sim, geoms[4], grip, colour)

    def _marked(self, sim: int, thing: TableObject, geoms: list[int], colour: NDArray[np.float64]) -> None:
        """Add a stripe around an object, and a patch on its top."""
        a, b, h = thing.size_x, thing.size_y, thing.height / 2
        middle, broad, stripe, share, patch = thing.marks
        middle, broad = (2 * middle - 1) * h, broad * h
        for geom, across, thick, z, tint in (
            (geoms[1], (a + 0.0003, b + 0.0003), broad, middle, stripe),
            (geoms[2], (share * a, share * b), 0.0004, h, patch),
        ):
            size = (*across, thick) if thing.kind == "box" else (across[0], thick, 0.0)
            kind = "box" if thing.kind == "box" else "cylinder"
            self._geom(sim, geom, _Form(kind, size, (0, 0, z)), _tinted(colour, tint))

    def _other(self, sim: int, thing: TableObject, geoms: list[int], colour: NDArray[np.float64]) -> None:
        """Add a band across a box, or a lid with a knob to a cup."""
        a, b, h = thing.size_x, thing.size_y, thing.height / 2
        if thing.kind == "box":
            self._geom(sim, geoms[1], _Form("box", (0.25 * a, b + 0.0003, h + 0.0003)), 0.3 * colour)
            return
        self._geom(sim, geoms[1], _Form("cylinder", (1.06 * a, 0.003, 0), (0, 0, h - 0.002)), 0.4 + 0.6 * colour)
        self._geom(sim, geoms[2], _Form("capsule", (0.15 * a, 0.004, 0), (0, 0, h + 0.004)), 0.3 * colour)

    def _geom(self, sim: int, geom: int, form: _Form, colour: NDArray[np.float64], *, group: int = _SEEN) -> None:
        field, (radius, half, _) = self._field, form.size
        length = half + (radius if form.kind == "capsule" else 0.0)
        box = form.size if form.kind == "box" else (radius, radius, length)
        field["geom_type"][sim, geom] = _TYPES[form.kind]
        field["geom_size"][sim, geom] = form.size
        field["geom_pos"][sim, geom] = form.position
        field["geom_quat"][sim, geom] = form.quaternion
        bound = {"box": math.hypot(*box), "cylinder": math.hypot(radius, half), "capsule": radius + half}
        field["geom_rbound"][sim, geom] = bound[form.kind]
        field["geom_aabb"][sim, geom, 3:] = box
        field["geom_rgba"][sim, geom, :3] = colour
        field["geom_rgba"][sim, geom, 3] = 1.0
        field["geom_group"][sim, geom] = group

    # --- ground truth ------------------------------------------------------------------------------------------------

    @property
    def object_poses(self) -> NDArray[np.float64]:
        """Position [m] and quaternion w, x, y, z of each object's centre in the base frame, a copy.

        Shape (n, MAX_OBJECTS, 7). An absent object is at the origin, upright.
        """
        poses = self._in_base(self.world.qpos[:, self._free_values].reshape(self.world.n, MAX_OBJECTS, 7))
        poses[self._field["body_gravcomp"][:, self._bodies] > _HEAVY] = (0.0, 0.0, 0.0, *_UPRIGHT)
        return poses

    @property
    def tool_pose(self) -> NDArray[np.float64]:
        """Position [m] and quaternion w, x, y, z of the tool in the base frame, shape (n, 7), a copy."""
        return self._in_base(np.concatenate([self._tool.position, self._tool.quaternion], axis=1)[:, None])[:, 0]

    def _in_base(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return poses of the world frame, shape (n, k, 7), in the base frames: a base turns, and its arm with it."""
        if not self._is_mobile:
            return poses
        base = self.world.base_pose
        cos, sin = np.cos(base[:, None, 2]), np.sin(base[:, None, 2])
        dx, dy = poses[:, :, 0] - base[:, None, 0], poses[:, :, 1] - base[:, None, 1]
        c, s = np.cos(base[:, None, 2] / 2), np.sin(base[:, None, 2] / 2)
        w, x, y, z = poses[:, :, 3:].transpose(2, 0, 1)
        places = cos * dx + sin * dy, cos * dy - sin * dx, poses[:, :, 2]
        return np.stack([*places, c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w], axis=2)

    @property
    def is_touching_more(self) -> bool:
        """Whether any arm touches more than objects with its gripper; if not, no other flag below is set."""
        return bool(np.count_nonzero(self._any) and np.count_nonzero(self._any - self._grip @ self._ones))

    @property
    def arm_on_table(self) -> NDArray[np.bool_]:
        """Whether any part of the arm or its gripper touches the table, shape (n,)."""
        return self._table > 0

    @property
    def self_contact(self) -> NDArray[np.bool_]:
        """Whether the arm touches itself, shape (n,); the two fingers may touch each other."""
        return self._self > 0

    @property
    def finger_on_object(self) -> NDArray[np.bool_]:
        """Whether the gripper, its fingers or its palm, touches each object, shape (n, MAX_OBJECTS)."""
        return self._grip > 0

    @property
    def arm_on_object(self) -> NDArray[np.bool_]:
        """Whether a link of the arm other than the gripper touches an object, shape (n,)."""
        # Whatever the arm touches is the table, itself or an object. The counts are whole numbers: their sum is exact.
        return self._any > self._table + self._self + self._grip.sum(axis=1)


def _tinted(colour: NDArray[np.float64], tint: float) -> NDArray[np.float64]:
    """Return a lighter or darker colour; at 1 white, at -1 a fifth as bright."""
    return colour + tint * (1 - colour) if tint > 0 else colour * (1 + 0.8 * tint)


def _turned(quaternion: NDArray[np.float64], turn: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return an orientation wxyz, turned in its own frame by a rotation vector [rad]."""
    angle = math.hypot(*turn)
    if angle == 0.0:
        return quaternion
    by = np.array([math.cos(angle / 2), *(math.sin(angle / 2) / angle * part for part in turn)])
    result = np.empty(4)
    mujoco.mju_mulQuat(result, quaternion, by)
    return result
