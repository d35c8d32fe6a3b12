"""A person who records a robot of another package: what is said, what a key does, and what is left behind."""

import io
import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.cli.record import main
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.writer.encoder_process import EncoderProcess
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.recording.status import RecordStatus
from bhd_lerobot.rollout.marks import Marks
from bhd_lerobot.rollout.progress import ESTOP_STATUS, FAULT_STATUS
from tests.forks import Terminal
from tests.recording.support import saved
from tests.robots.external.mock_devices import MockArm
from tests.robots.external.test_record import options, run
from tests.waiting import until

PLUGIN = "--robot.discover_packages_path=tests.robots.external.mock_devices"


@pytest.mark.parametrize("fault_at", [1, 2])
def test_a_fault_at_the_first_frame_has_its_status_a_summary_and_a_hint_and_leaves_no_dataset(tmp_path, fault_at):
    root = tmp_path / "d"
    result, text = run(root, robot__fault="disconnect", robot__fault_at=fault_at)
    text = " ".join(text.split())
    assert result.exit_status == FAULT_STATUS
    assert "the bus does not answer" in text
    assert "this run" in text
    is_saved = fault_at > 1 and result.recorded
    assert ("is saved with the outcome 'fault'" in text) == bool(is_saved)
    assert "Clear the cause and continue" in text
    assert root.exists() == bool(is_saved)
    if not is_saved:
        assert "No episode was running." in text
        assert run(root, dataset__num_episodes=1)[0].recorded == 1  # the same command


def test_a_take_that_is_saved_survives_that_the_robot_is_switched_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The computer with it: every file of a saved take is on the device, before more is recorded."""
    save, fsync = DatasetRecorder.save, os.fsync
    safe: set[int] = set()
    unsafe: list[list[Path]] = []

    def flush(handle: int) -> None:
        fsync(handle)
        safe.add(os.fstat(handle).st_ino)

    def look(self: DatasetRecorder, *arguments: Any, **options: Any) -> int:
        index = save(self, *arguments, **options)
        files = [one for name in ("meta", "data", "videos") for one in (self.root / name).rglob("*") if one.is_file()]
        unsafe.append([one for one in files if one.stat().st_ino not in safe])
        return index

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(DatasetRecorder, "save", look)
    run(tmp_path / "d", dataset__num_episodes=1, task__duration_s=1)
    assert unsafe == [[]]


def test_a_leader_that_cannot_be_connected_leaves_no_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MockArm, "connect", lambda self, calibrate=True: 1 / 0)
    with pytest.raises(RealtimeError, match="cannot be connected"):
        run(tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_an_emergency_stop_while_the_robot_connects_counts_and_claims_no_episode(tmp_path, monkeypatch):
    connect = MockArm.connect

    def pressed(self: MockArm, calibrate: bool = True) -> None:
        os.kill(os.getpid(), signal.SIGUSR1)
        connect(self, calibrate)

    monkeypatch.setattr(MockArm, "connect", pressed)
    result, text = run(tmp_path / "d")
    text = " ".join(text.split())
    assert result.exit_status == ESTOP_STATUS
    assert result.recorded == 0
    assert re.search(r"Emergency stop \(signal SIGUSR1\)\. No episode was running\. Clear the cause", text)
    assert not (tmp_path / "d").exists()


def test_the_announced_signal_ends_nothing_after_the_last_episode(tmp_path, monkeypatch):
    disconnect = MockArm.disconnect

    def late(self: MockArm) -> None:
        os.kill(os.getpid(), signal.SIGUSR1)
        disconnect(self)

    monkeypatch.setattr(MockArm, "disconnect", late)
    result, _ = run(tmp_path / "d", dataset__num_episodes=1)
    os.kill(os.getpid(), signal.SIGUSR1)
    assert (result.recorded, result.exit_status) == (1, 0)


class Slow(Terminal):
    """A person who gives each phase its time: a key that comes sooner is held."""

    def type(self, keys: bytes) -> None:
        time.sleep(0.8)
        super().type(keys)


def test_a_recording_by_keys(tmp_path: Path) -> None:
    root, takes = tmp_path / "d", {"dataset__num_episodes": 3, "dataset__reset_time_s": 600, "task__duration_s": 600}
    at = Slow(main, [PLUGIN, *options(root, **takes)], log=tmp_path / "log")
    at.expect("Keys: ")
    Terminal.type(at, b"s")
    at.expect("s counts for nothing: the first take has not begun; only the emergency stop counts")
    at.expect("take 1 of 3 · recording")
    at.type(b"s")
    at.expect("take 2 of 3 · reset")
    until(lambda: saved(root) == 1, "it is saved during the reset phase")
    at.type(b"r")
    at.expect("r: the last take is discarded and recorded again")
    at.type(b"\r")
    at.expect("take 1 of 3 · recording", 2)
    assert saved(root) == 0
    at.type(b"f")
    at.expect("take 2 of 3 · reset", 2)
    at.type(b"p")
    at.expect("p: pause, Enter begins the next take")
    at.type(b"p")
    time.sleep(0.3)
    assert "take 2 of 3 · recording" not in at.text()
    at.type(b"\r")
    at.expect("take 2 of 3 · recording")
    at.type(b"s")
    at.expect("take 3 of 3 · reset")
    at.type(b"\r")
    at.expect("take 3 of 3 · recording")
    at.type(b"s")
    assert at.wait() == 0, at.text()
    outcomes = [episode.metadata["outcome"] for episode in dataset_info(root).episodes]
    assert outcomes == ["failure", "success", "success"]
    assert check_dataset(root).is_valid
    assert "last: failure" in at.text()
    assert "a person drives" in at.text()
    assert "600 s left" in at.text()


@pytest.mark.parametrize("who", ["robot", "teleop"])
def test_what_a_device_asks_while_it_is_connected_is_answered_in_the_terminal(tmp_path: Path, who: str) -> None:
    takes = {"dataset__num_episodes": 1, f"{who}__fault": "asks"}
    at = Terminal(main, [PLUGIN, *options(tmp_path / "d", **takes)], log=tmp_path / "log")
    at.expect("which calibration")
    for key in b"secsss\n":  # of which the emergency stop and a success are none now
        time.sleep(0.05)
        at.type(bytes([key]))
    at.expect("answered 'secsss'")
    assert at.wait() == 0, at.text()
    assert saved(tmp_path / "d") == 1


def test_the_line_says_who_drives_and_what_is_left_and_the_bell_rings(tmp_path: Path) -> None:
    marks, taken = Marks(), [False]
    out = io.StringIO()
    console = Console(file=out, width=100, force_terminal=True)
    driver = lambda: "a person" if taken[0] else "act"  # noqa: E731
    status = RecordStatus(console, 50, 30, 20.0, driver=driver, marks=marks, bell=True)
    assert "take 1 of 50 · starting" in status.line().plain
    status.begin(2)
    assert "take 3 of 50 · recording · 20 s left · act drives" in status.line().plain
    taken[0] = True
    marks.pause()
    assert "a person drives · a pause comes next" in status.line().plain
    marks.on_key(b"x")
    assert "x means nothing here" in status.line().plain
    status.end(2, "success")
    assert out.getvalue().count("\a") == 2
    status.change("reset", 3, 15.0)
    assert status.line().plain.startswith("take 4 of 50 · paused · ")
    silent = RecordStatus(console, 50, 30, 20.0, driver=driver, marks=marks, bell=False)
    silent.begin(0)
    assert out.getvalue().count("\a") == 2


@pytest.mark.parametrize(
    ("gaps", "is_said"), [({}, False), ({40: 10}, False), (dict.fromkeys(range(0, 90, 2), 1), True)]
)
def test_a_rate_is_said_and_a_hiccup_is_none(gaps: dict[int, int], is_said: bool) -> None:
    out = io.StringIO()
    console = Console(file=out, width=200)
    status = RecordStatus(console, 1, 30, 20.0, driver=lambda: "act", marks=Marks(), bell=False)
    status.begin(0)
    number = 0
    for frame in range(90):
        status.frame(number)
        number += 1 + gaps.get(frame, 0)
    assert ("The robot keeps 20 of the 30 frames a second" in out.getvalue()) == is_said
    assert ("20 of 30 frames/s" in status.line().plain) == is_said


def test_an_encoder_that_is_too_slow_holds_up_no_frame_and_is_named(tmp_path, monkeypatch):
    put = EncoderProcess.put_image
    asked: dict[int, int] = {}

    def no_room(self: EncoderProcess, number: int, image: np.ndarray, *, is_needed: bool) -> bool:
        asked[number] = asked.get(number, 0) + 1
        return asked[number] % 3 != 2 and put(self, number, image, is_needed=is_needed)

    monkeypatch.setattr(EncoderProcess, "put_image", no_room)
    result, text = run(tmp_path / "d", dataset__num_episodes=1, task__duration_s=1)
    text = " ".join(text.split())
    camera = "observation.images.front"
    frames = result.frames
    assert result.dropped[camera] == len(range(1, frames, 3))
    assert re.search(
        rf"The video encoder h264 keeps about \d+ frames a second of 2 cameras: .*of {frames} of {camera}", text
    )
    assert "Images dropped because the video encoder was too slow" in text
    assert check_dataset(tmp_path / "d").is_valid
    columns = read_episode(tmp_path / "d", 0)
    ages, time_s = np.stack(columns["control.image_age"]), np.asarray(columns["control.time"])
    grown = ages[1::3, 0] - ages[:-1:3, 0][: len(ages[1::3])]
    np.testing.assert_allclose(grown, np.diff(time_s)[::3][: len(grown)], atol=1e-6)
