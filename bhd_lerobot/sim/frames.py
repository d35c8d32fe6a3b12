"""Whole frames of simulated robots in machine code: ticks of their control and physics steps, without Python between.

The results are those of `Cerebellum.tick` and `World.step` in turns, bit for bit.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import cache, partial
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Drive
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.kernels import is_worth_compiling, kernel, record
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.record import JOINTS
from bhd_lerobot.control.tick import tick_robot, tick_springs
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.plant import Brakes, run_brake, set_brake
from bhd_lerobot.sim.world import World

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_LEFT_OUT = ("read", "write", "set_mode", "step", "tick")  # methods that frames in machine code do not call
_NO_RING: NDArray[np.float64] = np.zeros((0, 1, 1))
_SHARES = 4  # of the simulations for each thread: what one waits for is done while others go on
_OUTPUTS = 16  # fields that may be read after a frame
Counts = NDArray[np.int64]
Numbers = NDArray[np.float64]

LAYOUT = record(
    "layout",
    [
        ("joints", np.int64),
        ("substeps", np.int64),
        # Places of the joints in qpos and qvel, and of the actuators in ctrl.
        ("qpos", np.int64, (JOINTS,)),
        ("qvel", np.int64, (JOINTS,)),
        ("ctrl", np.int64, (JOINTS,)),
        # Of a gripper, whose opening grows with one or two joints: the second one's place, -1 if there is none.
        ("qpos_beside", np.int64),
        ("qvel_beside", np.int64),
        ("gripper", np.int64),  # which of the joints it is; -1 if there is none
        ("per_joint", np.float64, (2,)),  # by how much it opens with each [m/m or m/rad]
        ("offset", np.float64),  # the opening where they are at 0 [m]
        # Places of the readings that count touches: of a base, -1 if there is none; of an arm, -1 if there is none, of
        # the table, of itself, and of the gripper's.
        ("touch_base", np.int64),
        ("touch", np.int64),
        ("touch_table", np.int64),
        ("touch_self", np.int64),
        ("touch_grip", np.int64, (2,)),  # the first, and how many
        ("gyro", np.int64),  # and of the gyroscope's; -1 if it is not read
        ("beams", np.int64),  # sensors before the gyroscope's
        # The servos' damping, see `MeanEfforts`.
        ("is_exact", np.bool_),  # what acted is averaged, not what MuJoCo reports
        ("gear", np.float64, (JOINTS,)),
        ("damping", np.float64, (JOINTS,)),
        ("most_force", np.float64, (JOINTS,)),
        ("most_torque", np.float64, (JOINTS,)),
        ("brake", np.int64),  # the first joint's, see `Brakes`
        ("friction", np.float64, (JOINTS,)),
        ("closing_ticks", np.int64),
        # What is copied out after a frame: from where, to where, and how many bytes of each simulation.
        ("outputs", np.int64),
        ("source", np.int64, (_OUTPUTS,)),
        ("target", np.int64, (_OUTPUTS,)),
        ("nbytes", np.int64, (_OUTPUTS,)),
    ],
)


def _missing(*_: Any) -> Any:
    raise AssertionError("Frames are compiled.")


# Functions of the C library, as machine code calls them; `_load` puts them here.
_step: Any = _missing
_set_state: Any = _missing
_get_state: Any = _missing
_copy: Any = _missing


@cache
def _load() -> bool:
    """Find the C library's functions; return whether there are any that machine code can call."""
    global _step, _set_state, _get_state, _copy
    ending = f"{mujoco.__version__}.dylib" if sys.platform == "darwin" else f"so.{mujoco.__version__}"
    file = Path(mujoco.__file__).parent / f"libmujoco.{ending}"
    if not file.exists():
        return False
    from llvmlite import binding
    from numba import types

    library, libc = ctypes.CDLL(str(file)), ctypes.CDLL(None)
    address, number, nothing = types.intp, types.int32, types.void
    functions = {
        "mj_step": (library, nothing(address, address)),
        "mj_setState": (library, nothing(address, address, address, number)),
        "mj_getState": (library, nothing(address, address, address, number)),
        "memcpy": (libc, address(address, address, address)),
    }
    external = []
    for name, (owner, signature) in functions.items():
        pointer = ctypes.cast(getattr(owner, name), ctypes.c_void_p).value
        binding.add_symbol(name, pointer)  # machine code from the cache finds it again by its name
        external.append(types.ExternalFunction(name, signature))
    _step, _set_state, _get_state, _copy = external
    return True


@kernel()
def run_frames(  # noqa: PLR0912, PLR0915, PLR0917
    ids: Counts,
    models: Counts,
    data: int,
    rows: int,
    row_bytes: int,
    qpos: Numbers,
    qvel: Numbers,
    ctrl: Numbers,
    sensordata: Numbers,
    torque: Numbers,
    force: Numbers,
    speed: Numbers,
    warnings: NDArray[np.int32],
    all_warnings: NDArray[np.int32],
    states: Any,
    queues: Any,
    estop: Counts,
    monitors: Any,
    limits: Any,
    sensors: Numbers,
    sensors_ns: Counts,
    touches: NDArray[np.bool_],
    efforts: Numbers,
    layouts: Any,
    seen: Any,
    done: Counts,
    times: Counts,
    spec: int,
    arms: Any,
    springs: Any,
    brakes: Any,
    arm_limits: Any,
    geometries: Any,
    ring: Any,
    latency: Any,
    waited: Any,
    written: int,
    trajectories: Any,
) -> None:
    """Let some ticks of some simulations go by, one simulation after the other.

    One whose tick waits for its controller is left there, and goes on at the next call.

    Args:
        ids: the simulations.
        models: the address of each simulation's model.
        data: the address of the data that they run in, whose fields the arrays after `row_bytes` are.
        rows: the address of the first simulation's state; `row_bytes` from one to the next.
        all_warnings: number of warnings of each simulation, as `Batch.warning`.
        touches: becomes True where something was touched, shape (kinds, n): by an arm the table, objects with one of
            its links, itself; then by a base the scene.
        efforts: mean efforts of the last tick, shape (n, nv).
        seen: becomes what is read of the joints after the last tick, as records of robots, shape (n,).
        done: how many of these ticks each simulation has done, shape (n,).
        times: what the ticks are for [ns], shape (ticks,).
        spec: what a state consists of, `mjSTATE_INTEGRATION` of this version of MuJoCo.
        monitors: records of the collision monitors of bases; None of robots that do not drive.
        arms: records of arms with position servos; None of others, as is what follows of those without an arm.
        springs: records of the impedances of arms with torque motors; None of others, as is the following.
        brakes: for how many ticks the arms' brakes are closed, shape (n,).
        ring: the last commands, of servos that get them late, shape (ticks, n, actuators); empty if none is late.
        latency: by how many ticks they are late, shape (n,).
        waited: ticks since that was set, shape (n,).
        written: commands that were written to the ring.
        trajectories: what arms play.
    """
    layout = layouts[0]
    joints = layout.joints
    for sim in ids:
        state = states[sim]
        _set_state(models[sim], data, rows + sim * row_bytes, spec)
        warnings[:] = 0
        for number in range(done[sim], len(times)):
            now_ns = times[number]
            is_begun = False
            if arms is not None:
                is_begun = arms[sim].stage != 0
            if not is_begun:
                read_joints(state, layout, qpos, qvel, efforts[sim], now_ns)
            if not tick_robot(
                sim,
                states,
                queues,
                estop,
                monitors,
                arms,
                springs,
                limits,
                arm_limits,
                geometries,
                sensors,
                sensors_ns,
                trajectories,
                now_ns,
            ):
                break
            if springs is not None:
                closing = ctrl[layout.brake : layout.brake + arm_limits[0].dof]
                if state.mode_is_new:
                    set_brake(brakes, sim, state.mode)
                    state.mode_is_new = False
                speeds = qvel[layout.qvel[0] : layout.qvel[0] + arm_limits[0].dof]
                run_brake(brakes, closing, speeds, sim, layout.friction, layout.closing_ticks)
            if ring is None:
                for k in range(joints):
                    ctrl[layout.ctrl[k]] = state.written[k]
            if ring is not None:
                slot = written + number
                behind = slot - min(latency[sim], waited[sim] + number)
                for k in range(joints):
                    ctrl[layout.ctrl[k]] = state.written[k]
                    if len(ring):
                        ring[slot % len(ring), sim, k] = state.written[k]
                        ctrl[layout.ctrl[k]] = ring[behind % len(ring), sim, k]
            done[sim] = number + 1
            for step in range(layout.substeps):
                _step(models[sim], data)
                if layout.touch_base >= 0 and sensordata[layout.touch_base] != 0.0:
                    touches[len(touches) - 1, sim] = True
                if layout.touch >= 0 and sensordata[layout.touch] != 0.0:
                    note_touches(touches, sim, sensordata, layout)
                for k in range(joints):
                    dof = layout.qvel[k]
                    value = torque[dof]
                    if layout.is_exact or layout.substeps > 1:
                        servo, gear = layout.ctrl[k], layout.gear[k]
                        is_inside = abs(force[servo]) < layout.most_force[k] and abs(value) < layout.most_torque[k]
                        if is_inside:
                            value -= gear * layout.damping[k] * (gear * qvel[dof] - speed[servo])
                    efforts[sim, dof] = value if step == 0 else efforts[sim, dof] + value
            if layout.substeps > 1:
                for k in range(joints):
                    efforts[sim, layout.qvel[k]] /= layout.substeps
            if layout.gyro >= 0:
                for k in range(3):
                    sensors[sim, layout.beams + k] = sensordata[layout.gyro + k]
        state.mode_is_new = False
        _get_state(models[sim], data, rows + sim * row_bytes, spec)
        for k in range(len(warnings)):
            all_warnings[sim, k, 1] += warnings[k]
        if done[sim] == len(times):
            read_joints(seen[sim], layout, qpos, qvel, efforts[sim], times[len(times) - 1])
            for k in range(layout.outputs):
                _copy(layout.target[k] + sim * layout.nbytes[k], layout.source[k], layout.nbytes[k])


_WHERE = (
    "i8[::1], i8[::1], i8, i8, i8, f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i4[:], i4[:,:,:], "
    "state[::1], queue[::1], i8[:,:]"
)
_WHAT = "limits[::1], f8[:,:], i8[:], b1[:,:], f8[:,:], layout[::1], state[::1], i8[:], i8[::1], i4"
_LATE = "f8[:,:,:], i8[:], i8[:], i8"
_ARM = f"{_WHAT}, arm[::1], none, none, arm_limits[::1], geometry[::1], {_LATE}, f8[:,:,:]"
run_base_frames = run_frames.of(
    "run_base_frames", f"void({_WHERE}, monitor[::1], {_WHAT}, {', '.join(['none'] * 8)}, i8, none)"
)
run_arm_frames = run_frames.of("run_arm_frames", f"void({_WHERE}, none, {_ARM})")
run_mobile_arm_frames = run_frames.of("run_mobile_arm_frames", f"void({_WHERE}, monitor[::1], {_ARM})")
run_spring_frames = run_frames.of(
    "run_spring_frames",
    f"void({_WHERE}, none, {_WHAT}, none, spring[::1], i8[:], arm_limits[::1], none, {_LATE}, none)",
    work=tick_springs.work,
)


@kernel()
def read_joints(  # noqa: PLR0917
    state: Any, layout: Any, qpos: Numbers, qvel: Numbers, efforts: Numbers, now_ns: int
) -> None:
    """Read the joints of a simulation."""
    state.stamp_ns = now_ns
    for k in range(layout.joints):
        position, velocity = qpos[layout.qpos[k]], qvel[layout.qvel[k]]
        effort = efforts[layout.qvel[k]]
        if k == layout.gripper:
            position *= layout.per_joint[0]
            velocity *= layout.per_joint[0]
            effort /= layout.per_joint[0]
            if layout.qpos_beside >= 0:
                position += qpos[layout.qpos_beside] * layout.per_joint[1]
                velocity += qvel[layout.qvel_beside] * layout.per_joint[1]
            position += layout.offset
        state.position[k], state.velocity[k], state.effort[k] = position, velocity, effort


@kernel()
def note_touches(touches: NDArray[np.bool_], sim: int, sensordata: Numbers, layout: Any) -> None:
    """Note what an arm touches now; the counts are whole numbers, and their sums exact."""
    grip = 0.0
    for k in range(layout.touch_grip[1]):
        grip += sensordata[layout.touch_grip[0] + k]
    table, itself = sensordata[layout.touch_table], sensordata[layout.touch_self]
    touches[0, sim] |= table > 0.0
    touches[1, sim] |= sensordata[layout.touch] > table + itself + grip
    touches[2, sim] |= itself > 0.0


class Late(Protocol):
    """Servos that get their commands late, see `bhd_lerobot.robots.parts.latency.LatePlant`."""

    ring: Numbers
    latency: Counts
    waited: Counts
    written: int

    @property
    def is_late(self) -> bool:
        """Whether any are."""

    def pass_by(self, ticks: int) -> None:
        """Count commands that were written to the ring."""


class Frames:
    """Lets ticks of n simulated robots go by, in machine code once that is worth its compilation.

    Args:
        world: the simulations.
        cerebellum: what controls them; its controller is a part of the compiled tick.
        touches: becomes True where the scene was touched, see `run_frames`, shape (kinds, n).
        seen: becomes what is read of the joints after the last tick, shape (n,).
        late: what its plant passes commands on through; None if it passes them on at once.
        brakes: those of arms with torque motors.
        gyro: name of the gyroscope; None if it is not read.
        beams: sensors of the cerebellum before the gyroscope's.
    """

    def __init__(
        self,
        world: World,
        cerebellum: Cerebellum,
        touches: NDArray[np.bool_],
        seen: NDArray,
        *,
        late: Late | None = None,
        brakes: Brakes | None = None,
        gyro: str | None = None,
        beams: int = 0,
    ) -> None:
        self._world, self._cerebellum, self._touches, self._late = world, cerebellum, touches, late
        self._seen_states = seen
        self._plant, self._pid = cerebellum.plant, os.getpid()
        self._handled = 0
        model, self._layout = world.model, np.zeros(1, LAYOUT)
        row, efforts = self._layout[0], world.servos
        row["substeps"] = world.physics_hz // cerebellum.control_hz
        row["qpos_beside"], row["gripper"], row["joints"] = -1, -1, cerebellum.controller.joints
        row["touch"] = row["touch_base"] = -1
        servos = {} if world.body.arm is None else self._place_arm(row)
        servos |= {} if world.body.drive is None else self._place_drive(row)
        row["gyro"], row["beams"] = -1 if gyro is None else model.sensor(gyro).adr[0], beams
        row["is_exact"] = efforts.is_exact
        if efforts.is_exact or row["substeps"] > 1:
            for name in ("actuator_force", "actuator_velocity"):  # that a step in Python after these averages by
                world.derived(name)
        row["most_force"] = row["most_torque"] = np.inf
        # Others' efforts are averaged in Python.
        self._is_possible = efforts.are_all(list(servos.values()))
        if self._is_possible:
            for name, values in efforts.numbers(list(servos.values())).items():
                row[name][list(servos)] = values
        self._models: list[mujoco.MjModel | None] = [None] * world.n
        self._seen: list[bytes] = []  # the fields that they were made with, and of each simulation
        self._rows: list[bytes | None] = [None] * world.n
        self._threads: list[_Thread] = []
        self._free: SimpleQueue[_Thread] = SimpleQueue()
        self._pool: ThreadPoolExecutor | None = None
        self._addresses, self._done, self._zeros = np.zeros((3, world.n), np.int64)
        self._one_tick: Callable[[int, Any], None] | None = None
        self._made_with: tuple[Any, ...] = ()
        self._now = np.zeros(1, np.int64)
        self._at_once = _NO_RING, self._zeros, self._zeros
        self._checked, self._copies = -1, False
        controller, self._brakes = cerebellum.controller, brakes
        self._kernel = run_base_frames
        if controller.arms is not None:
            self._kernel = run_arm_frames if controller.monitors is None else run_mobile_arm_frames
        elif controller.springs is not None:
            self._kernel = run_spring_frames
            if brakes is not None:
                row["brake"], row["closing_ticks"] = brakes.first, brakes.closing_ticks
                row["friction"][: len(brakes.friction)] = brakes.friction

    def _place_drive(self, row: Any) -> dict[int, int]:
        """Write where the wheels and their touches are; return the servos by the joints' places in the record."""
        model, drive = self._world.model, self._world.body.need(Drive)
        row["touch_base"] = model.sensor(drive.touch_sensor).adr[0]
        return self._place_joints(row, row["joints"] - len(drive.joints), drive.joints, drive.actuators)

    def _place_arm(self, row: Any) -> dict[int, int]:
        """Write where joints, fingers and their touches are; return the joints' servos, likewise."""
        model, arm = self._world.model, self._world.body.need(Arm)
        dof, gripper = len(arm.chain.joints), arm.gripper
        joints = (*arm.chain.joints, *(gripper.joints[:1] if gripper else ()))
        servos = self._place_joints(row, 0, joints, arm.actuators)
        if gripper is not None:
            row["gripper"], row["offset"] = dof, gripper.offset
            row["per_joint"][: len(gripper.joints)] = gripper.per_joint
            for name in gripper.joints[1:]:
                row["qpos_beside"], row["qvel_beside"] = model.joint(name).qposadr[0], model.joint(name).dofadr[0]
        for kind, name in (("touch", "any"), ("touch_table", "table"), ("touch_self", "self")):
            row[kind] = model.sensor(f"touch_{name}").adr[0]
        row["touch_grip"] = model.sensor("touch_object_0").adr[0], MAX_OBJECTS
        if gripper and gripper.tendon:
            del servos[dof]
        return servos

    def _place_joints(self, row: Any, first: int, names: Sequence[str], actuators: Sequence[str]) -> dict[int, int]:
        """Write where joints and their servos are; return the servos by the joints' places in the record."""
        model, places = self._world.model, slice(first, first + len(names))
        joints, servos = [model.joint(name) for name in names], [model.actuator(name).id for name in actuators]
        row["qpos"][places] = [joint.qposadr[0] for joint in joints]
        row["qvel"][places] = [joint.dofadr[0] for joint in joints]
        row["ctrl"][places] = servos
        return dict(enumerate(servos, first))

    def run(self, ids: NDArray[np.intp] | None, first_tick: int, ticks: int) -> bool:
        """Let some ticks go by.

        Args:
            ids: the simulations; all if None.
            first_tick: number of the first tick.
            ticks: how many.

        Returns:
            False if nothing was done: Python does it as well so far, or the cerebellum's plant is another than the
            world's.
        """
        own = self._cerebellum
        ids = np.arange(self._world.n) if ids is None else ids
        self._handled += len(ids) * self._kernel.work
        if not self._is_ready():
            return False
        self._done[ids] = 0
        if own.controller.arms is not None:
            own.controller.arms["stage"] = 0  # whatever interrupted the last frame
        times = np.arange(first_tick, first_tick + ticks) * NANOSECONDS // own.control_hz
        self._run(ids, times)
        own.now_ns = int(times[-1])
        if self._late is not None and self._late.is_late:
            self._late.pass_by(ticks)
        return True

    def tick(self, now_ns: int) -> bool:
        """Let one tick of one robot go by, at any time [ns].

        Returns:
            False if nothing was done, as `run`; also if there are more robots.
        """
        own, late = self._cerebellum, self._late
        is_late = late is not None and late.is_late
        parts = own.plant, own.fifo, own.estop, is_late, len(self._world.outputs)
        if self._one_tick is None or parts != self._made_with:
            if self._world.n > 1 or not self._is_ready():
                return False
            rest = self._seen_states, self._done, self._now
            arguments = self._threads[0].arguments(self._addresses, self._shared, *rest)
            self._one_tick, self._made_with = partial(self._kernel.compiled, np.zeros(1, np.intp), *arguments), parts
        own.now_ns = self._now[0] = now_ns
        self._done[0] = 0
        if own.controller.arms is not None:
            own.controller.arms["stage"] = 0
        while True:
            self._one_tick(*self._varying)
            if self._done[0]:
                break
            own.serve()
        if late is not None and is_late:
            late.pass_by(1)
        return True

    def _is_ready(self) -> bool:
        """Prepare for machine code; return whether it does what Python would."""
        own = self._cerebellum
        if not self._is_possible or own.plant is not self._plant or not own.may_write or self._is_watched:
            return False
        if not is_worth_compiling(self._kernel, self._handled) or not _load():
            return False
        if not self._are_copied:
            return False
        self._take_models()
        if self._pid != os.getpid():  # after a fork there are no threads
            self._pid, self._pool, self._threads, self._free = os.getpid(), None, [], SimpleQueue()
        if not self._threads:
            self._threads = [_Thread(self._world, self._layout) for _ in range(self._world.threads)]
            for thread in self._threads:
                self._free.put(thread)
            if len(self._threads) > 1:
                self._pool = ThreadPoolExecutor(len(self._threads), "frames")
        return True

    def forget(self) -> None:
        """Prepare anew before the next `tick`: another scene has begun, or fields of models have changed."""
        self._one_tick = None

    @property
    def _is_watched(self) -> bool:
        """Whether somebody has put a function of his own in the place of one that machine code leaves out."""
        watched = self._plant, getattr(self._plant, "plant", self._plant), self._world, self._cerebellum
        return any(name in vars(one) for one in watched for name in _LEFT_OUT)

    def _run(self, ids: NDArray[np.intp], times: Counts) -> None:
        """Let ticks go by; what ticks of some simulations wait for is done while others go on."""
        if self._pool is None:
            while len(ids):
                ids = self._run_share(ids, times, self._shared)
                if len(ids):
                    self._cerebellum.serve(ids)
            return
        shares = np.array_split(ids, min(len(ids), _SHARES * len(self._threads)))
        jobs = {self._pool.submit(self._run_share, share, times, self._shared) for share in shares}
        try:
            while jobs:
                done, jobs = wait(jobs, return_when=FIRST_COMPLETED)
                for job in done:
                    left = job.result()
                    if len(left):
                        self._cerebellum.serve(left)
                        jobs.add(self._pool.submit(self._run_share, left, times, self._shared))
        finally:
            wait(jobs)  # whatever interrupts this: no other frame begins meanwhile

    def _run_share(self, ids: NDArray[np.intp], times: Counts, shared: Any) -> NDArray[np.intp]:
        """Let ticks of some simulations go by; return those that wait for their controller."""
        thread = self._free.get()
        try:
            thread.run(self._kernel, ids, self._addresses, shared, self._seen_states, self._done, times, *self._varying)
        finally:
            self._free.put(thread)
        return ids[self._done[ids] < len(times)]

    @property
    def _are_copied(self) -> bool:
        """Whether all fields that are read after a frame can be copied out of it."""
        outputs = self._world.outputs
        if len(outputs) != self._checked:
            fields = {name: getattr(self._world.one, name) for name in outputs}
            self._copies = len(outputs) <= _OUTPUTS and all(
                isinstance(field, np.ndarray)
                and outputs[name].flags.c_contiguous
                and (outputs[name].dtype, outputs[name][0].nbytes) == (field.dtype, field.nbytes)
                for name, field in fields.items()
            )
            self._checked = len(outputs)
        return self._copies

    @property
    def _shared(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """What all threads run with, before and after the layout; behind it comes what `_varying` is."""
        own, late = self._cerebellum, self._late
        controller, reading = own.controller, own.reading
        records = own.states, own.fifo.queues, own.estop.words, controller.monitors
        sensors = reading.sensors, reading.sensors_ns, self._touches, self._world.efforts
        arms: tuple[Any, ...] = (None,) * 8
        if controller.arm_limits is not None:
            if controller.arms is not None:
                arms = controller.arms, None, None, controller.arm_limits, controller.geometries
            elif self._brakes is not None:
                arms = None, controller.springs, self._brakes.ticks, controller.arm_limits, None
            arms += (late.ring, late.latency, late.waited) if late and late.is_late else self._at_once
        return (self._world.warnings, *records, own.numbers, *sensors), arms

    @property
    def _varying(self) -> tuple[int, Any]:
        """What changes from frame to frame: commands that were written to the ring, and trajectories."""
        late = self._late
        return late.written if late and late.is_late else 0, self._cerebellum.controller.rows

    def _take_models(self) -> None:
        """Make the simulations' models again if their fields have changed."""
        fields = self._world.fields
        seen = [field.tobytes() for field in fields.values()]
        if seen == self._seen and self._models[0] is not None:
            return
        self._seen = seen
        rows = [b"".join(field[sim].tobytes() for field in fields.values()) for sim in range(self._world.n)]
        for sim, row in enumerate(rows):
            if row == self._rows[sim]:
                continue
            model = self._models[sim] = self._world.copy_model(sim, self._models[sim])
            self._addresses[sim], self._rows[sim] = model._address, row

    def close(self) -> None:
        """End the threads. May be called twice."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool, self._threads, self._free = None, [], SimpleQueue()


class _Thread:
    """What one thread runs frames in: MuJoCo's data, and where its fields are."""

    def __init__(self, world: World, layout: NDArray) -> None:
        self._world, self._layout = world, layout.copy()
        self._data = data = mujoco.MjData(world.model)
        fields = data.qpos, data.qvel, data.ctrl, data.sensordata, data.qfrc_actuator
        self._fields = (*fields, data.actuator_force, data.actuator_velocity, data.warning.number)
        self._outputs = 0
        self._lock = Lock()  # after an interruption the last frame may still be running

    def run(self, *arguments: Any) -> None:
        with self._lock:
            self._run(*arguments)

    def _run(self, kernel: Any, ids: NDArray, models: Counts, shared: tuple[Any, Any], *rest: Any) -> None:
        *before, written, rows = rest
        kernel.compiled(ids, *self.arguments(models, shared, *before), written, rows)

    def arguments(self, models: Counts, shared: tuple[Any, Any], *rest: Any) -> tuple[Any, ...]:
        """Return the arguments of `run_frames` but the first and the last two."""
        state, row = self._world.state, self._layout[0]
        if len(self._world.outputs) != self._outputs:
            for k, (name, target) in enumerate(self._world.outputs.items()):
                row["source"][k], row["target"][k] = getattr(self._data, name).ctypes.data, target.ctypes.data
                row["nbytes"][k] = target[0].nbytes
            self._outputs = row["outputs"] = len(self._world.outputs)
        where = self._data._address, state.ctypes.data, state.strides[0]
        before, arms = shared
        return (models, *where, *self._fields, *before, self._layout, *rest, _STATE, *arms)
