"""n simulated robots under one cerebellum: what a LeRobot `Robot` and the batched runs are both made of."""

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.messages import NANOSECONDS, SendResult
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.lidar import Lidar
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.render_thread import Deliver, RenderThread
from bhd_lerobot.sim.world import Snapshot, World

# Streams of random numbers of one episode: what one draws more of must not shift the others.
_SENSOR_STREAM = 1


@dataclass(frozen=True)
class Frame:
    """What was seen at the start of a frame, of n robots.

    Attributes:
        state: the observation's floats, shape (n, features).
        time_ns: when it was measured, since the episode's start [ns], shape (n,).
        age_ns: age of the oldest reading in it, the scan [ns], shape (n,).
    """

    state: NDArray[np.float64]
    time_ns: NDArray[np.int64]
    age_ns: NDArray[np.int64]


@dataclass(frozen=True)
class FrameReport:
    """What the cerebellum did during a frame, of n robots.

    Attributes:
        applied: the command at the end of the frame, shape (n, actions).
        sent: what became of the setpoint that the frame began with.
        limits: `Limit` flags, shape (n,).
        watchdog: `Watchdog` flags, shape (n,).
        command_age_ns: age of the command in force at the end of the frame [ns], shape (n,).
        mode: `Mode` at the end of the frame, shape (n,).
        touched: whether the robot touched the scene during the frame, shape (n,).
    """

    applied: NDArray[np.float64]
    sent: SendResult
    limits: NDArray[np.int64]
    watchdog: NDArray[np.int64]
    command_age_ns: NDArray[np.int64]
    mode: NDArray[np.int8]
    touched: NDArray[np.bool_]


class TurtleBot3Simulation:
    """n simulated TurtleBot3s.

    Each is in an episode of its own, which nothing outside it can change: not the number of the others, not what they
    do, not the number of threads.

    Args:
        config: the robot.
        n: how many.
        threads: threads that step the physics; all processors if None.
    """

    action_names = ("x.vel", "theta.vel")

    def __init__(self, config: TurtleBot3Config, n: int = 1, threads: int | None = None) -> None:
        self.config, self.n = config, n
        self.rates = config.rates
        self.body = config.body()
        self.world = World(self.body, n, physics_hz=config.physics_hz, threads=threads)
        self.plant = SimulatedPlant(self.world)
        self.cerebellum = Cerebellum(self.body, self.plant, config.control_hz)
        self.bridge = LockstepBridge(self.cerebellum, self.rates, self._advance)
        if self.body.lidar is None:
            raise AssertionError("The Burger has a lidar.")
        self.lidar = Lidar(self.world, self.body.lidar, config.beams)
        self.observation_names = observation_names(config)
        self.camera_names = ("front",) if config.camera else ()
        self.running = np.ones(n, np.bool_)
        self._camera: Camera | None = None
        self._render_thread: RenderThread | None = None
        self._touch = self.world.sensor(self.body.touch_sensor)[:, 0]
        self._gyro = self.world.sensor("imu_gyro")
        self._touched = np.zeros(n, np.bool_)
        self._reading = PlantReading(n, 2)
        self._rngs = [np.random.default_rng(0) for _ in range(n)]
        self._tick = 0
        self._start_tick = np.zeros(n, np.int64)
        self._scan_ticks = config.control_hz // self.body.lidar.rate_hz
        self._scanned_tick = np.zeros(n, np.int64)
        self._next_scan = 0
        self._active: NDArray[np.intp] | None = None

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], arenas: Sequence[Arena], seeds: Sequence[int]) -> None:
        """Start episodes: place the obstacles, put the robots at the start at rest, take a first scan.

        Args:
            ids: the simulations.
            arenas: where each of them is.
            seeds: a seed for each of them; their sensors' noise follows from it.
        """
        ids = np.asarray(ids, np.intp)
        self.world.place([arena.shapes for arena in arenas], ids)
        self.world.reset(ids, np.array([arena.start for arena in arenas]))
        for sim, seed in zip(ids, seeds, strict=True):
            self._rngs[sim] = np.random.default_rng(np.random.SeedSequence([_SENSOR_STREAM, seed]))
        self.bridge.restart(ids)
        self._touched[ids] = False
        self._start_tick[ids] = self._tick
        self.running[ids] = True
        self._active = None if self.running.all() else np.flatnonzero(self.running)
        self._scan(ids)

    def stop(self, ids: NDArray[np.intp]) -> None:
        """Leave simulations alone from now on: they are neither stepped nor scanned before their next `reset`."""
        self.running[ids] = False
        self._active = np.flatnonzero(self.running)

    # --- frames ------------------------------------------------------------------------------------------------------

    def observe(self) -> Frame:
        """Return what the robots see now."""
        self.plant.read(self._reading)
        twist = self.cerebellum.controller.drive.twist_from_wheels(self._reading.velocity)
        parts = [twist, self.lidar.ranges]
        if self.config.odometry:
            parts.append(self.cerebellum.controller.drive.odometry_at(self._reading.position))
        if self.config.imu:
            parts.append(self._gyro)
        now = (self._tick - self._start_tick) * NANOSECONDS // self.rates.control_hz
        scanned = (self._scanned_tick - self._start_tick) * NANOSECONDS // self.rates.control_hz
        return Frame(np.concatenate(parts, axis=1), now, now - scanned)

    def act(self, action: NDArray[np.float64]) -> FrameReport:
        """Send a setpoint to the running robots and let one frame go by.

        Args:
            action: forward speed [m/s] and yaw rate [rad/s], shape (n, 2).
        """
        sent = self.bridge.send(action, self.running)
        return self.wait(sent)

    def wait(self, sent: SendResult) -> FrameReport:
        """Let one frame go by without a new setpoint; `sent` is passed on to the report."""
        self._touched[:] = False
        self.bridge.advance_frame()
        self.world.check()
        limits, watchdog = self.cerebellum.take_flags()
        return FrameReport(
            applied=self.cerebellum.command.copy(),
            sent=sent,
            limits=limits,
            watchdog=watchdog,
            command_age_ns=self.cerebellum.command_age_ns(self.bridge.now_ns),
            mode=self.cerebellum.mode.copy(),
            touched=self._touched.copy(),
        )

    def render(self, sim: int, camera: str = "front") -> NDArray[np.uint8]:
        """Return what a camera of one robot sees now, shape (height, width, 3)."""
        if self._camera is None:
            self._camera = Camera(self.world, self.config.camera_width, self.config.camera_height)
        return self._camera.render(sim, camera)

    def start_rendering(self) -> None:
        """Get ready for `render_later`.

        Raises:
            RenderingError: no image can be rendered here.
        """
        if self._render_thread is None:
            self._render_thread = RenderThread(self.world, self.config.camera_width, self.config.camera_height)

    def render_later(self, sim: int, camera: str, deliver: Deliver | None = None) -> Future[NDArray[np.uint8]]:
        """Return what a camera of one robot sees now, as an image to come; the simulation may go on meanwhile.

        Args:
            sim: the robot.
            camera: the camera.
            deliver: called with the image, in the order of the calls, on another thread.
        """
        self.start_rendering()
        if self._render_thread is None:
            raise AssertionError("Rendering was just started.")
        return self._render_thread.submit(sim, camera, deliver)

    def close(self) -> None:
        """Free the renderers. May be called twice."""
        if self._render_thread is not None:
            self._render_thread.close()
            self._render_thread = None
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    @property
    def physics_state(self) -> NDArray[np.float64]:
        """Generalised positions and velocities, shape (n, nq + nv), a copy."""
        return np.concatenate([self.world.qpos, self.world.qvel], axis=1)

    def restore_physics(self, sim: int, state: NDArray[np.float64]) -> None:
        """Put one robot into a recorded `physics_state`; sensors follow, the cerebellum is left alone."""
        nq = self.world.qpos.shape[1]
        self.world.qpos[sim], self.world.qvel[sim] = state[:nq], state[nq:]
        self.world.forward(np.array([sim]))

    def snapshot(self, ids: NDArray[np.intp] | None = None) -> Snapshot:
        """Return the physics of simulations: to continue from there with the same commands, bit-exactly."""
        return self.world.snapshot(ids)

    def scan_now(self, ids: NDArray[np.intp]) -> None:
        """Take a scan outside of the lidar's own rhythm; it continues from here."""
        self._scan(np.asarray(ids, np.intp))

    # --- inside a tick -----------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        for _ in range(self.rates.steps_per_tick):
            # One by one: a touch may last a single step, and the sensor tells of the last one only.
            self.world.step(1, self._active)
            np.logical_or(self._touched, self._touch, out=self._touched)
        self._tick += 1
        if self._tick >= self._next_scan:
            due = self.running & (self._tick - self._scanned_tick >= self._scan_ticks)
            self._scan(np.flatnonzero(due))

    def _scan(self, ids: NDArray[np.intp]) -> None:
        if len(ids):
            self.lidar.scan(self._rngs, ids)
            self._scanned_tick[ids] = self._tick
        running = self._scanned_tick[self.running]
        self._next_scan = (int(running.min()) if len(running) else self._tick) + self._scan_ticks


def observation_names(config: TurtleBot3Config) -> tuple[str, ...]:
    """Return the names of the observation's floats, in order."""
    names = ["x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(config.beams))]
    if config.odometry:
        names += ["x.pos", "y.pos", "theta.pos"]
    if config.imu:
        names += ["imu_x.vel", "imu_y.vel", "imu_z.vel"]
    return tuple(names)


def describe(config: TurtleBot3Config) -> dict[str, Any]:
    """Return everything about the robot that shapes its data, as plain values."""
    plain = {key: value for key, value in vars(config).items() if key not in ("id", "calibration_dir", "seed", "arena")}
    return {"type": config.type, **plain}
