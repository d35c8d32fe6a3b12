"""Whole frames of simulated robots in machine code: ticks of their control and physics steps, without Python between.

The results are those of `Cerebellum.tick` and `World.step` in turns, bit for bit.
"""

import ctypes
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.kernels import is_worth_compiling, kernel, record
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.record import JOINTS
from bhd_lerobot.control.tick import tick
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.world import World

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_TICK_VALUES = 8  # that a tick of one robot counts for, see `kernels`
_OUTPUTS = 16  # fields that may be read after a frame
Counts = NDArray[np.int64]
Numbers = NDArray[np.float64]

LAYOUT = record(
    "layout",
    [
        ("ticks_hz", np.int64),
        ("substeps", np.int64),
        # Places of the joints in qpos and qvel, and of the actuators in ctrl.
        ("qpos", np.int64, (JOINTS,)),
        ("qvel", np.int64, (JOINTS,)),
        ("ctrl", np.int64, (JOINTS,)),
        ("touch", np.int64),  # place of the touch sensor's reading
        ("gyro", np.int64),  # and of the gyroscope's; -1 if it is not read
        ("beams", np.int64),  # sensors before the gyroscope's
        # The servos' damping, see `MeanEfforts`.
        ("is_exact", np.bool_),  # what acted is averaged, not what MuJoCo reports
        ("gear", np.float64, (JOINTS,)),
        ("damping", np.float64, (JOINTS,)),
        ("most_force", np.float64, (JOINTS,)),
        ("most_torque", np.float64, (JOINTS,)),
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


@kernel(
    "void(i8[::1], i8[::1], i8, i8, i8, f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i4[:], "
    "i4[:,:,:], state[::1], queue[::1], i8[:,:], monitor[::1], limits[::1], f8[:,:], i8[:], b1[:], f8[:,:], "
    "layout[::1], i8, i8, i4)"
)
def run_frames(  # noqa: PLR0912, PLR0917
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
    touched: NDArray[np.bool_],
    efforts: Numbers,
    layouts: Any,
    first_tick: int,
    ticks: int,
    spec: int,
) -> None:
    """Let some ticks of some simulations go by, one simulation after the other.

    Args:
        ids: the simulations.
        models: the address of each simulation's model.
        data: the address of the data that they run in, whose fields the arrays after `row_bytes` are.
        rows: the address of the first simulation's state; `row_bytes` from one to the next.
        all_warnings: number of warnings of each simulation, as `Batch.warning`.
        touched: becomes True where the scene was touched.
        efforts: mean efforts of the last tick, shape (n, nv).
        first_tick: number of the first tick.
        spec: what a state consists of, `mjSTATE_INTEGRATION` of this version of MuJoCo.
    """
    layout = layouts[0]
    joints = limits[0].joints
    for sim in ids:
        state, monitor = states[sim], monitors[sim % len(monitors)]
        _set_state(models[sim], data, rows + sim * row_bytes, spec)
        warnings[:] = 0
        for number in range(first_tick, first_tick + ticks):
            now_ns = number * NANOSECONDS // layout.ticks_hz
            state.stamp_ns = now_ns
            for k in range(joints):
                state.position[k], state.velocity[k] = qpos[layout.qpos[k]], qvel[layout.qvel[k]]
                state.effort[k] = efforts[sim, layout.qvel[k]]
            tick(state, queues[sim], estop[:, sim], monitor, limits[0], sensors[sim], sensors_ns[sim], now_ns)
            for k in range(joints):
                ctrl[layout.ctrl[k]] = state.written[k]
            for step in range(layout.substeps):
                _step(models[sim], data)
                if sensordata[layout.touch] != 0.0:
                    touched[sim] = True
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
        for k in range(layout.outputs):
            _copy(layout.target[k] + sim * layout.nbytes[k], layout.source[k], layout.nbytes[k])


class Frames:
    """Lets ticks of n simulated bases go by, in machine code once that is worth its compilation.

    Args:
        world: the simulations.
        cerebellum: what controls them; its controller is a part of the compiled tick.
        joints: the joints that it reads, in the order of its readings.
        actuators: the actuators that it commands.
        touch: name of the sensor of touches.
        touched: becomes True where the scene was touched, shape (n,).
        gyro: name of the gyroscope; None if it is not read.
        beams: sensors of the cerebellum before the gyroscope's.
    """

    def __init__(
        self,
        world: World,
        cerebellum: Cerebellum,
        joints: Sequence[str],
        actuators: Sequence[str],
        *,
        touch: str,
        touched: NDArray[np.bool_],
        gyro: str | None,
        beams: int,
    ) -> None:
        self._world, self._cerebellum, self._touched = world, cerebellum, touched
        self._plant, self._pid = cerebellum.plant, os.getpid()
        self._handled = 0
        model, layout = world.model, np.zeros(1, LAYOUT)
        row, efforts = layout[0], world.servos
        row["ticks_hz"], row["substeps"] = cerebellum.control_hz, world.physics_hz // cerebellum.control_hz
        k, servos = len(joints), [model.actuator(name).id for name in actuators]
        row["qpos"][:k] = [model.joint(name).qposadr[0] for name in joints]
        row["qvel"][:k] = [model.joint(name).dofadr[0] for name in joints]
        row["ctrl"][:k] = servos
        row["touch"] = model.sensor(touch).adr[0]
        row["gyro"], row["beams"] = -1 if gyro is None else model.sensor(gyro).adr[0], beams
        row["is_exact"] = efforts.is_exact
        self._is_possible = efforts.are_all(servos)  # others' efforts are averaged in Python
        if self._is_possible:
            for name, values in efforts.numbers(servos).items():
                row[name][:k] = values
        self._layout = layout
        self._models: list[mujoco.MjModel | None] = [None] * world.n
        self._seen: list[bytes] = []  # the fields that they were made with, and of each simulation
        self._rows: list[bytes | None] = [None] * world.n
        self._threads: list[_Thread] = []
        self._pool: ThreadPoolExecutor | None = None
        self._addresses = np.zeros(world.n, np.int64)
        self._checked, self._copies = -1, False

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
        if not self._is_possible or self._cerebellum.plant is not self._plant:
            return False
        ids = np.arange(self._world.n) if ids is None else ids
        self._handled += len(ids) * _TICK_VALUES
        if not is_worth_compiling(run_frames, self._handled) or not _load():
            return False
        if not self._are_copied:
            return False
        self._take_models()
        if self._pid != os.getpid():  # after a fork there are no threads
            self._pid, self._pool, self._threads = os.getpid(), None, []
        if not self._threads:
            self._threads = [_Thread(self._world, self._layout) for _ in range(self._world.threads)]
            if len(self._threads) > 1:
                self._pool = ThreadPoolExecutor(len(self._threads), "frames")
        shared = self._shared
        if self._pool is None:
            self._threads[0].run(ids, self._addresses, shared, first_tick, ticks)
            return True
        shares = np.array_split(ids, len(self._threads))
        calls = zip(self._threads, shares, strict=True)
        jobs = [
            self._pool.submit(thread.run, share, self._addresses, shared, first_tick, ticks)
            for thread, share in calls
            if len(share)
        ]
        try:
            for job in jobs:
                job.result()
        finally:
            wait(jobs)  # whatever interrupts this: no other frame begins meanwhile
        return True

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
    def _shared(self) -> tuple[Any, ...]:
        own = self._cerebellum
        reading, records = own.reading, (own.states, own.fifo.queues, own.estop.words, own.controller.monitors)
        sensors = reading.sensors, reading.sensors_ns
        return (self._world.warnings, *records, own.numbers, *sensors, self._touched, self._world.efforts)

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
            self._pool, self._threads = None, []


class _Thread:
    """What one thread runs frames in: MuJoCo's data, and where its fields are."""

    def __init__(self, world: World, layout: NDArray) -> None:
        self._world, self._layout = world, layout.copy()
        self._data = data = mujoco.MjData(world.model)
        fields = data.qpos, data.qvel, data.ctrl, data.sensordata, data.qfrc_actuator
        self._fields = (*fields, data.actuator_force, data.actuator_velocity, data.warning.number)
        self._outputs = 0
        self._lock = Lock()  # after an interruption the last frame may still be running

    def run(self, ids: NDArray, models: Counts, shared: tuple[Any, ...], first_tick: int, ticks: int) -> None:
        with self._lock:
            self._run(ids, models, shared, first_tick, ticks)

    def _run(self, ids: NDArray, models: Counts, shared: tuple[Any, ...], first_tick: int, ticks: int) -> None:
        state, row = self._world.state, self._layout[0]
        if len(self._world.outputs) != self._outputs:
            for k, (name, target) in enumerate(self._world.outputs.items()):
                row["source"][k], row["target"][k] = getattr(self._data, name).ctypes.data, target.ctypes.data
                row["nbytes"][k] = target[0].nbytes
            self._outputs = row["outputs"] = len(self._world.outputs)
        where = self._data._address, state.ctypes.data, state.strides[0]
        run_frames.compiled(ids, models, *where, *self._fields, *shared, self._layout, first_tick, ticks, _STATE)
