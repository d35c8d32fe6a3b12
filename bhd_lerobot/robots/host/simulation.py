"""n simulated robots: a host with a world."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import Command
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.robots import Acceptance, Deliver, FrameReport
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.frames import Frames
from bhd_lerobot.sim.render_thread import RenderThread
from bhd_lerobot.sim.world import Snapshot, World

# Streams of random numbers of one episode: what one draws more of must not shift the others.
SENSOR_STREAM = 1
_NONE = np.zeros(0, np.intp)
_HOOKS = ("advance", "_after_step", "_after_tick", "run_ticks")
_PACKAGE = __name__.partition(".")[0]


class Simulation(Host):
    """n simulated robots of one kind.

    Nothing outside an episode can change it, not even the number of threads. A subclass makes world and cerebellum,
    passes them on to this constructor, and defines what is sensed and what is true.

    Args:
        config: the robot's configuration.
        cerebellum: what controls the robots.
        world: the physics, of n robots.
        options: those of `Host`.

    Attributes:
        host_class: the class of its host without a world, for a plant of its own.
        view: the camera outside of the robot, for videos.
        video_speed: how much faster than the robot was a video of it is shown.
        on_change: is called at the start of episodes, with robots and scenes, and with none of them at the end of a
            frame.
    """

    host_class: ClassVar[type[Host]]
    view = "overview"
    video_speed = 1
    knows = None
    world: World
    on_change: Callable[[NDArray[np.intp], Sequence[Any]], None] | None = None

    def __init__(self, config: Any, cerebellum: Cerebellum, *, world: World, **options: Any) -> None:
        self.world = world
        super().__init__(config, cerebellum, **options)
        self._active: NDArray[np.intp] | None = None
        self._rngs = [np.random.default_rng(0) for _ in range(self.n)]
        self._camera: Camera | None = None
        self._render_thread: RenderThread | None = None
        self._frames: Frames | None = None

    # --- what a subclass defines -------------------------------------------------------------------------------------

    @abstractmethod
    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Put robots into scenes, at rest at their start; `reset` does that and starts an episode."""

    @classmethod
    def start_scene(cls, config: Any) -> Any:
        """Return the scene that a configuration describes, for a robot that is used by itself."""
        raise NotImplementedError(f"{cls.__name__} has no start_scene.")

    def privileged_state(self) -> NDArray[np.float64]:
        """Return what is true and no sensor measures, numbers around 1, shape (n, any); for a critic."""
        return np.zeros((self.n, 0))

    def _started(self, ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        """Take first readings of what is not read every frame, at the start of episodes."""
        return

    def _after_step(self) -> None:
        """Do what a physics step brings with it: a touch may last a single one."""
        return

    def _after_tick(self) -> None:
        """Do what a tick brings with it: sensors with a rhythm of their own."""
        return

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start episodes, see `Host.reset`; the noise of the sensors follows from the seeds."""
        for sim, seed in zip(ids, seeds, strict=True):
            self._rngs[sim] = np.random.default_rng(np.random.SeedSequence([SENSOR_STREAM, seed]))
        super().reset(ids, scenes, seeds)
        self._active = None if self.running.all() else np.flatnonzero(self.running)
        self._started(np.asarray(ids, np.intp), seeds)
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
        if self._frames is not None:
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

    @property
    def not_in_state(self) -> tuple[str, ...]:
        """Observed features that do not follow from a physics state."""
        return ()

    def resense(self, sim: int, time_s: float, age_s: float) -> None:
        """Read again, in a restored state, what is not read every frame.

        Args:
            sim: the robot.
            time_s: when the state was recorded, since the episode's start [s].
            age_s: how old the oldest reading was then [s].
        """
        return

    def snapshot(self, ids: NDArray[np.intp] | None = None) -> Snapshot:
        """Return the physics of simulations: to continue from there with the same commands, bit-exactly."""
        return self.world.snapshot(ids)

    # --- inside a tick -----------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Let one control tick go by, of the world and of the sensors that have a rhythm of their own."""
        self.world.step(self.rates.steps_per_tick, self._active, each=self._after_step)
        self.tick += 1
        self._after_tick()

    def run_ticks(self, number: int, most: int) -> int:
        """Run ticks in machine code, see `LockstepBridge`; none where a subclass of ours does something in between."""
        frames = self._frames
        if frames is None or not self._is_plain or any(hook in vars(self) for hook in _HOOKS):
            return 0
        if not frames.run(self._active, number, most):
            return 0
        self.tick += most
        self._after_tick()
        return most

    @cached_property
    def _is_plain(self) -> bool:
        """Whether nothing but its own class does something after steps and ticks."""
        own = next(
            kind for kind in type(self).__mro__ if kind.__module__.startswith(_PACKAGE) and "place" in vars(kind)
        )
        return all(getattr(type(self), hook) is getattr(own, hook) for hook in _HOOKS)
