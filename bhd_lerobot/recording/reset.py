"""The time between two episodes of a real robot: a person sets up the scene, and may drive the robot meanwhile."""

import time
from collections.abc import Callable

import numpy as np
from rich.console import Console

from bhd_lerobot.control.commands import Command
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.errors import BrainStoppedError, RealtimeError
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.recording.status import RecordStatus
from bhd_lerobot.recording.takes import Takes
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.rollout.marks import Marks
from bhd_lerobot.rollout.types import EpisodeSpec

_POLL_S = 0.05


class ResetPhase:
    """Waits before every episode but the first; a teleoperator drives the robot meanwhile, and nothing is recorded.

    The take before is saved meanwhile; it may be discarded until the next begins.

    Args:
        robots: one robot on the wall clock.
        brain: what drives it; only a `TeleopBrain` does so here.
        marks: takes Enter, which ends the wait, the pause, and the key that discards the last take.
        seconds: how long to wait [s]; with a pause until Enter.
        stop: whether the run is to end.
        console: where what is to be done is printed.
        status: what the person sees.
        takes: what saves the takes; None if something else does.
    """

    def __init__(
        self,
        robots: Robots,
        brain: Brain,
        marks: Marks,
        seconds: float,
        *,
        stop: Callable[[], bool],
        console: Console,
        status: RecordStatus | None = None,
        takes: Takes | None = None,
    ) -> None:
        self._robots, self._brain, self._marks, self._seconds = robots, brain, marks, seconds
        self._stop, self._console, self._status, self.takes = stop, console, status, takes
        self._is_first = True

    def __call__(self, spec: EpisodeSpec) -> bool:
        """Wait before an episode; return whether the last take was discarded, and is to be recorded again.

        Raises:
            RealtimeError: the robot is in a fault.
            BhdError: the last take could not be saved.
        """
        is_first, self._is_first = self._is_first, False
        is_discarded = False
        if not is_first and (self._seconds or self._marks.is_paused):
            is_discarded = self._wait(spec)
        takes = self.takes
        if takes is not None:
            if takes.is_saving and self._status is not None:
                self._status.change("saving", spec.index - 1)
            (takes.discard if is_discarded else takes.wait)()
        return is_discarded

    def _wait(self, spec: EpisodeSpec) -> bool:
        last = self.takes and self.takes.last
        with self._marks.waiting(has_last=last is not None) as is_pressed:
            wait = "Paused." if self._marks.is_paused else f"{self._seconds:g} s to set up the scene."
            self._console.print(f"{wait} Enter begins episode {spec.index}.")
            if self._status is not None:
                self._status.change("reset", spec.index, self._seconds)
            end = time.monotonic() + self._seconds

            def goes_on() -> bool:
                is_waiting = self._marks.is_paused or time.monotonic() < end
                return is_waiting and not (is_pressed() or self._stop() or self._robots.estop_pressed)

            self._drive(goes_on)
            while goes_on():
                time.sleep(_POLL_S)
            return self._marks.take_again()

    def _drive(self, goes_on: Callable[[], bool]) -> None:
        """Let a teleoperator drive; one that fails drives no more, and the person sets up the scene all the same."""
        if not isinstance(self._brain, TeleopBrain):
            return
        robots, only = self._robots, np.zeros(1, np.intp)
        robots.reset(only, [None], [0])
        self._brain.reset(only, [0], 1)
        try:
            while goes_on():
                frame = robots.observe()
                command: Command = self._brain.act(Observation(robots.observation_names, frame.state))
                mode = robots.step(command).mode[0]
                if mode == Mode.FAULT:
                    raise RealtimeError(robots.problem)
                if mode == Mode.ESTOP:
                    return
        except BrainStoppedError as error:
            self._console.print(f"Nobody drives the robot: {error}.")
        finally:
            robots.stop(only)
