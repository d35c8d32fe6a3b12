"""Records what others command a robot on the wall clock to do, beside what commands it."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Command, CommandResult
from bhd_lerobot.datasets.format.identity import local_name
from bhd_lerobot.datasets.storage.atomic import is_free
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import BhdError, as_text
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.recording.config import PassiveRecordConfig
from bhd_lerobot.recording.onlooker import Onlooker
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.provenance import episode_metadata
from bhd_lerobot.rollout.recorder import Recording, closing_used, open_recorder, save_episode
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.free import FreeConfig, FreeTask
from bhd_lerobot.tasks.task import Event, episode_seed


class _Commanded(FreeTask):
    """What others make of a robot; its truth is the event that a frame ends with."""

    def judge(self, truth: Any, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        reward, timed = super().judge(truth, running)
        return reward, np.where(running & (truth != Event.NOTHING), truth, timed)

    def parameters(self) -> dict[str, Any]:
        """Return the type alone: a dataset may hold several instructions."""
        return {"type": self.name}


class _Others(Brain):
    """Those who command the robot."""

    name = "bridge"
    uses_privileged_state = False

    def bind(self, robot: RobotFeatures) -> None:
        pass

    def act(self, observation: Observation) -> Command:
        return None

    def parameters(self) -> dict[str, Any]:
        return {"type": self.name}


class PassiveRecording:
    """A dataset of what a robot does; it is opened at once, and recorded by a thread of its own after `begin`.

    An error of the recording is reported and ends it; the robot goes on. The end of the context saves the running
    episode and finalises the dataset.

    Args:
        options: what is recorded.
        mirror: a host like the one that will run, for this object alone.
        report: takes a line, from any thread.
        ended: is set as soon as nothing more is to be recorded.

    Raises:
        ConfigError, DatasetError: the dataset cannot be made, or is not one of this robot.
    """

    def __init__(
        self, options: PassiveRecordConfig, mirror: Host, report: Callable[[str], None], ended: threading.Event
    ) -> None:
        self._report, self._ended, self._is_lost = report, ended, False
        self._onlooker = Onlooker(mirror, options.idle_s, self._ending)
        self._make_task = lambda: _Commanded(
            FreeConfig(options.task, options.episode_time_s, "empty"), 1, mirror.rates.fps, mirror.body
        )
        self._thread: threading.Thread | None = None
        self.root = root = Path(options.root).expanduser()
        self._is_new = is_free(root)
        recording = Recording(local_name(root), root, mirror.rates.fps, FreeConfig(), 0, "train", resume=True)
        self._recorder: DatasetRecorder = open_recorder(recording, mirror, self._make_task(), _Others(None))
        if self._recorder.repair_report:
            report(f"Repaired before resuming: {self._recorder.repair_report}")

    def begin(self, host: LiveHost) -> None:
        """Record a robot from now on."""
        self._onlooker.attach(host.link.block.name, host.link.grants)
        self._report(f"Recording into {self.root}, from episode {self._recorder.num_episodes} on.")
        self._thread = threading.Thread(target=self._run, name="bhd-recording", daemon=True)
        self._thread.start()

    def goal_ended(self, result: CommandResult) -> None:
        """Take the result of a goal, with which the running episode ends."""
        self._onlooker.results.append((time.monotonic_ns(), result))

    def __enter__(self) -> Self:
        """Return the recording itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Save the running episode, a fault if the robot's processes have ended, and finalise."""
        self._is_lost = kind is not None
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        else:
            with closing_used(self._recorder, is_new=self._is_new):
                pass

    def _ending(self) -> Event | None:
        if not self._ended.is_set():
            return None
        return Event.FAULT if self._is_lost else Event.TIMEOUT

    def _run(self) -> None:
        """Record until all is over; nothing that goes wrong gets out."""
        try:
            with closing_used(self._recorder, is_new=self._is_new):
                while self._onlooker.wait():
                    for episode in self._episodes():
                        self._save(episode)
            self._report(f"The dataset {self.root} has {self._recorder.num_episodes} episodes.")
        except Exception as error:
            why = [
                str(error) if isinstance(error, BhdError) else f"{as_text(error)}.",
                *getattr(error, "__notes__", ()),
            ]
            self._report(f"Recording has ended, the robot goes on. {' '.join(why)}")
        finally:
            self._onlooker.close()

    def _episodes(self) -> Sequence[Episode]:
        index = self._recorder.num_episodes
        loop = EpisodeLoop(self._onlooker, self._make_task(), _Others(None))
        return list(loop.run([EpisodeSpec(index, episode_seed(0, index, "train"))]))

    def _save(self, episode: Episode) -> None:
        brain, result = {"type": _Others.name}, self._onlooker.ended_by
        if result is not None:
            brain |= {"goal": result.task_id, "result": result.code.name.lower(), "message": result.message}
        metadata = episode_metadata(episode, split="train", task=self._make_task().parameters(), brain=brain)
        save_episode(self._recorder, episode, metadata)
        duration_s = episode.duration_s(self._recorder.fps)
        name = "" if result is None else f", goal {result.task_id}"
        self._report(f"Episode {episode.spec.index} is saved: {episode.outcome.event.cause}, {duration_s:.1f} s{name}.")
