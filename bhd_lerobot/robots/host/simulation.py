"""n simulated robots under one cerebellum: what a LeRobot `Robot` and the batched runs are both made of."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, Chunk, Command, CommandResult, Goals, Mixed
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Reason, SendResult
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.timing import TimingStatistics
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.render_thread import Deliver, RenderThread
from bhd_lerobot.sim.world import Snapshot, World

# Streams of random numbers of one episode: what one draws more of must not shift the others.
SENSOR_STREAM = 1


@dataclass(frozen=True)
class Frame:
    """The observation at the start of a frame, of n robots.

    Attributes:
        state: the observation's floats, shape (n, features).
        time_ns: when it was measured, since the episode's start [ns], shape (n,).
        age_ns: age of the oldest reading in it [ns], shape (n,).
    """

    state: NDArray[np.float64]
    time_ns: NDArray[np.int64]
    age_ns: NDArray[np.int64]


@dataclass(frozen=True)
class FrameReport:
    """Report of a frame, of n robots.

    Attributes:
        applied: the command at the end of the frame, in the space of the actions, shape (n, actions).
        sent: what became of the setpoints that the frame began with.
        limits: `Limit` flags, shape (n,).
        watchdog: `Watchdog` flags, shape (n,).
        command_age_ns: age of the command in force at the end of the frame [ns], shape (n,).
        mode: `Mode` at the end of the frame, shape (n,).
        results: how goals ended, or were refused, during the frame, by simulation.
        refusals: in words why setpoints were refused, by simulation, where a `Reason` does not say it all.
        live: the `LiveFrame` of a robot on the wall clock.
        missed: the frames before this one that went by on the wall clock during inference.
    """

    applied: NDArray[np.float64]
    sent: SendResult
    limits: NDArray[np.int64]
    watchdog: NDArray[np.int64]
    command_age_ns: NDArray[np.int64]
    mode: NDArray[np.int8]
    results: Mapping[int, Sequence[CommandResult]] = field(default_factory=dict)
    refusals: Mapping[int, str] = field(default_factory=dict)
    live: Any = None
    missed: list["FrameReport"] = field(default_factory=list)


@dataclass
class Receipt:
    """What was accepted of a command, of n robots.

    Attributes:
        sent: what became of setpoints.
        refusals: why setpoints were refused, in words, by simulation, where a `Reason` does not say it all.
        results: goals that were refused, by simulation.
    """

    sent: SendResult
    refusals: dict[int, str] = field(default_factory=dict)
    results: dict[int, list[CommandResult]] = field(default_factory=dict)

    def refuse(self, refused: Mapping[int, tuple[Reason, str]]) -> None:
        """Add setpoints that were refused, by simulation: reason and words."""
        for sim, (reason, message) in refused.items():
            self.sent.reasons[sim], self.refusals[sim] = reason, message

    def all_results(self, sim: int, ended: list[CommandResult]) -> list[CommandResult]:
        """Return the goals of a robot that ended, with its refused ones: a refusal is a result, too, but only once."""
        return [result for result in self.results.get(sim, ()) if result not in ended] + ended


class Simulation(ABC):
    """n simulated robots of one kind.

    Each is in an episode of its own, which nothing outside it can change: not the number of the others, not what they
    do, not the number of threads. A subclass makes world and cerebellum, passes them on to this constructor, and
    defines what is sensed and what is true.

    Args:
        config: the robot's configuration.
        world: the physics, of n robots.
        cerebellum: what controls the robots.
        action_names: names of the action's floats, in order.
        observation_names: names of the observation's floats, in order.
        camera_names: the cameras that are observed.
        bridge: how commands get to the cerebellum; a `LockstepBridge` that steps this simulation if None.

    Attributes:
        robot_kind: what tasks and brains are for: ``"base"`` or ``"arm"``.
        config: the robot's configuration.
        n: how many robots.
        rates: the rates.
        body: the robot's hardware.
        world: the physics.
        cerebellum: what controls the robots.
        bridge: how commands get there.
        action_names: names of the action's floats, in order.
        observation_names: names of the observation's floats, in order.
        camera_names: the cameras that are observed.
        view: the camera outside of the robot, for videos.
        video_speed: how much faster than the robot was a video of it is shown.
        running: which robots are in an episode, shape (n,).
        is_live: whether it runs on the wall clock, in processes of its own.
        sensor_period_s: time between two readings of the slowest sensor [s]; 0 if all are read at every tick.
        grants: what the real-time process was granted and refused, as plain values; None on the lockstep clock.
    """

    robot_kind: ClassVar[str]
    action_names: tuple[str, ...]
    view = "overview"
    video_speed = 1
    is_live = False
    sensor_period_s = 0.0
    grants: list[dict[str, Any]] | None = None

    def __init__(
        self,
        config: Any,
        world: World,
        cerebellum: Cerebellum,
        *,
        action_names: Sequence[str],
        observation_names: Sequence[str],
        camera_names: Sequence[str],
        bridge: LockstepBridge | None = None,
    ) -> None:
        n = cerebellum.n
        self.config, self.n, self.rates, self.body = config, n, config.rates, cerebellum.body
        self.world, self.cerebellum = world, cerebellum
        self.bridge = bridge or LockstepBridge(cerebellum, self.rates, self.advance)
        self.action_names, self.observation_names = tuple(action_names), tuple(observation_names)
        self.camera_names = tuple(camera_names)
        self.running = np.ones(n, np.bool_)
        self._active: NDArray[np.intp] | None = None
        self.tick = 0
        self._start_tick = np.zeros(n, np.int64)
        self._rngs = [np.random.default_rng(0) for _ in range(n)]
        self._reading = PlantReading(n, cerebellum.controller.joints)
        self._camera: Camera | None = None
        self._render_thread: RenderThread | None = None

    # --- what a kind of robot defines --------------------------------------------------------------------------------

    @abstractmethod
    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Put robots into scenes, at rest at their start; `reset` does that and starts an episode."""

    @abstractmethod
    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the robot was in recorded states: the pose of its base, or of its tool.

        Args:
            states: recorded `physics_state`, shape (frames, nq + nv).

        Returns:
            x, y, z [m] and a quaternion w, x, y, z, shape (frames, 7).
        """

    def _started(self, ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        """Take first readings of what is not read every frame, at the start of episodes."""
        return

    @abstractmethod
    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the observation's floats, shape (n, features), and the tick of the oldest reading, shape (n,)."""

    @abstractmethod
    def truth(self, report: FrameReport | None = None) -> Any:
        """Return the ground truth that a task judges by; touches since the start of the last frame.

        Args:
            report: the frame at the end of which it is true; only on the wall clock it need not be the last.
        """

    @property
    @abstractmethod
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """What was touched since the start of the last frame, by kind, live, each of shape (n,)."""

    def _step(self) -> None:
        """Let one control tick of physics go by."""
        self.world.step(self.rates.steps_per_tick, self._active)

    def _after_tick(self) -> None:
        """Do what a tick brings with it: sensors with a rhythm of their own."""
        return

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return commands of the cerebellum, shape (n, width), in the space of the actions, shape (n, actions)."""
        return command.copy()

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], dict[int, tuple[Reason, str]]]:
        """Turn actions into setpoints of the cerebellum, shape (n, width), and say which cannot be, and why.

        Args:
            action: shape (n, actions).
            mask: the robots that they are for, shape (n,).
            before: the setpoints before these, shape (n, width); the present commands if None.
        """
        return action, {}

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> None:
        """Start episodes: put the robots into their scenes, at rest at the start, and take first readings.

        Args:
            ids: the simulations.
            scenes: where each of them is.
            seeds: a seed for each of them; their sensors' noise follows from it.
        """
        ids = np.asarray(ids, np.intp)
        self.place(ids, scenes)
        for sim, seed in zip(ids, seeds, strict=True):
            self._rngs[sim] = np.random.default_rng(np.random.SeedSequence([SENSOR_STREAM, seed]))
        self.bridge.restart(ids)
        self._start_tick[ids] = self.tick
        self.running[ids] = True
        self._active = None if self.running.all() else np.flatnonzero(self.running)
        self._started(ids, seeds)

    def stop(self, ids: NDArray[np.intp]) -> None:
        """Leave simulations alone from now on: they are neither stepped nor sensed before their next `reset`."""
        self.running[ids] = False
        self._active = np.flatnonzero(self.running)

    # --- frames ------------------------------------------------------------------------------------------------------

    def observe(self) -> Frame:
        """Return what the robots see now."""
        state, oldest = self.sense()
        now = (self.tick - self._start_tick) * NANOSECONDS // self.rates.control_hz
        measured = (oldest - self._start_tick) * NANOSECONDS // self.rates.control_hz
        return Frame(state, now, now - measured)

    def step(self, command: Command) -> FrameReport:
        """Send a command to the running robots and let one frame go by.

        Args:
            command: what they are to do; None continues with the last chunk or goal.
        """
        return self._frame(self.send(command))

    def send(self, command: Command) -> Receipt:
        """Send a command to the running robots; no time goes by. Return what was accepted of it."""
        receipt = Receipt(SendResult(np.zeros(self.n, np.int8)))
        match command:
            case None:
                pass
            case Chunk(actions):
                self._send_chunk(actions, receipt)
            case Goals(commands):
                self._submit(commands, receipt)
            case Mixed(actions, by_goals, commands):
                self._submit({sim: goals for sim, goals in commands.items() if by_goals[sim]}, receipt)
                self._send_setpoint(actions, self.running & ~by_goals, receipt)
            case _:
                self._send_setpoint(command, self.running, receipt)
        return receipt

    def _send_setpoint(self, action: NDArray[np.float64], mask: NDArray[np.bool_], receipt: Receipt) -> None:
        if not mask.any():
            return
        setpoints, refused = self.to_setpoints(action, mask)
        if refused:
            mask = mask.copy()
            mask[list(refused)] = False
        receipt.sent = self.bridge.send(setpoints, mask)
        receipt.refuse(refused)

    def _send_chunk(self, actions: NDArray[np.float64], receipt: Receipt) -> None:
        rows: list[NDArray[np.float64]] = []
        for action in actions:
            setpoints, refused = self.to_setpoints(action, self.running, rows[-1] if rows else None)
            receipt.refuse(refused)
            if refused:
                break  # the actions before it are sent
            rows.append(setpoints)
        results = self._send_rows(np.array(rows)) if rows else []
        if results:
            # Of each robot, the first reason that is a refusal.
            reasons = np.array([result.reasons for result in results])
            first = reasons[(reasons != 0).argmax(axis=0), np.arange(self.n)]
            sent = receipt.sent.reasons
            sent[sent == Reason.ACCEPTED] = first[sent == Reason.ACCEPTED]

    def _send_rows(self, rows: NDArray[np.float64]) -> list[SendResult]:
        """Send the setpoints of a chunk, shape (frames, n, width)."""
        return self.bridge.send_chunk(rows, self.running)

    def _submit(self, commands: Mapping[int, Sequence[BrainCommand]], receipt: Receipt) -> None:
        for sim, goals in commands.items():
            refusals = [refusal for goal in goals if (refusal := self.bridge.submit(goal, sim)) is not None]
            if refusals:
                receipt.results[sim] = refusals

    def _frame(self, receipt: Receipt) -> FrameReport:
        """Let one frame go by, and report what happened in it and to the command that it began with."""
        for flags in self.touches:
            flags[:] = False
        self.bridge.advance_frame()
        self.world.check()
        limits, watchdog = self.cerebellum.take_flags()
        limits[list(receipt.refusals)] |= int(Limit.POSTURE)
        running = np.flatnonzero(self.running).tolist()
        results = {sim: receipt.all_results(sim, self.bridge.take_results(sim)) for sim in running}
        return FrameReport(
            applied=self.to_action(self.cerebellum.command),
            sent=receipt.sent,
            limits=limits,
            watchdog=watchdog,
            command_age_ns=self.cerebellum.command_age_ns(self.bridge.now_ns),
            mode=self.cerebellum.mode.copy(),
            results={sim: ended for sim, ended in results.items() if ended},
            refusals=receipt.refusals,
        )

    def render(self, sim: int, camera: str) -> NDArray[np.uint8]:
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

    def statistics(self) -> TimingStatistics:
        """Return how punctual the ticks of the present episode are: on time, by construction, on the lockstep clock."""
        return self.bridge.timing

    @property
    def modes(self) -> NDArray[np.int8]:
        """The present `Mode` of each robot, shape (n,)."""
        return self.cerebellum.mode

    @property
    def physics_state(self) -> NDArray[np.float64]:
        """Generalised positions and velocities, shape (n, nq + nv), a copy."""
        return np.concatenate([self.world.qpos, self.world.qvel], axis=1)

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
        """Let one control tick of the plant go by, and of the sensors that have a rhythm of their own."""
        self._step()
        self.tick += 1
        self._after_tick()


def describe(config: Any) -> dict[str, Any]:
    """Return everything about a robot that shapes its data, as plain values."""
    left_out = ["id", "calibration_dir", "seed", "arena", "scene", "realtime"]
    if config.clock == "lockstep":
        left_out.append("require_realtime")  # it has no effect
    values = {key: value for key, value in vars(config).items() if key not in left_out}
    return {
        "type": config.type,
        **values,
        **({"realtime": asdict(config.realtime)} if config.clock == "realtime" else {}),
    }
