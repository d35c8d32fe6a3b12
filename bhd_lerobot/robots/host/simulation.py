"""n simulated robots: a host with a world."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import MAX_LATENCY_S
from bhd_lerobot.control.commands import Command
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import new_states
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.robots import Acceptance, Deliver, FrameReport
from bhd_lerobot.robots.parts.latency import LatePlant
from bhd_lerobot.robots.parts.part import GYROSCOPE, SimulatedPart
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.frames import Frames
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.render_thread import RenderThread
from bhd_lerobot.sim.world import Snapshot, World

# Streams of random numbers of one episode: what one draws more of must not shift the others.
SENSOR_STREAM = 1
_NONE = np.zeros(0, np.intp)
_HOOKS = ("advance", "_after_step", "_after_tick", "run_ticks")


class Simulation(Host):
    """n simulated robots of one kind.

    Nothing outside an episode can change it, not even the number of threads.

    Args:
        config: the robot's configuration.
        n: how many.
        threads: threads that step the physics; all processors if None.
        planning: who plans goals; they are planned in the tick that they start in if None.
        fixtures: what stands immovable on the tables of arms, unknown to them.

    Attributes:
        rngs: random numbers of each robot's sensors.
        view: the camera outside of the robot, for videos.
        video_speed: how much faster than the robot was a video of it is shown.
        on_change: is called at the start of episodes, with robots and scenes, and with none of them at the end of a
            frame.
    """

    world: World
    parts: list[SimulatedPart]  # type: ignore[assignment]
    on_change: Callable[[NDArray[np.intp], Sequence[Any]], None] | None = None

    def __init__(
        self,
        config: Any,
        n: int = 1,
        threads: int | None = None,
        planning: Planning | None = None,
        *,
        fixtures: Sequence[Shape] = (),
    ) -> None:
        body = config.body()
        self.world = world = World(body, n, physics_hz=config.physics_hz, threads=threads, fixtures=fixtures)
        self.rngs = [np.random.default_rng(0) for _ in range(n)]
        joints, plant = SimulatedPlant(world), None
        if body.arm is not None:
            plant = LatePlant(joints, len(body.joints), round(MAX_LATENCY_S * config.control_hz))
        names = tuple(body.cameras) if config.camera else ()
        super().__init__(config, plant or joints, planning, camera_names=names)
        self.view, self.video_speed = ("overview", 1) if body.drive is None else ("follow", 4)
        self._touches = np.zeros((sum(part.touch_kinds for part in self.parts), n), np.bool_)
        first = 0
        for part in self.parts:
            part.touches = self._touches[first : (first := first + part.touch_kinds)]
        self._touched = tuple(self._touches)
        states = new_states(n)
        self._reading, self._read_tick = PlantReading(n, self.controller.joints, states=states), -1
        gyro = {"gyro": GYROSCOPE, "beams": config.beams} if body.drive is not None and config.imu else {}
        self._frames = Frames(world, self.cerebellum, self._touches, states, late=plant, brakes=joints.brakes, **gyro)
        self._active: NDArray[np.intp] | None = None
        self._camera: Camera | None = None
        self._render_thread: RenderThread | None = None

    def _make_parts(self, planning: Planning | None) -> list[Any]:
        body, plant, parts = self.body, self.plant, list[SimulatedPart]()
        if isinstance(plant, LatePlant):
            from bhd_lerobot.robots.parts.simulated_arm import SimulatedArm  # imports Pinocchio

            parts.append(SimulatedArm(self.config, body, plant, self.world, planning))
        if body.drive is not None:
            from bhd_lerobot.robots.parts.simulated_drive import SimulatedDrive

            arm = parts[0].controller if parts else None
            parts.append(SimulatedDrive(self.config, body, plant, self.world, arm))
        return parts

    @property
    def table(self) -> Any:
        """What lies on the tables of arms, a `Tabletop`."""
        return self._part("table").table

    @property
    def lidar(self) -> Any:
        """The range finders of bases, a `Lidar`."""
        return self._part("lidar").lidar

    def read(self) -> PlantReading:
        """Return the joints as they are now."""
        if self._read_tick != self.tick:
            self.plant.read(self._reading)
        self._read_tick = -1  # whatever comes next may move them
        return self._reading

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """What was touched since the start of the last frame, by kind, live, each of shape (n,).

        By an arm the table, objects with one of its links, and the arm itself; then by a base the scene.
        """
        return self._touched

    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Put robots into scenes, at rest at their start; `reset` does that and starts an episode."""
        for part in reversed(self.parts):  # an arm's objects stand on what is in the arena
            part.place(ids, scenes)
        self._touches[:, ids] = False
        self._read_tick = -1
        self._frames.forget()

    def privileged_state(self) -> NDArray[np.float64]:
        """Return what is true and no sensor measures, numbers around 1, shape (n, any); for a critic."""
        return np.concatenate([part.privileged_state() for part in self.parts], axis=1)

    def _after_step(self) -> None:
        """Do what a physics step brings with it: a touch may last a single one."""
        for part in self.parts:
            part.after_step()

    def _after_tick(self) -> None:
        """Do what a tick brings with it: sensors with a rhythm of their own."""
        for part in self.parts:
            part.after_tick()

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start episodes, see `Host.reset`; the noise of the sensors follows from the seeds."""
        for sim, seed in zip(ids, seeds, strict=True):
            self.rngs[sim] = np.random.default_rng(np.random.SeedSequence([SENSOR_STREAM, seed]))
        super().reset(ids, scenes, seeds)
        self._active = None if self.running.all() else np.flatnonzero(self.running)
        for part in self.parts:
            part.started(np.asarray(ids, np.intp))
        if self.on_change is not None:
            self.on_change(np.asarray(ids, np.intp), scenes)
        return self.snapshot(ids).state

    def stop(self, ids: NDArray[np.intp]) -> None:
        """Leave simulations alone from now on: they are neither stepped nor sensed before their next `reset`."""
        super().stop(ids)
        self._active = np.flatnonzero(self.running)

    def _frame(self, receipt: Acceptance, command: Command) -> FrameReport:
        report = super()._frame(receipt, command)
        self.world.check()
        if self.on_change is not None:
            self.on_change(_NONE, ())
        return report

    def render(self, sim: int, camera: str) -> NDArray[np.uint8]:
        """Return what a camera of one robot sees now, shape (height, width, 3)."""
        if self._camera is None:
            self._camera = Camera(self.world, self.config.camera_width, self.config.camera_height)
        return self._camera.render(sim, camera)

    def start_rendering(self) -> None:
        """Get ready for `render_later`."""
        if self._render_thread is None:
            self._render_thread = RenderThread(self.world, self.config.camera_width, self.config.camera_height)

    def render_later(self, sim: int, camera: str, deliver: Deliver | None = None) -> Future[NDArray[np.uint8]]:
        """Return what a camera of one robot sees now, as an image to come; see `Robots.render_later`."""
        self.start_rendering()
        if self._render_thread is None:
            raise AssertionError("Rendering was just started.")
        return self._render_thread.submit(sim, camera, deliver)

    def close(self) -> None:
        """Free renderers and threads. May be called twice."""
        self._frames.close()
        if self._render_thread is not None:
            self._render_thread.close()
            self._render_thread = None
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    @property
    def physics(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Generalised positions, shape (n, nq), and velocities, shape (n, nv), live."""
        return self.world.qpos, self.world.qvel

    def show(self, row: Any) -> None:
        """Take over what the process of a robot on the wall clock published beside its record."""
        self.restore_physics(0, row["physics"][0])

    def restore_physics(self, sim: int, state: NDArray[np.float64]) -> None:
        """Put one robot into a recorded `physics_state`; sensors follow, the cerebellum is left alone."""
        nq = self.world.qpos.shape[1]
        self.world.qpos[sim], self.world.qvel[sim] = state[:nq], state[nq:]
        self.world.forward(np.array([sim]))
        self._read_tick = -1

    @property
    def not_in_state(self) -> tuple[str, ...]:
        """Observed features that do not follow from a physics state."""
        return tuple(name for part in self.parts for name in part.not_in_state)

    def resense(self, sim: int, time_s: float, age_s: float) -> None:
        """Read again, in a restored state, what is not read every frame.

        Args:
            sim: the robot.
            time_s: when the state was recorded, since the episode's start [s].
            age_s: how old the oldest reading was then [s].
        """
        for part in self.parts:
            part.resense(sim, time_s, age_s)

    def snapshot(self, ids: NDArray[np.intp] | None = None) -> Snapshot:
        """Return the physics of simulations: to continue from there with the same commands, bit-exactly."""
        return self.world.snapshot(ids)

    # --- inside a tick -----------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Let one control tick go by, of the world and of the sensors that have a rhythm of their own."""
        self.world.step(self.rates.steps_per_tick, self._active, each=self._after_step)
        self.tick += 1
        self._after_tick()

    def load(self) -> None:
        """Load the machine code that ticks run; with that of frames, those of the control alone are not."""
        self.cerebellum.load(with_ticks=not (self._is_plain and self._frames.load()))

    def run_tick(self, now_ns: int, ticks: int) -> None:
        """Run one tick of control, and let the world go on by some, see `Host.run_tick`."""
        if not (self._is_plain and self._active is None and self._frames.tick(now_ns)):
            super().run_tick(now_ns, ticks)
            return
        self.tick += 1
        self._after_tick()
        self._read_tick = self.tick
        for _ in range(ticks - 1):
            self.advance()

    def run_ticks(self, number: int, most: int) -> int:
        """Run ticks in machine code, see `LockstepBridge`; none where somebody does something in between."""
        if not self._is_plain or any(hook in vars(self) for hook in _HOOKS):
            return 0
        left = [ticks for part in self.parts if (ticks := part.ticks_left())]
        ticks = min([most, *left])
        if not self._frames.run(self._active, number, ticks):
            return 0
        self.tick += ticks
        self._after_tick()
        return ticks

    @cached_property
    def _is_plain(self) -> bool:
        """Whether nothing but this class does something after steps and ticks."""
        return all(getattr(type(self), hook) is getattr(Simulation, hook) for hook in _HOOKS)
