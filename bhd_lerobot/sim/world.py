"""n simulations of one model, stepped together."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Shape
from bhd_lerobot.errors import SimulationError, unknown_name
from bhd_lerobot.sim.efforts import MeanEfforts
from bhd_lerobot.sim.engine import mujoco, mujoco_batch
from bhd_lerobot.sim.scene import PARKED_GROUP, PARKED_Z, POOL_SIZE, build_model, shape_fields


def rays_in_world(
    poses: NDArray[np.float64], offset: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the origins and directions of rays in the world frame, each of shape (k, rays, 3) or to be spread to it.

    Args:
        poses: position [m] and unit quaternion w, x, y, z of the body that carries the sensor, shape (k, 7 or more).
        offset: where the rays start in that body's frame [m], shape (3,).
        directions: unit vectors in that body's frame, shape (rays, 3).
    """
    rotation = _rotation_matrices(poses[:, 3:7])
    # Sums written out: a matrix product may round differently for different numbers of simulations.
    origin = poses[:, None, 0:3] + (
        rotation[:, None, :, 0] * offset[0] + rotation[:, None, :, 1] * offset[1] + rotation[:, None, :, 2] * offset[2]
    )
    heading = (
        rotation[:, None, :, 0] * directions[None, :, 0:1]
        + rotation[:, None, :, 1] * directions[None, :, 1:2]
        + rotation[:, None, :, 2] * directions[None, :, 2:3]
    )
    return origin, heading


def _rotation_matrices(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices of unit quaternions wxyz: shape (k, 4) gives (k, 3, 3)."""
    w, x, y, z = quaternions.T
    matrix = np.empty((len(quaternions), 3, 3))
    matrix[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrix[:, 0, 1] = 2 * (x * y - w * z)
    matrix[:, 0, 2] = 2 * (x * z + w * y)
    matrix[:, 1, 0] = 2 * (x * y + w * z)
    matrix[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrix[:, 1, 2] = 2 * (y * z - w * x)
    matrix[:, 2, 0] = 2 * (x * z - w * y)
    matrix[:, 2, 1] = 2 * (y * z + w * x)
    matrix[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return matrix


# Sorted and without repetition, or a mask of shape (n,); all if None.
Ids = NDArray[np.intp] | NDArray[np.bool_] | Sequence[int] | None

# Only the obstacles, which are in group 0: a range finder does not see the robot that carries it.
_SCENE_GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
_POOL_FIELDS = ("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_group")
_DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{field}")) for field in ("QPOS", "QVEL", "QACC")]
_WARNING_COUNT = 1  # the last axis of Batch.warning: last info, count


@dataclass(frozen=True)
class Snapshot:
    """Everything that decides how simulations continue: restoring it continues bit-exactly.

    Attributes:
        state: MuJoCo's integration state, shape (k, nstate).
        fields: the per-simulation model fields, each of shape (k, ...).
        constants: whether `World.update_constants` was in use: what derives from the fields is then computed again.
    """

    state: NDArray[np.float64]
    fields: dict[str, NDArray]
    constants: bool = False


@dataclass(frozen=True)
class Site:
    """A site of n simulations.

    MuJoCo has a field with the quaternions of sites since version 4 only.

    Attributes:
        position: live positions in the world frame [m], shape (n, 3).
    """

    position: NDArray[np.float64]
    _body_quaternion: NDArray[np.float64]
    _in_body: NDArray[np.float64]

    @property
    def quaternion(self) -> NDArray[np.float64]:
        """Quaternions w, x, y, z in the world frame, shape (n, 4), a copy."""
        result = self._body_quaternion.copy()
        if self._in_body[0] != 1.0:
            for quaternion in result:
                mujoco.mju_mulQuat(quaternion, quaternion.copy(), self._in_body)
        return result


class World:
    """n simulations of one body in its scene.

    Arrays carry the simulation axis first. `qpos`, `qvel`, `ctrl` and `time` are live views of the simulations' states:
    they change with `step`, and what is written to them is the state at the next step. Results do not depend on the
    number of threads, nor on how many other simulations there are.

    Attributes:
        outputs: the fields that derive from the state and are copied out after every step, by name, each of shape
            (n, ...).
        fields: the model fields of which each simulation has its own values, by name, live, each of shape (n, ...).
        threads: threads that step the simulations.

    Args:
        body: the robot.
        n: number of simulations.
        physics_hz: physics steps a second [Hz]; the body's default if None.
        threads: threads that step the simulations; as many as there are processors, and at most n, if None.
        pool_size: number of obstacles that one simulation of a base can have at the most; an arm without a base has a
            table instead, which `Tabletop` lays.
        fixtures: what stands immovable on an arm's table, in every simulation; none for a base. Sensor
            ``force_fixture_<k>`` is the force that the k-th puts on the arm, in the base frame [N].
    """

    def __init__(
        self,
        body: Body,
        n: int = 1,
        *,
        physics_hz: int | None = None,
        threads: int | None = None,
        pool_size: int = POOL_SIZE,
        fixtures: Sequence[Shape] = (),
    ) -> None:
        if n < 1:
            raise SimulationError(f"A world needs at least one simulation, got n = {n}.")
        if fixtures and (body.arm is None or body.drive is not None):
            raise SimulationError(f"Fixtures stand on an arm's table; {body.name!r} has none.")
        self.body = body
        self.n = n
        self.physics_hz = physics_hz or body.physics_hz
        self.pool_size = pool_size = pool_size if body.drive else 0
        self.model = build_model(body, self.physics_hz, pool_size, fixtures)
        # One simulation is stepped by the calling thread; more threads would only add hand-overs.
        self.threads = min(n, threads or os.cpu_count() or 1)
        self._batch = mujoco_batch.Batch(self.model, n, nthread=1 if n == 1 else threads or 0)
        self.outputs: dict[str, NDArray] = {}
        self.qpos: NDArray[np.float64] = self._batch.bind("qpos")
        self.qvel: NDArray[np.float64] = self._batch.bind("qvel")
        self.ctrl: NDArray[np.float64] = self._batch.bind("ctrl")
        self.time: NDArray[np.float64] = self._batch.bind("time")
        self._sensordata: NDArray[np.float64] = self._output("sensordata")
        self._warnings = self._batch.warning[:, :, _WARNING_COUNT]
        self._root = self.model.body(body.root).id
        self._pool = slice(
            self.model.geom("obstacle_000").id if pool_size else 0,
            (self.model.geom("obstacle_000").id if pool_size else 0) + pool_size,
        )
        self.fields: dict[str, NDArray] = {}
        self._efforts: MeanEfforts | None = None
        self._constants = False
        if pool_size:
            for name in _POOL_FIELDS:
                self.model_field(name)
        self._all = np.arange(n)
        self._offsets: dict[str, NDArray[np.float64]] = {}  # of sites that rays start from, in the root body's frame
        self.reset()

    # --- state -------------------------------------------------------------------------------------------------------

    def reset(self, ids: Ids = None, poses: NDArray[np.float64] | None = None) -> None:
        """Put simulations back to the model's initial state, at rest: an arm at home, with nothing to handle.

        Args:
            ids: the simulations, all if None.
            poses: x [m], y [m] and yaw [rad] of a base's root body in the world frame, shape (len(ids), 3); the origin
                if None.

        Raises:
            SimulationError: the poses do not fit, or the body is no base and there are poses.
        """
        ids = self.selected(ids)
        has_arm = self.body.arm is not None
        if "body_gravcomp" in self.fields:  # what is taken off the table is without weight, or it would fall for ever
            self.fields["body_gravcomp"][ids] = self._model_value("body_gravcomp")
        self._batch.reset(ids, stage=0, **({"keyframe": 0} if has_arm else {}))
        if poses is not None:
            self._need_base("Start poses")
            poses = np.asarray(poses, dtype=np.float64)
            if poses.shape != (len(ids), 3) or not np.isfinite(poses).all():
                raise SimulationError(
                    f"Start poses must be {len(ids)} finite rows of x, y, yaw; got shape {poses.shape}."
                )
            self.qpos[ids, 0:2] = poses[:, 0:2]
            self.qpos[ids, 3] = np.cos(poses[:, 2] / 2)
            self.qpos[ids, 6] = np.sin(poses[:, 2] / 2)
        if has_arm:
            self.hold(ids)
        else:
            self.forward(ids)

    def hold(self, ids: Ids = None) -> None:
        """Command an arm's servos to hold its present posture, and compute what derives from the state.

        A servo for torque is commanded the torque that the posture needs without a payload.

        Raises:
            SimulationError: the body is no arm.
        """
        ids = self.selected(ids)
        if (arm := self.body.arm) is None:
            raise SimulationError(f"hold() is for arms; {self.body.name!r} has none.")
        joints = len(arm.chain.joints)
        first = self.model.actuator(arm.actuators[0]).id
        servos, (places, dofs) = slice(first, first + joints), self.joint_slice(arm.chain.joints)
        self.ctrl[ids, servos] = self.qpos[ids, places] if arm.actuation == "position" else 0.0
        if arm.gripper is not None:
            fingers = zip(self.joint_places(arm.gripper.joints)[0], arm.gripper.per_joint, strict=True)
            openings = [self.qpos[ids, place] * one for place, one in fingers]
            self.ctrl[ids, first + joints] = sum(openings[1:], openings[0]) + arm.gripper.offset
        if arm.actuation == "torque":
            bias = self.derived("qfrc_bias")
            self.forward(ids)
            self.ctrl[ids, servos] = bias[ids, dofs]
        self.forward(ids)

    def step(self, k: int = 1, ids: Ids = None, *, each: Callable[[], None] | None = None) -> None:
        """Advance simulations by k physics steps.

        Args:
            k: number of steps.
            ids: the simulations, all if None.
            each: called after each step.

        Raises:
            SimulationError: MuJoCo could not step a simulation. That the physics diverged is reported by `check`.
        """
        ids = None if ids is None else self.selected(ids)
        calls = 1 if self._efforts is None and each is None else k
        try:
            for call in range(calls):
                self._batch.step(ids, nstep=k // calls)
                if self._efforts is not None:
                    self._efforts.note(slice(None) if ids is None else ids, call, calls)
                if each is not None:
                    each()
        except mujoco_batch.SimulationError as error:
            raise SimulationError(f"{error}. The simulations named kept the state they had before the step.") from error

    def forward(self, ids: Ids = None) -> None:
        """Compute everything that derives from the state, without advancing time: sensors for example."""
        ids = None if ids is None else self.selected(ids)
        self._batch.forward(ids)
        if self._efforts is not None:
            self._efforts.forward(slice(None) if ids is None else ids)

    def check(self) -> None:
        """Raise if the physics of any simulation diverged since its last reset.

        Raises:
            SimulationError: names the simulations.
        """
        # The engine resets a simulation that diverged, so that its state looks healthy: its warning count shows it.
        if not np.count_nonzero(self._warnings) and np.isfinite(self.qpos).all():
            return
        diverged = self._batch.warning[:, _DIVERGED, _WARNING_COUNT].any(axis=1)
        diverged |= ~np.isfinite(self.qpos).all(axis=1)
        if diverged.any():
            raise SimulationError(
                f"The physics of simulation(s) {np.flatnonzero(diverged).tolist()} diverged. "
                "Lower the time step (a higher physics_hz) or the forces that act on the robot."
            )

    def snapshot(self, ids: Ids = None) -> Snapshot:
        """Return a copy of everything that decides how simulations continue."""
        ids = self.selected(ids)
        fields = {name: values[ids].copy() for name, values in self.fields.items()}
        return Snapshot(self._batch.state[ids].copy(), fields, self._constants)

    def restore(self, snapshot: Snapshot, ids: Ids = None) -> None:
        """Continue from a snapshot, bit-exactly. Sensors read what they read in the restored state.

        Args:
            snapshot: one row for each simulation restored, in their order.
            ids: the simulations, all if None.

        Raises:
            SimulationError: the snapshot is of another model or of another number of simulations.
        """
        ids = self.selected(ids)
        expected = (len(ids), self._batch.state.shape[1])
        if snapshot.state.shape != expected:
            raise SimulationError(f"The snapshot's state has shape {snapshot.state.shape}; {expected} is needed.")
        for name, values in snapshot.fields.items():
            self.model_field(name)[ids] = values
        for name in self.fields.keys() - snapshot.fields.keys():  # fields that were the model's own at that time
            self.fields[name][ids] = self._model_value(name)
        if snapshot.constants or self._constants:
            self.update_constants(ids)
        self._batch.state[ids] = snapshot.state
        self.forward(ids)

    @property
    def base_pose(self) -> NDArray[np.float64]:
        """Ground truth: x [m], y [m] and yaw [rad] of a base's root body in the world frame, shape (n, 3), a copy.

        Raises:
            SimulationError: the body is no base.
        """
        self._need_base("A base pose")
        q = self.qpos
        w, x, y, z = q[:, 3], q[:, 4], q[:, 5], q[:, 6]
        pose = np.empty((self.n, 3))
        pose[:, 0:2] = q[:, 0:2]
        pose[:, 2] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return pose

    # --- sensors -----------------------------------------------------------------------------------------------------

    def sensor(self, name: str) -> NDArray[np.float64]:
        """Return the live readings of a named sensor, shape (n, dim), as of the last physics step.

        Raises:
            SimulationError: there is no such sensor; the message lists the valid names.
        """
        try:
            sensor = self.model.sensor(name)
        except KeyError:
            names = [self.model.sensor(i).name for i in range(self.model.nsensor)]
            raise SimulationError(unknown_name("sensor", name, names)) from None
        return self.sensors(sensor.adr[0], sensor.adr[0] + sensor.dim[0])

    def sensors(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return the live readings of neighbouring sensors by their addresses, shape (n, stop - start)."""
        view = self._sensordata[:, start:stop]
        view.flags.writeable = False
        return view

    def derived(self, name: str) -> NDArray[np.float64]:
        """Return a live field of `mujoco.MjData` that derives from the state, shape (n, ...), as of the last step.

        It is computed from now on: it is valid after the next `step`, `forward`, `reset` or `restore`.

        Args:
            name: the field, for example ``"qfrc_actuator"``.

        Raises:
            SimulationError: there is no such field.
        """
        if name not in mujoco_batch.DATA_FIELDS:
            raise SimulationError(unknown_name("field", name, mujoco_batch.DATA_FIELDS))
        return self._output(name)

    def _output(self, name: str) -> NDArray[np.float64]:
        """Return a live field that derives from the state, which is copied out after every step from now on."""
        field = self._batch.bind(name)
        if not np.may_share_memory(field, self._batch.state):
            self.outputs[name] = field
        return field

    @property
    def efforts(self) -> NDArray[np.float64]:
        """What actuators put on the joints, averaged over the last `step`, shape (n, nv), live [N m; N for a slide].

        Computed from now on. After a single step, at the body's own physics rate or a higher one, it is what MuJoCo
        reports, `qfrc_actuator`; otherwise it is what acted: see `MeanEfforts`.
        """
        return self.servos.mean

    @property
    def servos(self) -> MeanEfforts:
        """What averages the efforts of the actuators."""
        if self._efforts is None:
            slow = self.physics_hz < self.body.physics_hz
            self._efforts = MeanEfforts(self.model, self._output, exact=slow)
        return self._efforts

    def site(self, name: str) -> "Site":
        """Return a named site, whose pose is valid like a `derived` field.

        Raises:
            SimulationError: there is no such site; the message lists the valid names.
        """
        number = self._site_number(name)
        orientations = self.derived("xquat")[:, self.model.site_bodyid[number]]
        return Site(self.derived("site_xpos")[:, number], orientations, self.model.site_quat[number].copy())

    def _site_number(self, name: str) -> int:
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name)
        if number < 0:
            names = [self.model.site(i).name for i in range(self.model.nsite)]
            raise SimulationError(unknown_name("site", name, names))
        return int(number)

    def joint_places(self, names: Sequence[str]) -> tuple[list[int], list[int]]:
        """Return where named one-dimensional joints lie in `qpos` and `qvel`."""
        joints = [self.model.joint(name) for name in names]
        return [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]

    def joint_slice(self, names: Sequence[str]) -> tuple[slice, slice]:
        """Return where the named one-dimensional joints lie in `qpos` and `qvel`; they must be neighbours, in order."""
        valid = [self.model.joint(i).name for i in range(self.model.njnt)]
        for name in names:
            if name not in valid:
                raise SimulationError(unknown_name("joint", name, valid))
        joints = [self.model.joint(name) for name in names]
        q, v = int(joints[0].qposadr[0]), int(joints[0].dofadr[0])
        for offset, joint in enumerate(joints):
            if joint.qposadr[0] != q + offset or joint.dofadr[0] != v + offset:
                raise SimulationError(f"Joints {list(names)} are not neighbours in the model of {self.body.name!r}.")
        return slice(q, q + len(names)), slice(v, v + len(names))

    def rays(
        self, site: str, directions: NDArray[np.float64], ids: Ids = None
    ) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Cast rays from a site against the scene.

        Args:
            site: the site the rays start from; it is fixed to the root body or to a body welded to it.
            directions: unit vectors in the root body's frame, shape (rays, 3).
            ids: the simulations, all if None.

        Returns:
            Distances [m], shape (len(ids), rays), infinity where nothing is hit, and the simulations' ids.

        Raises:
            SimulationError: the body is no base, or there is no such site.
        """
        self._need_base("A ray from the root body")
        ids = self.selected(ids)
        if site not in self._offsets:
            self._offsets[site] = self._site_in_root(site)
        origin, heading = rays_in_world(self.qpos[ids], self._offsets[site], directions)
        distance, _ = self._batch.ray(origin, heading, geomgroup=_SCENE_GROUPS, bodyexclude=self._root, ids=ids)
        return np.where(distance < 0, np.inf, distance), ids

    def _site_in_root(self, site: str) -> NDArray[np.float64]:
        number = self._site_number(site)
        offset = self.model.site_pos[number].copy()
        body = int(self.model.site_bodyid[number])
        while body != self._root:
            if self.model.body_jntnum[body] or body == 0 or self.model.body_quat[body, 0] != 1.0:
                raise SimulationError(f"Site {site!r} is not fixed to body {self.body.root!r} without a rotation.")
            offset += self.model.body_pos[body]
            body = int(self.model.body_parentid[body])
        return offset

    # --- scene and randomisation -------------------------------------------------------------------------------------

    def place(self, shapes: Sequence[Sequence[Shape]], ids: Ids = None) -> None:
        """Give simulations their obstacles, in place of those they had.

        Args:
            shapes: the obstacles of each simulation.
            ids: the simulations, all if None.

        Raises:
            SimulationError: a simulation would have more obstacles than the pool holds, or the body is no base.
        """
        self._need_base("An obstacle")
        ids = self.selected(ids)
        if len(shapes) != len(ids):
            raise SimulationError(f"{len(shapes)} scenes were given for {len(ids)} simulations.")
        kind, size, pos, quat, radius, group = (self.model_field(name) for name in _POOL_FIELDS)
        first = self._pool.start
        for sim, scene in zip(ids, shapes, strict=True):
            if len(scene) > self.pool_size:
                raise SimulationError(
                    f"The scene has {len(scene)} obstacles; this world holds {self.pool_size}. "
                    "Make the World with a larger pool_size."
                )
            pos[sim, self._pool] = (0.0, 0.0, PARKED_Z)
            group[sim, self._pool] = PARKED_GROUP
            for index, shape in enumerate(scene):
                geom = first + index
                group[sim, geom] = 0
                kind[sim, geom], size[sim, geom], pos[sim, geom], quat[sim, geom], radius[sim, geom] = shape_fields(
                    shape
                )

    def model_field(self, name: str) -> NDArray:
        """Return a model field with a value for each simulation, live, shape (n, ...), for domain randomisation.

        Args:
            name: a field of `mujoco.MjModel`, for example ``"geom_friction"``, or ``"opt.gravity"``. After a write to a
                field from which MuJoCo derives others (masses for example), call `update_constants`.

        Raises:
            SimulationError: there is no such field.
        """
        if name not in self.fields:
            if name not in mujoco_batch.MODEL_FIELDS:
                raise SimulationError(unknown_name("model field", name, mujoco_batch.MODEL_FIELDS))
            self.fields[name] = self._batch.expand(name)
        return self.fields[name]

    def update_constants(self, ids: Ids = None) -> None:
        """Recompute what MuJoCo derives from the model fields."""
        self._constants = True
        self._batch.set_const(None if ids is None else self.selected(ids))

    @cached_property
    def one(self) -> mujoco.MjData:
        """Data of a single simulation, for the types and sizes of its fields."""
        return mujoco.MjData(self.model)

    @property
    def state(self) -> NDArray[np.float64]:
        """MuJoCo's integration states, live, shape (n, nstate)."""
        return self._batch.state

    @property
    def warnings(self) -> NDArray[np.int32]:
        """Last information, of `step` alone, and number of MuJoCo's warnings since the reset, live, (n, kinds, 2)."""
        return self._batch.warning

    def copy_model(self, sim: int, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """Return a copy of one simulation's model, with its own values of the per-simulation fields.

        Args:
            sim: the simulation.
            model: where it goes, a result of this method; a new one if None.
        """
        return self._batch.get_model(sim, model)

    def copy_into(self, sim: int, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Copy one simulation's model fields and state; nothing that derives from the state is computed.

        Args:
            sim: the simulation.
            model: where the model goes: a result of `copy_model`.
            data: where the state goes.
        """
        self._batch.get_model(sim, model)
        self._batch.get_data(sim, data)

    def _model_value(self, name: str) -> NDArray:
        """Return the model's own value of a field, which simulations have until they get another."""
        owner = self.model.opt if name.startswith("opt.") else self.model
        return np.asarray(getattr(owner, name.removeprefix("opt.")))

    def _need_base(self, what: str) -> None:
        if self.body.drive is None:
            raise SimulationError(f"{what} is for mobile bases; {self.body.name!r} has no drive.")

    def selected(self, ids: Ids) -> NDArray[np.intp]:
        """Return the numbers of the simulations that `ids` names."""
        if ids is None:
            return self._all
        ids = np.asarray(ids)
        if ids.dtype == np.bool_:
            if ids.shape != (self.n,):
                raise SimulationError(f"A mask of simulations has shape ({self.n},), got {ids.shape}.")
            return np.flatnonzero(ids)
        return ids.astype(np.intp, copy=False)
