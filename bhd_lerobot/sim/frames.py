"""Whole frames of simulated robots in machine code: ticks of their control and physics steps, without Python between.

The results are those of `Cerebellum.tick` and `World.step` in turns, bit for bit.
"""

import ctypes
import os
import sys
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Drive
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.kernels import Kernel, group, is_plain, kernel, record
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.record import JOINTS, ArmRecords, RobotRecords, SpringRecords
from bhd_lerobot.control.tick import ARMS, MONITORS, ROBOTS, SPRINGS, tick_robot
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.plant import Brakes, run_brake, set_brake
from bhd_lerobot.sim.world import World

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_LEFT_OUT = ("read", "write", "set_mode", "step", "tick")  # methods that frames in machine code do not call
_SHARES = 4  # of the simulations for each thread: what one waits for is done while others go on
_OUTPUTS = 16  # fields that may be read after a frame
_FIRST = np.zeros(1, np.intp)
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


@group
class Physics(NamedTuple):
    """The simulations, and the data of MuJoCo that one thread runs them in.

    Attributes:
        models: the address of each simulation's model, shape (n,).
        data: the address of the data.
        states: the address of the first simulation's state.
        state_bytes: from one simulation's state to the next.
        spec: what a state consists of, `mjSTATE_INTEGRATION` of this version of MuJoCo.
        qpos: this and the following are fields of the data; `torque` is ``qfrc_actuator``, `force` and `speed` are
            ``actuator_force`` and ``actuator_velocity``.
        touches: becomes True where something was touched, shape (kinds, n): by an arm the table, objects with one of
            its links, itself; then by a base the scene.
        efforts: mean efforts of the last tick, shape (n, nv).
        layouts: where everything is, shape (1,).
    """

    models: Counts
    data: int
    states: int
    state_bytes: int
    spec: int
    qpos: Numbers
    qvel: Numbers
    ctrl: Numbers
    sensordata: Numbers
    torque: Numbers
    force: Numbers
    speed: Numbers
    touches: NDArray[np.bool_]
    efforts: Numbers
    layouts: Any


@group
class Delay(NamedTuple):
    """By how much servos get their commands late.

    Attributes:
        ring: the last commands, shape (ticks, n, actuators); empty if none is late.
        latency: by how many ticks they are late, shape (n,).
        waited: ticks since that was set, shape (n,).
        written: commands that were written to the ring.
    """

    ring: Numbers
    latency: Counts
    waited: Counts
    written: int


@group
class Ticks(NamedTuple):
    """Ticks of simulations.

    Attributes:
        times: what they are for [ns], shape (ticks,).
        done: how many of these each simulation has done, shape (n,).
        seen: becomes what is read of the joints after the last, as records of robots, shape (n,).
    """

    times: Counts
    done: Counts
    seen: Any


@kernel()
def run_frames(  # noqa: PLR0917
    ids: Counts,
    ticks: Ticks,
    physics: Physics,
    warnings: NDArray[np.int32],
    counted: NDArray[np.int32],
    robots: RobotRecords,
    monitors: Any,
    arms: ArmRecords | None,
    springs: SpringRecords | None,
    brakes: Any,
    delay: Delay | None,
) -> None:
    """Let some ticks of some simulations go by, one simulation after the other.

    One whose tick waits for its controller is left there, and goes on at the next call.

    Args:
        ids: the simulations.
        warnings: how often MuJoCo has warned in this data, by kind.
        counted: warnings of each simulation, as `Batch.warning`.
        monitors: records of the collision monitors of bases; None of robots that do not drive.
        arms: arms with position servos; None of others.
        springs: arms with torque motors; None of others.
        brakes: for how many ticks these arms' brakes are closed, shape (n,).
        delay: of robots with an arm; None of others.
    """
    layout, last = physics.layouts[0], len(ticks.times) - 1
    for sim in ids:
        state, efforts = robots.states[sim], physics.efforts[sim]
        model, address = physics.models[sim], physics.states + sim * physics.state_bytes
        _set_state(model, physics.data, address, physics.spec)
        warnings[:] = 0
        for number in range(ticks.done[sim], last + 1):
            now_ns = ticks.times[number]
            if not is_waiting(sim, arms):
                read_joints(state, layout, physics.qpos, physics.qvel, efforts, now_ns)
            if not tick_robot(sim, robots, monitors, arms, springs, now_ns):
                break
            if springs is not None:
                hold_brakes(sim, state, physics, layout, brakes, springs.limits[0].dof)
            write_commands(sim, state, physics.ctrl, layout, delay, number)
            ticks.done[sim] = number + 1
            for step in range(layout.substeps):
                _step(model, physics.data)
                note_touches(sim, physics, layout)
                add_efforts(efforts, physics, layout, step)
            for k in range(3 if layout.gyro >= 0 else 0):
                robots.sensors[sim, layout.beams + k] = physics.sensordata[layout.gyro + k]
        state.mode_is_new = False
        _get_state(model, physics.data, address, physics.spec)
        for k in range(len(warnings)):
            counted[sim, k, 1] += warnings[k]
        if ticks.done[sim] > last:
            read_joints(ticks.seen[sim], layout, physics.qpos, physics.qvel, efforts, ticks.times[last])
            for k in range(layout.outputs):
                _copy(layout.target[k] + sim * layout.nbytes[k], layout.source[k], layout.nbytes[k])


_RUN = (
    "i8[::1], Ticks(i8[::1], i8[::1], state[::1]), "
    "Physics(i8[::1], i8, i8, i8, i8, f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], b1[:,::1], "
    f"f8[:,::1], layout[::1]), i4[:], i4[:,:,:], {ROBOTS}"
)
_DELAY = "Delay(f8[:,:,::1], i8[::1], i8[::1], i8)"
run_base_frames = run_frames.of("run_base_frames", f"void({_RUN}, {MONITORS}, none, none, none, none)")
run_arm_frames = run_frames.of("run_arm_frames", f"void({_RUN}, none, {ARMS}, none, none, {_DELAY})")
run_mobile_arm_frames = run_frames.of(
    "run_mobile_arm_frames", f"void({_RUN}, {MONITORS}, {ARMS}, none, none, {_DELAY})"
)
run_spring_frames = run_frames.of("run_spring_frames", f"void({_RUN}, none, none, {SPRINGS}, i8[::1], {_DELAY})")


@kernel()
def is_waiting(sim: int, arms: ArmRecords | None) -> bool:
    """Return whether a tick of a simulation has begun, and waited for its controller."""
    if arms is not None:
        return arms.records[sim].stage != 0
    return False


@kernel()
def hold_brakes(  # noqa: PLR0917
    sim: int, state: Any, physics: Physics, layout: Any, brakes: Counts, dof: int
) -> None:
    """Open or close the brakes of an arm, and advance them by one tick."""
    if state.mode_is_new:
        set_brake(brakes, sim, state.mode)
        state.mode_is_new = False
    closing = physics.ctrl[layout.brake : layout.brake + dof]
    speeds = physics.qvel[layout.qvel[0] : layout.qvel[0] + dof]
    run_brake(brakes, closing, speeds, sim, layout.friction, layout.closing_ticks)


@kernel()
def write_commands(  # noqa: PLR0917
    sim: int, state: Any, ctrl: Numbers, layout: Any, delay: Delay | None, number: int
) -> None:
    """Write what a tick commands to the actuators; of servos that are late, what it commanded some ticks ago."""
    for k in range(layout.joints):
        ctrl[layout.ctrl[k]] = state.written[k]
    if delay is not None:
        slot = delay.written + number
        behind = slot - min(delay.latency[sim], delay.waited[sim] + number)
        for k in range(layout.joints if len(delay.ring) else 0):
            delay.ring[slot % len(delay.ring), sim, k] = state.written[k]
            ctrl[layout.ctrl[k]] = delay.ring[behind % len(delay.ring), sim, k]


@kernel()
def add_efforts(efforts: Numbers, physics: Physics, layout: Any, step: int) -> None:
    """Add the efforts of a physics step to their sum over a tick; with the last step they are its means."""
    for k in range(layout.joints):
        dof = layout.qvel[k]
        value = physics.torque[dof]
        if layout.is_exact or layout.substeps > 1:
            servo, gear = layout.ctrl[k], layout.gear[k]
            is_inside = abs(physics.force[servo]) < layout.most_force[k] and abs(value) < layout.most_torque[k]
            if is_inside:
                value -= gear * layout.damping[k] * (gear * physics.qvel[dof] - physics.speed[servo])
        efforts[dof] = value if step == 0 else efforts[dof] + value
        if 0 < step == layout.substeps - 1:
            efforts[dof] /= layout.substeps


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
def note_touches(sim: int, physics: Physics, layout: Any) -> None:
    """Note what a base and an arm touch now; the counts are whole numbers, and their sums exact."""
    touches, sensordata = physics.touches, physics.sensordata
    if layout.touch_base >= 0 and sensordata[layout.touch_base] != 0.0:
        touches[len(touches) - 1, sim] = True
    if layout.touch >= 0 and sensordata[layout.touch] != 0.0:
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
    is_late: bool

    def pass_by(self, ticks: int) -> None:
        """Count commands that were written to the ring."""


class Frames:
    """Lets ticks of n simulated robots go by in machine code.

    Args:
        world: the simulations.
        cerebellum: what controls them; its controller is a part of the compiled tick.
        touches: becomes True where the scene was touched, see `Physics`, shape (kinds, n).
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
        self._plant, self._pid = cerebellum.plant, os.getpid()
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
        self._addresses, done, zeros = np.zeros((3, world.n), np.int64)
        self._ticks = Ticks(np.zeros(1, np.int64), done, seen)
        self._is_prepared = False
        self._at_once = None if late is None else Delay(np.zeros((0, 1, 1)), zeros, zeros, 0)
        self._checked, self._copies = -1, False
        controller, self._brakes = cerebellum.controller, brakes
        self._kernel: Kernel[..., None] = run_base_frames
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
        if not self._is_ready():
            return False
        times = np.arange(first_tick, first_tick + ticks) * NANOSECONDS // own.control_hz
        self._begin(ids)
        self._run(ids, self._ticks._replace(times=times))
        own.now_ns = int(times[-1])
        self._end(ticks)
        return True

    def tick(self, now_ns: int) -> bool:
        """Let one tick of one robot go by, at any time [ns].

        Returns:
            False if nothing was done, as `run`; also if there are more robots.
        """
        own = self._cerebellum
        if not self._is_prepared or own.plant is not self._plant or is_plain():
            self._is_prepared = self._world.n == 1 and self._is_ready()
            if not self._is_prepared:
                return False
        if not self._are_copied:
            return False
        own.now_ns = self._ticks.times[0] = now_ns
        self._begin(_FIRST)
        thread = self._threads[0]
        while True:
            thread.run(self._kernel, _FIRST, self._ticks, *self._parts)
            if self._ticks.done[0]:
                break
            own.serve()
        self._end(1)
        return True

    def _begin(self, ids: NDArray[np.intp]) -> None:
        self._ticks.done[ids] = 0
        if (arms := self._cerebellum.controller.arms) is not None:
            arms["stage"] = 0  # whatever interrupted the last frame

    def _end(self, ticks: int) -> None:
        if self._late is not None and self._late.is_late:
            self._late.pass_by(ticks)

    def load(self) -> bool:
        """Load the machine code; return whether there is any for these robots."""
        if not self._is_possible or is_plain() or not _load():
            return False
        self._kernel.load()
        return True

    def _is_ready(self) -> bool:
        """Prepare for machine code; return whether it does what Python would."""
        own = self._cerebellum
        if own.plant is not self._plant or not own.may_write or self._is_watched:
            return False
        if not self.load() or not self._are_copied:
            return False
        self._take_models()
        if self._pid != os.getpid():  # after a fork there are no threads
            self._pid, self._pool, self._threads, self._free = os.getpid(), None, [], SimpleQueue()
        if not self._threads:
            shared = self._addresses, self._touches, self._layout
            self._threads = [_Thread(self._world, *shared) for _ in range(self._world.threads)]
            for thread in self._threads:
                self._free.put(thread)
            if len(self._threads) > 1:
                self._pool = ThreadPoolExecutor(len(self._threads), "frames")
        return True

    def forget(self) -> None:
        """Prepare anew before the next `tick`: another scene has begun, or fields of models have changed."""
        self._is_prepared = False

    @property
    def _is_watched(self) -> bool:
        """Whether somebody has put a function of his own in the place of one that machine code leaves out."""
        watched = self._plant, getattr(self._plant, "plant", self._plant), self._world, self._cerebellum
        return any(name in vars(one) for one in watched for name in _LEFT_OUT)

    def _run(self, ids: NDArray[np.intp], ticks: Ticks) -> None:
        """Let ticks go by; what ticks of some simulations wait for is done while others go on."""
        if self._pool is None:
            while len(ids):
                ids = self._run_share(ids, ticks)
                if len(ids):
                    self._cerebellum.serve(ids)
            return
        shares = np.array_split(ids, max(min(len(ids), _SHARES * len(self._threads)), 1))
        jobs = {self._pool.submit(self._run_share, share, ticks) for share in shares}
        try:
            while jobs:
                done, jobs = wait(jobs, return_when=FIRST_COMPLETED)
                for job in done:
                    left = job.result()
                    if len(left):
                        self._cerebellum.serve(left)
                        jobs.add(self._pool.submit(self._run_share, left, ticks))
        finally:
            wait(jobs)  # whatever interrupts this: no other frame begins meanwhile

    def _run_share(self, ids: NDArray[np.intp], ticks: Ticks) -> NDArray[np.intp]:
        """Let ticks of some simulations go by; return those that wait for their controller."""
        thread = self._free.get()
        try:
            thread.run(self._kernel, ids, ticks, *self._parts)
        finally:
            self._free.put(thread)
        return ids[ticks.done[ids] < len(ticks.times)]

    @property
    def _parts(self) -> tuple[Any, ...]:
        """What `run_frames` takes behind the physics, as it is now."""
        own, late = self._cerebellum, self._late
        monitors, arms, springs = own.controller.groups
        brakes = None if springs is None or self._brakes is None else self._brakes.ticks
        delay = self._at_once
        if late is not None and late.is_late:
            delay = Delay(late.ring, late.latency, late.waited, late.written)
        return own.robots, monitors, arms, springs, brakes, delay

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
    """What one thread runs frames in."""

    def __init__(self, world: World, addresses: Counts, touches: NDArray[np.bool_], layout: NDArray) -> None:
        self._world = world
        self._data = data = mujoco.MjData(world.model)
        self._warnings = data.warning.number
        self._physics = Physics(
            models=addresses,
            data=data._address,
            states=world.state.ctypes.data,
            state_bytes=world.state.strides[0],
            spec=_STATE,
            qpos=data.qpos,
            qvel=data.qvel,
            ctrl=data.ctrl,
            sensordata=data.sensordata,
            torque=data.qfrc_actuator,
            force=data.actuator_force,
            speed=data.actuator_velocity,
            touches=touches,
            efforts=world.efforts,
            layouts=layout.copy(),
        )
        self._outputs = 0
        self._checked: RobotRecords | None = None  # those whose arrays' types were checked
        self._lock = Lock()  # after an interruption the last frame may still be running

    def run(
        self, one: Kernel[..., None], ids: NDArray[np.intp], ticks: Ticks, robots: RobotRecords, *parts: Any
    ) -> None:
        """Let ticks of some simulations go by."""
        with self._lock:
            self._run(one, ids, ticks, robots, *parts)

    def _run(
        self, one: Kernel[..., None], ids: NDArray[np.intp], ticks: Ticks, robots: RobotRecords, *parts: Any
    ) -> None:
        outputs = self._world.outputs
        if len(outputs) != self._outputs:
            row = self._physics.layouts[0]
            for k, (name, target) in enumerate(outputs.items()):
                row["source"][k], row["target"][k] = getattr(self._data, name).ctypes.data, target.ctypes.data
                row["nbytes"][k] = target[0].nbytes
            self._outputs = row["outputs"] = len(outputs)
        call = one.unchecked if robots is self._checked else one.compiled
        call(ids, ticks, self._physics, self._warnings, self._world.warnings, robots, *parts)
        self._checked = robots
