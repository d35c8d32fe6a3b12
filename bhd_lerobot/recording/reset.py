"""The time between two episodes of a real robot: a person sets up the scene, and may drive the robot meanwhile."""

import time
from collections.abc import Callable

import numpy as np
from rich.console import Console

from bhd_lerobot.control.commands import Command
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.errors import BrainStoppedError
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.rollout.marks import Marks
from bhd_lerobot.rollout.types import EpisodeSpec

_POLL_S = 0.05


class ResetPhase:
    """Waits before every episode but the first; a teleoperator drives the robot meanwhile, and nothing is recorded.

    Args:
        robots: one robot on the wall clock.
        brain: what drives it; only a `TeleopBrain` does so here.
        marks: takes Enter, which ends the wait, and the pause.
        seconds: how long to wait [s]; with a pause until Enter.
        stop: whether the run is to end.
        console: where what is to be done is printed.
    """

    def __init__(
        self, robots: Robots, brain: Brain, marks: Marks, seconds: float, *, stop: Callable[[], bool], console: Console
    ) -> None:
        self._robots, self._brain, self._marks, self._seconds = robots, brain, marks, seconds
        self._stop, self._console = stop, console
        self._is_first = True

    def __call__(self, spec: EpisodeSpec) -> None:
        """Wait before an episode."""
        is_first, self._is_first = self._is_first, False
        if is_first or not (self._seconds or self._marks.is_paused):
            return
        wait = "Paused." if self._marks.is_paused else f"{self._seconds:g} s to set up the scene."
        self._console.print(f"{wait} Enter begins episode {spec.index}.")
        end = time.monotonic() + self._seconds
        with self._marks.waiting() as is_pressed:

            def goes_on() -> bool:
                is_waiting = self._marks.is_paused or time.monotonic() < end
                return is_waiting and not (is_pressed() or self._stop() or self._robots.estop_pressed)

            self._drive(goes_on)

    def _drive(self, goes_on: Callable[[], bool]) -> None:
        if not isinstance(self._brain, TeleopBrain):
            while goes_on():
                time.sleep(_POLL_S)
            return
        robots, only = self._robots, np.zeros(1, np.intp)
        robots.reset(only, [None], [0])
        self._brain.reset(only, [0], 1)
        try:
            while goes_on():
                frame = robots.observe()
                command: Command = self._brain.act(Observation(robots.observation_names, frame.state))
                if robots.step(command).mode[0] in (Mode.ESTOP, Mode.FAULT):
                    return
        except BrainStoppedError as error:
            self._console.print(f"Nobody drives the robot: {error}.")
        finally:
            robots.stop(only)
