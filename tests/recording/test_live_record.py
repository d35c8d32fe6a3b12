"""bhd-record on the wall clock: complete datasets, refusals, emergency stops, and what a kill leaves behind."""

import json
import os
import re
import signal
import time
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.cli.record import main
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetMismatchError, RealtimeError
from bhd_lerobot.realtime.shared_memory import names, sweep
from bhd_lerobot.recording.report import ESTOP_STATUS, RecordResult
from bhd_lerobot.tasks.avoid import AvoidTask
from bhd_lerobot.tasks.task import Event
from tests.forks import Terminal
from tests.recording.support import data_columns, options, run_record, saved
from tests.robots.host.support import is_alive, is_gone, unique
from tests.waiting import until

LIVE = {"robot__clock": "realtime", "robot__realtime__brain_timeout_s": 20, "robot__realtime__most_misses": 10**6}
LIVE |= {"dataset__num_episodes": 2, "dataset__episode_time_s": 2}
SO101 = str(resources.files("bhd_lerobot.bodies").joinpath("so101.xml"))
ARM = {"robot__type": "ur5", "robot__beams": None, "brain__type": "pick", "task__type": "pick"}


def run_live(root: Path, **overrides: object) -> tuple[RecordResult, str]:
    """Record on the wall clock, in this process; return the result and what was printed."""
    return run_record(root, **{**LIVE, **overrides})


def episodes(root: Path) -> list[dict[str, Any]]:
    return pq.read_table(root / "meta" / "episodes").to_pylist()


def test_an_arm_without_a_gripper_gets_to_its_goals(tmp_path):
    file = {"robot__mjcf": SO101, "robot__tool": "gripper_frame", "robot__gripper__name": "none"}
    names = {"robot__type": "arm", "robot__beams": None, "task__type": "reach", "brain__type": "reach"}
    result, _ = run_live(tmp_path / "d", **names, **file, dataset__episode_time_s=None, task__duration_s=60)
    assert (result.recorded, result.successes) == (2, 2)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("robot", [{}, ARM], ids=["turtlebot3", "ur5"])
def test_a_recording_is_complete_and_no_frame_is_lost_uncounted(tmp_path, robot):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root, name = tmp_path / "d", unique("record")
    result, text = run_live(root, robot__id=name, **robot)
    assert (result.recorded, result.exit_status) == (2, 0)
    assert f"kill -USR1 {os.getpid()}" in text
    assert is_gone(name)
    dataset = LeRobotDataset("test/avoid", root=root, video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames) == (2, result.frames)
    columns = {key: np.array(values) for key, values in data_columns(root).items()}
    info = dataset_info(root)
    assert info.compact
    for index, row in enumerate(episodes(root)):
        rows = columns["episode_index"] == index
        timing = json.loads(row["bhd/timing"])
        assert timing["clock"] == "realtime"
        if columns["event"][rows][-1] == Event.TIMEOUT:
            assert rows.sum() == 2 * dataset.fps
        assert timing["frames"] == rows.sum()
        # Every frame that was due by the end is there, or counted as lost. What a frame begins with was sensed no later
        # after it was due than the latest tick of the episode started, and took.
        times = columns["control.time"][rows].ravel()
        assert np.all(np.diff(times) > 0)
        last = rows.sum() + timing["drops"] - 1
        earliest = times[-1] - timing["lateness_max"] - timing["duration_max"]
        assert earliest * dataset.fps - 0.5 < last < times[-1] * dataset.fps + 0.5
        assert timing["ticks"] + timing["skipped"] >= rows.sum()
        assert (columns["control.age"][rows] >= 0).all()
        grants = json.loads(row["bhd/realtime"])
        assert {grant["name"] for grant in grants} >= {"scheduler", "memory lock"}


@pytest.mark.thorough
def test_an_episode_that_no_machine_could_keep_is_rejected_and_the_dataset_stays_as_it_was(tmp_path):
    root, name = tmp_path / "d", unique("reject")
    result, _ = run_live(root, robot__id=name, dataset__num_episodes=1, dataset__episode_time_s=1)
    assert result.recorded == 1
    before = data_columns(root)
    with pytest.raises(RealtimeError, match=r"Episode 1 exceeded the timing tolerance 3 times.*resume=true"):
        run_live(
            root,
            robot__id=name,
            dataset__episode_time_s=1,
            resume="true",
            timing__reject="true",
            timing__max_lateness_s=1e-9,
        )
    assert data_columns(root) == before
    assert len(dataset_info(root).episodes) == 1
    assert is_gone(name)


@pytest.mark.thorough
def test_a_dataset_of_a_version_that_read_frames_otherwise_is_continued(tmp_path):
    root, name = tmp_path / "d", unique("older")
    run_live(root, robot__id=name, dataset__num_episodes=1, dataset__episode_time_s=1)
    path = root / "meta" / "bhd.json"
    identity = json.loads(path.read_text())
    then = identity["recording"]["robot"]["realtime"]
    then |= {"buffer_s": 8.0, "recorder_timeout_s": 1.0, "plant_process": True}
    path.write_text(json.dumps(identity))
    again: Any = {"robot__id": name, "dataset__episode_time_s": 1, "resume": "true"}
    with pytest.raises(DatasetMismatchError, match="plant_process"):  # its observations were older
        run_live(root, **again)
    then["plant_process"] = False
    path.write_text(json.dumps(identity))
    result, _ = run_live(root, **again)
    assert result.recorded == 1
    assert json.loads(path.read_text())["recording"]["robot"]["realtime"] == then


@pytest.mark.thorough
def test_a_key_stops_the_robot_and_the_run_then_a_kill_and_it_goes_on_every_time(tmp_path, request):
    root, name = tmp_path / "d", unique("program")
    many = options(root, **{**LIVE, "robot__id": name, "dataset__num_episodes": 100})
    stopped = Terminal(main, many, log=tmp_path / "log")
    request.addfinalizer(stopped.kill)
    until(lambda: saved(root) >= 1 or stopped.poll() is not None, "an episode is saved")
    time.sleep(0.3)
    stopped.type(b" ")
    assert stopped.wait() == ESTOP_STATUS, stopped.text()
    text = " ".join(stopped.text().split())
    assert "space or e, or kill -USR1" in text
    assert "Emergency stop (key)" in text
    assert "--resume=true" in text
    assert is_gone(name)
    columns = {key: np.array(values) for key, values in data_columns(root).items()}
    assert int(columns["event"][-1]) == Event.ESTOP
    assert int(columns["control.mode"][-1]) == Mode.ESTOP
    assert not (columns["event"][:-1] == Event.ESTOP).any()
    assert not (columns["control.mode"][:-1] == Mode.ESTOP).any()
    assert dataset_info(root).compact
    before = saved(root)
    assert before >= 2

    killed = Terminal(main, [*many, "--resume=true"], log=tmp_path / "log")
    request.addfinalizer(killed.kill)
    until(lambda: saved(root) > before or killed.poll() is not None, "one more is saved")
    (child,) = Path(f"/proc/{killed.pid}/task/{killed.pid}/children").read_text().split()
    assert name in names()
    killed.kill()
    until(lambda: not is_alive(int(child)), "the robot's process ends by itself")
    sweep()
    assert is_gone(name)
    there = saved(root)
    assert there > before

    result, _ = run_live(root, robot__id=name, resume="true", dataset__num_episodes=there + 1)
    assert (result.recorded, result.episodes) == (1, there + 1)
    after = {key: np.array(values) for key, values in data_columns(root).items()}
    assert dataset_info(root).compact
    assert sorted(set(after["episode_index"].tolist())) == list(range(there + 1))
    for key in ("action", "observation.state", "event"):
        assert np.array_equal(after[key][: len(columns[key])], columns[key]), key


def test_in_lockstep_a_signal_stops_all_episodes_that_run(tmp_path):
    """As on the wall clock: what was running is saved with its outcome, nothing else is begun."""
    root = tmp_path / "d"
    begun: list[int] = []

    judge = AvoidTask.judge

    def judged(self: Any, truth: Any, running: Any) -> Any:
        begun.append(1)
        if len(begun) == 30:
            os.kill(os.getpid(), signal.SIGUSR1)
        return judge(self, truth, running)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AvoidTask, "judge", judged)
        result, text = run_record(root, dataset__num_episodes=20, n_envs=3, dataset__episode_time_s=60)
    assert result.exit_status == ESTOP_STATUS
    assert result.outcomes["estop"] == 3
    assert result.estop == "signal SIGUSR1"
    assert re.search(r"Emergency stop \(signal SIGUSR1\)", text)
    columns = data_columns(root)
    assert columns["event"].count(int(Event.ESTOP)) == 3
    assert len(set(columns["episode_index"])) == result.recorded


def test_a_press_between_two_episodes_begins_no_other(tmp_path, monkeypatch):
    save = DatasetRecorder.save

    def pressing(self: Any, *arguments: Any, **options: Any) -> Any:
        saved = save(self, *arguments, **options)
        if self.num_episodes == 2:
            os.kill(os.getpid(), signal.SIGUSR2)
        return saved

    monkeypatch.setattr(DatasetRecorder, "save", pressing)
    root = tmp_path / "d"
    result, text = run_record(root, dataset__num_episodes=5, dataset__episode_time_s=1, estop_signal="usr2")
    assert (result.recorded, result.exit_status) == (2, ESTOP_STATUS)
    assert result.estop == "signal SIGUSR2"
    assert "--resume=true" in text
    assert int(Event.ESTOP) not in data_columns(root)["event"]  # both had ended before
    result, _ = run_record(root, dataset__num_episodes=5, dataset__episode_time_s=1, resume="true")
    assert (result.recorded, result.exit_status) == (3, 0)
