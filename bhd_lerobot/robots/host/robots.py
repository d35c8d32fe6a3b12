"""`Robots`: what a loop needs from n robots: simulations, a cerebellum on the wall clock, or any LeRobot `Robot`."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Rates
from bhd_lerobot.control.commands import Command, CommandResult
from bhd_lerobot.control.messages import Reason, SendResult
from bhd_lerobot.realtime.timing import TimingStatistics

Deliver = Callable[[NDArray[np.uint8]], None]
"""Takes an image, shape (height, width, 3)."""


@dataclass(frozen=True)
class Frame:
    """The observation at the start of a frame, of n robots.

    Attributes:
        state: the observation's floats, shape (n, features).
        time_ns: when it was measured, since the episode's start [ns], shape (n,).
        age_ns: age of the oldest reading in it [ns], shape (n,).
        columns: further columns of the dataset that are true at the start of the frame, by key, each of shape (n, k).
    """

    state: NDArray[np.float64]
    time_ns: NDArray[np.int64]
    age_ns: NDArray[np.int64]
    columns: Mapping[str, NDArray] = field(default_factory=dict)


@dataclass(kw_only=True)
class ActionReport:
    """What became of a command, of n robots.

    Attributes:
        sent: the outcome of the setpoints.
        refusals: as text why they were refused, by simulation, where a `Reason` does not say it all.
        mode: `Mode` now, shape (n,).
        applied: the command that is applied now, in the space of the actions, shape (n, actions).
        results: how goals ended meanwhile, or were refused, by simulation.
    """

    sent: SendResult
    refusals: Mapping[int, str] = field(default_factory=dict)
    mode: NDArray[np.int8]
    applied: NDArray[np.float64]
    results: Mapping[int, Sequence[CommandResult]] = field(default_factory=dict)


@dataclass(kw_only=True)
class FrameReport(ActionReport):
    """Report of a frame, at its end, of n robots.

    Attributes:
        requested: the action that the brain had requested by then, shape (n, actions); of a goal, the command.
        limits: `Limit` flags, shape (n,).
        watchdog: `Watchdog` flags, shape (n,).
        truth: returns what a task judges by, as it was at the end of the frame.
        columns: further columns of the dataset, by key, each of shape (n,) or (n, k); see `Robots.columns`.
        number: of the frame in its episode, on the wall clock: frames may be lost.
        seen: the observation at its start, of a frame on the wall clock.
        missed: the frames before this one that went by on the wall clock during inference.
    """

    requested: NDArray[np.float64]
    limits: NDArray[np.int64]
    watchdog: NDArray[np.int64]
    truth: Callable[[], Any]
    columns: dict[str, NDArray] = field(default_factory=dict)
    number: int = 0
    seen: Frame | None = None
    missed: list["FrameReport"] = field(default_factory=list)


@dataclass
class Acceptance:
    """What was accepted of a command, of n robots.

    Attributes:
        refusals: why setpoints were refused, as text, by simulation, where a `Reason` does not say it all.
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


class Clock(Protocol):
    """The wall clock that robots run on.

    Attributes:
        sensor_period_s: time between two readings of the slowest sensor [s]; 0 if all are read at every tick.
        grants: what the real-time process was granted and refused, as plain values; None if there is none.
    """

    @property
    def sensor_period_s(self) -> float: ...  # noqa: D102

    @property
    def grants(self) -> list[dict[str, Any]] | None: ...  # noqa: D102

    def statistics(self) -> TimingStatistics:
        """Return how punctual the ticks of the present episode are; live."""


class Robots(Protocol):
    """n robots of one kind, each in an episode of its own."""

    @property
    def config(self) -> Any:
        """The robot's configuration."""

    @property
    def n(self) -> int:
        """How many robots."""

    @property
    def rates(self) -> Rates:
        """The rates."""

    @property
    def body(self) -> Body | None:
        """The robot's hardware; None if it is not known."""

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action's floats, in order."""

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's floats, in order."""

    @property
    def camera_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Image shapes (height, width, channels) [px] by camera name."""

    @property
    def columns(self) -> dict[str, tuple[str, ...]]:
        """What `Frame.columns` and `FrameReport.columns` hold: names of the values by key, none for a number."""

    @property
    def running(self) -> NDArray[np.bool_]:
        """Which robots are in an episode, shape (n,)."""

    @property
    def knows(self) -> frozenset[str] | None:
        """The fields of a task's truth that the robots measure; None if there is a world, of which all is known."""

    @property
    def world(self) -> Any:
        """The simulated world; None of real robots, whose episodes sensors or a person judge."""

    @property
    def clock(self) -> Clock | None:
        """The wall clock; None if time advances with `step` alone."""

    @property
    def problem(self) -> str:
        """Why robots were last stopped by a fault, as text; empty if that is not known."""

    @property
    def notes(self) -> list[str]:
        """What has to be known before they move, a line each, with Rich's markup."""

    @property
    def estop_pressed(self) -> bool:
        """Whether the emergency stop of any robot is pressed, be it latched already or not."""

    def estop(self) -> None:
        """Press the emergency stop of all robots."""

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start episodes of some robots in scenes; return the world's state then, shape (len(ids), k)."""

    def stop(self, ids: NDArray[np.intp]) -> None:
        """Leave robots alone from now on: their episodes are over."""

    def observe(self) -> Frame:
        """Return what the robots see at the start of the present frame."""

    def step(self, command: Command) -> FrameReport:
        """Send a command to the running robots, let one frame go by, and report it."""

    def truth(self) -> Any:
        """Return what a task judges by, as it is at the start of the present frame."""

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the robot was in recorded states: the pose of its base, or of its tool.

        Args:
            states: recorded `physics_state`, shape (frames, nq + nv); of a robot without a world, its observations,
                shape (frames, features).

        Returns:
            x, y, z [m] and a quaternion w, x, y, z, shape (frames, 7); no frames if it is not known.
        """

    def start_rendering(self) -> None:
        """Get ready for `render_later`."""

    def render_later(self, sim: int, camera: str, deliver: Deliver | None = None) -> Future[NDArray[np.uint8]]:
        """Return the image of a camera at the start of the present frame, as an image to come.

        Args:
            sim: the robot.
            camera: the camera.
            deliver: called with the image, in the order of the calls, on another thread.
        """

    def close(self) -> None:
        """Free everything. May be called twice."""
