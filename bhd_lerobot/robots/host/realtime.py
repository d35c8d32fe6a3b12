"""A robot on the wall clock, with the interface of a `Host` of one.

Cerebellum, plant and recorder run in processes of their own. Here is a mirror: a host of the same kind that is put into
published states, to compute the truth that tasks judge by and, if it is a simulation, to render images.
"""

import itertools
import os
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand, Command
from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Reason, SendResult, Watchdog
from bhd_lerobot.control.timing import TimingStatistics
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.realtime.bridge import LiveBridge
from bhd_lerobot.robots.host.hardware import Unconnected, plant_class
from bhd_lerobot.robots.host.host import Frame, FrameReport, Host, Receipt
from bhd_lerobot.robots.host.link import LiveLink
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.host.state import raised
from bhd_lerobot.sim.render_thread import Deliver

_SILENCE_S = 2.0  # so long after it was due a frame that does not come means that the loop or the recorder is stuck


@dataclass(frozen=True)
class LiveFrame:
    """A frame that went by on the wall clock.

    Attributes:
        physics: the simulator's generalised positions and velocities at its start, shape (1, nq + nv).
        requested: the last setpoint of the brain by its end, in the space of the actions, shape (1, actions).
        lateness_ns: the latest start of one of its ticks [ns].
        overruns: its ticks that ended after the next was due.
    """

    number: int
    seen: Frame
    physics: NDArray[np.float64]
    requested: NDArray[np.float64]
    end: Any
    touches: NDArray[np.bool_]
    lateness_ns: int
    overruns: int
    skipped: int


class LiveHost(Host):
    """One robot on the wall clock.

    Attributes:
        mirror: this process's image of the robot.
        link: its processes.

    Args:
        mirror: a host of one robot: a simulation, or the host of a plant that is connected to nothing.
        name: name of the running robot, for `bhd-monitor`.

    Raises:
        RealtimeError: the processes could not be started, or real time is required and was refused.
    """

    def __init__(self, mirror: Host, name: str) -> None:
        self.mirror = mirror
        self.robot_kind, self.knows, self.is_simulated = mirror.robot_kind, mirror.knows, mirror.is_simulated  # type: ignore[misc]
        self.is_live, self.sensor_period_s = True, mirror.sensor_period_s
        self.link = LiveLink(mirror, mirror.config, name)
        self.grants = self.link.grants
        self.live_bridge = LiveBridge(self.link.block, mirror.rates, self.link.bridge_side.client, self.link.wait)
        super().__init__(
            mirror.config,
            mirror.cerebellum,
            action_names=mirror.action_names,
            observation_names=mirror.observation_names,
            camera_names=mirror.camera_names,
            bridge=self.live_bridge,  # type: ignore[arg-type]
        )
        self._frame_ns = NANOSECONDS // self.rates.fps
        self._reader: RingReader | None = None
        self._boundary: Any = None  # the newest boundary of a frame that was taken
        self._shown: Any = None  # the state that the mirror shows
        self._watchdog = Watchdog(0)  # of the last frame
        self._origin = 0  # when the episode's first observation was taken, monotonic [ns]

    # --- the mirror --------------------------------------------------------------------------------------------------

    def _show(self, state: Any, touches: NDArray[np.bool_] | None = None) -> None:
        if self._shown is not state:
            self._shown = state
            self.mirror.show(state)
        if touches is not None:
            for flag, touched in zip(self.mirror.touches, touches, strict=True):
                flag[:] = touched

    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Put the mirror into a scene; `reset` does that for a simulated robot, too."""
        self.mirror.place(ids, scenes)

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the robot was in recorded states, or observations, shape (frames, 7)."""
        return self.mirror.track(states)

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the newest observation's floats, shape (1, features), and the tick that it belongs to, shape (1,)."""
        state = self.live_bridge.latest
        return state["observation"].copy(), np.array([int(state["tick"])])

    def truth(self, report: FrameReport | None = None) -> Any:
        """Return what is true at the end of a frame; at the start of the present one if None."""
        if report is not None and report.live is not None:
            self._show(report.live.end, report.live.touches)
        elif self._shown is None and self._boundary is not None:
            self._show(self._boundary["state"])
        return self.mirror.truth()

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """What was touched in the frame that the mirror shows."""
        return self.mirror.touches

    @property
    def physics(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Generalised positions and velocities of the state that the mirror shows, live."""
        return self.mirror.physics

    @property
    def physics_state(self) -> NDArray[np.float64]:
        """Generalised positions and velocities at the start of the present frame, shape (1, nq + nv)."""
        if self._boundary is None:  # the episode's time has not begun
            return self.mirror.physics_state
        physics: NDArray[np.float64] = self._boundary["state"]["physics"].copy()
        return physics

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return commands of the cerebellum in the space of the actions."""
        return self.mirror.to_action(command)

    def initial_state(self, ids: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the mirror's physics: after a `reset` those that the episode begins with."""
        return self.mirror.initial_state(ids)

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> None:
        """Start an episode: put the robot into its scene. Its time begins with the first observation, or with `begin`.

        A real robot is driven to the start of the scene, if it is an arm; a base is put there by a person.

        Raises:
            RealtimeError: a process has ended or does not answer, or the robot does not get to the start.
        """
        link = self.link
        link.place(scenes[0], int(seeds[0]))
        goal = None if self.is_simulated else self.mirror.start_goal(scenes[0])
        if goal is not None:
            self._go_to_start(goal)
            link.place(scenes[0], int(seeds[0]))
        self.mirror.reset(ids, scenes, seeds)
        self.live_bridge.begin()
        self._reader = None
        self._boundary, self._shown = None, None
        self.running[:] = True

    def _go_to_start(self, goal: BrainCommand) -> None:
        self.live_bridge.begin()
        self.link.run()
        refusal = self.live_bridge.submit(goal)
        results = [] if refusal is None else [refusal]
        while not results:
            self.link.wait()
            results = self.live_bridge.take_results()
        self.link.pause()
        if not results[0].success:
            why = self.link.problem or f"{results[0].code.name}, {results[0].message.removesuffix('.')}"
            raise RealtimeError(
                f"The robot did not get to the start of the episode: {why}. Episodes that were saved are intact."
            )

    def begin(self) -> None:
        """Let the loop run, if it does not yet.

        Raises:
            RealtimeError: a process has ended or does not answer.
        """
        if self._reader is None:
            self._reader = self.link.log.reader()
            self._origin = self.link.run() - NANOSECONDS // self.rates.control_hz
            self._take(0)

    def stop(self, ids: NDArray[np.intp]) -> None:
        """End the episode: the loop stands."""
        if len(ids):
            self.running[:] = False
            self.link.pause()

    def observe(self) -> Frame:
        """Return the observation that the present frame began with; its age is what it is now."""
        self.begin()
        self._show(self._boundary["state"])
        return self._frame_of(self._boundary["state"], time.monotonic_ns())

    def latest(self) -> Frame:
        """Return the newest observation, whatever frame it is in.

        Raises:
            RealtimeError: a process has ended, or is stopped.
        """
        state = self._newest()
        self._show(state)
        return self._frame_of(state, time.monotonic_ns())

    def _newest(self) -> Any:
        """Return the newest state; the last state of a process that has ended, or is stopped, does not count."""
        self.link.check()
        state = self.live_bridge.latest
        silence = (time.monotonic_ns() - int(state["sensed_ns"])) / NANOSECONDS
        if self._reader is not None and self.running[0] and silence > _SILENCE_S:
            raise RealtimeError(
                f"The cerebellum's process ({self.link.pids['cerebellum']}) has published nothing for {silence:.1f} s: "
                "it is stopped, or gets no processor time. Disconnect and connect again."
            )
        return state

    def _frame_of(self, state: Any, seen_ns: int) -> Frame:
        sensed = int(state["sensed_ns"])
        age = max(0, seen_ns - sensed) + int(state["oldest_ns"])
        return Frame(state["observation"].copy(), np.array([sensed - self._origin]), np.array([age]))

    # --- frames ------------------------------------------------------------------------------------------------------

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], dict[int, tuple[Reason, str]]]:
        """Turn an action into a setpoint, from where the mirror is, and report why it cannot be."""
        return self.mirror.to_setpoints(action, mask, before)

    def send(self, command: Command) -> Receipt:
        """Send a command and return at once.

        Raises:
            RealtimeError: a process has ended, or is stopped.
        """
        self._show(self._newest())  # what a tool pose is solved from is where the arm is commanded to be
        return super().send(command)

    def _send_rows(self, rows: NDArray[np.float64]) -> list[SendResult]:
        return self.live_bridge.send_chunk(rows, int(self._boundary["frame"]) * self._frame_ns)

    def _frame(self, receipt: Receipt) -> FrameReport:
        """Wait for the end of the frame that it is now; frames that went by before are in `missed` of the report."""
        # Boundary k is the end of tick k F - 1, one period before k frames.
        now = time.monotonic_ns() - self._origin
        last = max(int(self._boundary["frame"]) + 1, now // self._frame_ns + 1)
        frames: list[tuple[LiveFrame, Any]] = []
        before = self._boundary
        while int(before["frame"]) < last:
            after = self._take(int(before["frame"]) + 1)
            frames.append((self._between(before, after), before))
            before = after
        results = receipt.all_results(0, self.live_bridge.take_results())
        reports = []
        for frame, begun in frames:
            is_last = frame is frames[-1][0]
            limits, watchdog = raised(begun["state"], frame.end)
            limits |= int(Limit.POSTURE) * (is_last and bool(receipt.refusals))
            reports.append(
                FrameReport(
                    applied=self.mirror.to_action(frame.end["command"]),
                    sent=receipt.sent if is_last else SendResult(np.zeros(1, np.int8)),
                    limits=np.array([limits]),
                    watchdog=np.array([watchdog]),
                    command_age_ns=np.array([int(frame.end["command_age_ns"])]),
                    mode=frame.end["mode"].copy(),
                    effort=frame.end["joint_efforts"].copy(),
                    wrench=frame.end["contact_wrench"].copy(),
                    results={0: results} if results and is_last else {},
                    refusals=receipt.refusals if is_last else {},
                    live=frame,
                )
            )
        *missed, report = reports
        self._watchdog = Watchdog(int(report.watchdog[0]))
        report.missed.extend(missed)
        return report

    def _between(self, before: Any, after: Any) -> LiveFrame:
        begun, end = before["state"], after["state"]
        return LiveFrame(
            number=int(before["frame"]),
            seen=self._frame_of(begun, int(begun["sensed_ns"])),  # a brain that did not observe it did not wait for it
            physics=begun["physics"].copy(),
            requested=self.mirror.to_action(end["requested"]),
            end=end,
            touches=end["touches"] > begun["touches"],
            lateness_ns=int(after["lateness_ns"]),
            overruns=int(end["overruns"] - begun["overruns"]),
            skipped=int(end["skipped"] - begun["skipped"]),
        )

    def _take(self, number: int) -> Any:
        """Wait for a boundary of this number or, if that one was lost, a later one."""
        link, reader = self.link, self._reader
        if reader is None:
            raise RealtimeError("The robot is in no episode. Call reset() first.")
        due = self._origin + number * self._frame_ns
        while True:
            entry = reader.read()
            if entry is not None and int(entry["state"]["segment"]) == int(link.block.words[Word.SEGMENT]):
                if int(entry["frame"]) >= number:
                    self._boundary = entry
                    return entry
                continue
            left = due - time.monotonic_ns()
            if left < -_SILENCE_S * NANOSECONDS:
                link.check()
                raise RealtimeError(
                    f"Frame {number} was due {_SILENCE_S:g} s ago and has not come: the real-time process or the "
                    "recorder is stopped, or gets no processor time. Without commands the robot holds by itself."
                )
            if left > 0:
                time.sleep(left / NANOSECONDS)
            else:
                link.wait()

    @property
    def problem(self) -> str:
        """What was wrong with the plant in its last fault, or which watchdog noticed something, as text."""
        noticed = ", ".join(str(flag.name).lower().replace("_", " ") for flag in self._watchdog)
        return self.link.problem or (f"watchdog: {noticed}" if noticed else "no watchdog says why")

    def statistics(self) -> TimingStatistics:
        """Return how punctual the ticks of the present episode are; live."""
        return TimingStatistics.view(self.link.block.section("statistics"))

    @property
    def modes(self) -> NDArray[np.int8]:
        """The newest `Mode`, shape (1,)."""
        mode: NDArray[np.int8] = self.live_bridge.latest["mode"].copy()
        return mode

    # --- images ------------------------------------------------------------------------------------------------------

    def render(self, sim: int, camera: str) -> NDArray[np.uint8]:
        """Return what a camera sees in the state that the mirror shows, shape (height, width, 3)."""
        return self.mirror.render(sim, camera)

    def start_rendering(self) -> None:
        """Get ready for `render_later`."""
        self.mirror.start_rendering()

    def render_later(self, sim: int, camera: str, deliver: Deliver | None = None) -> Future[NDArray[np.uint8]]:
        """Return what a camera sees in the state that the mirror shows, as an image to come."""
        return self.mirror.render_later(sim, camera, deliver)

    def close(self) -> None:
        """End the robot's processes and free the renderers. May be called twice."""
        super().close()
        self.mirror.close()
        self.link.close()


def make_live(simulation: type[Simulation], config: Any, name: str | None) -> LiveHost:
    """Return a robot on the wall clock: a simulated one, or with `config.plant` that of a plant.

    Args:
        simulation: the class of its simulation, which names that of its host.
        config: its configuration.
        name: the robot's id; its type and this process's number if None.

    Raises:
        ConfigError: there is no such plant.
        RealtimeError: its processes could not be started, or real time is required and was refused.
    """
    number = next(_nameless) if name is None else 0
    kind: Any = simulation
    if config.plant:
        plant_class(config.plant)  # what cannot be imported is found out before a process is started
        mirror: Host = kind.host_class(config, Unconnected())
    else:
        mirror = kind(config)
    return LiveHost(mirror, name or f"{config.type}-{os.getpid()}{f'-{number}' if number else ''}")


_nameless = itertools.count()  # several robots of one process that have no id
