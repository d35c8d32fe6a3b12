"""Another package's robot on an absolute grid: what it is sent, what is reported, and what can go wrong with it."""

import itertools
import re
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot import stock
from bhd_lerobot.control.commands import Chunk, Goals
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.host import LeRobotHost
from bhd_lerobot.robots.external.lock import RobotLock
from bhd_lerobot.robots.external.make import make_external
from tests.robots.external.mock_devices import MockArm, MockArmConfig
from tests.robots.external.mock_devices.devices import MockCameraConfig
from tests.waiting import until

FPS = 50
ONLY = np.zeros(1, np.intp)


def make(
    tmp_path: Path, gate: GateConfig | None = None, fps: int = FPS, kind: type[MockArm] = MockArm, **options: Any
) -> LeRobotHost:
    robot = kind(MockArmConfig(id="test", calibration_dir=tmp_path, log=str(tmp_path / "sent"), **options))
    host = LeRobotHost(robot, fps, gate or GateConfig())
    robot.connect()
    return host


def sent(tmp_path: Path) -> list[list[float]]:
    path = tmp_path / "sent"
    return [[float(word) for word in line.split()] for line in path.read_text().splitlines()] if path.exists() else []


def action(value: float) -> np.ndarray:
    return np.full((1, 3), value)


def start(host: LeRobotHost) -> None:
    host.reset(ONLY, [None], [0])
    host.observe()


def frames_pass(host: LeRobotHost, frames: int) -> None:
    """Wait until the robot has been observed in so many further frames."""
    before = host.robot.observed
    until(lambda: host.robot.observed >= before + frames, "frames pass")


def test_actions_reach_the_robot_and_frames_lie_on_an_absolute_grid(tmp_path: Path) -> None:
    with closing(make(tmp_path)) as host:
        start(host)
        with pytest.raises(ConfigError, match=r"Goals.*mock_arm"):
            host.step(Goals({}))
        numbers = []
        for step in range(20):
            host.observe()
            report = host.step(action(step))
            # A frame that ended before the action could be sent still has the one before.
            assert report.requested.tolist() == report.applied.tolist()
            assert report.requested.tolist() in ([[step] * 3], [[max(step - 1, 0)] * 3])
            assert report.mode[0] == Mode.TRACKING
            numbers += [one.number for one in (*report.missed, report)]
        host.stop(ONLY)
        summary = host.clock.statistics().summary()
    assert [row[0] for row in sent(tmp_path)] == list(range(20))
    assert numbers == sorted(set(numbers))
    assert abs(summary.rate_error) < 1  # however long each frame took


def test_a_late_brain_misses_frames_and_does_not_hold_up_the_robot(tmp_path: Path) -> None:
    with closing(make(tmp_path)) as host:
        start(host)
        host.observe()
        host.step(action(1.0))
        host.observe()
        frames_pass(host, 5)
        report = host.step(action(2.0))
        host.stop(ONLY)
    assert len(report.missed) >= 4
    requested = [float(one.requested[0, 0]) for one in (*report.missed, report)]
    assert requested[:4] == [1.0] * 4
    assert requested == sorted(requested)
    assert requested[-1] == 2.0
    assert all(one.seen is not None for one in report.missed)
    assert [row[0] for row in sent(tmp_path)] == [1.0, 2.0]


def test_a_chunk_does_not_make_the_robot_hurry(tmp_path: Path) -> None:
    rows = np.arange(1.0, 9.0)[:, None, None] * np.ones((1, 1, 3))
    with closing(make(tmp_path)) as host:
        start(host)
        host.observe()
        reports = [host.step(Chunk(rows))]
        for missed in (0, 0, 3):
            host.observe()
            frames_pass(host, missed)
            reports.append(host.step(None))
        host.stop(ONLY)
    values = [row[0] for row in sent(tmp_path)]
    requested = [float(one.requested[0, 0]) for one in reports]
    before = [values[0], *values[:-1]]  # of a frame that ended before its action could be sent
    assert all(one in (own, last) for one, own, last in zip(requested, values, before, strict=True)), requested
    late = [min(1.0 + one.number - reports[0].number, 8.0) - value for one, value in zip(reports, values, strict=True)]
    assert min(late) >= 0.0  # more where frames begin while the action is chosen
    assert values[3] >= values[2] + 3


@pytest.mark.parametrize("last", [action(7.0), Chunk(np.full((3, 1, 3), 7.0))], ids=["an action", "a chunk"])
def test_without_actions_the_robot_holds_and_then_there_is_a_fault(tmp_path: Path, last: Any) -> None:
    with closing(make(tmp_path, GateConfig(brain_timeout_s=0.06, end_timeout_s=0.3))) as host:
        start(host)
        host.observe()
        host.step(last)
        held = faulted = False
        for _ in range(60):
            host.observe()
            report = host.step(None)
            held |= bool(report.watchdog[0] & Watchdog.COMMAND_AGE) and report.mode[0] == Mode.HOLD
            faulted = report.mode[0] == Mode.FAULT
            if faulted:
                break
        assert held
        assert faulted
        assert "no action for" in host.problem
    assert {row[0] for row in sent(tmp_path)} == {7.0}


FAULTS = {
    "disconnect": "get_observation raised ConnectionError: the bus does not answer",
    "nan": "get_observation of mock_arm returned nan for 'elbow.pos', which is not a finite number",
    "missing key": "get_observation of mock_arm returned no 'elbow.pos'",
    "image size": "The camera 'front' of mock_arm gave an image of uint8 .* must be uint8",
    "block": "get_observation of mock_arm has not returned for",
    "send raises": "send_action raised ConnectionError: the bus does not answer",
    "send blocks": "send_action of mock_arm has not returned for",
    "sends nan": "send_action of mock_arm returned nan for 'elbow.pos'",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_goes_wrong_ends_the_episode_with_a_fault_that_says_what(tmp_path: Path, fault: str) -> None:
    cameras = {"front": MockCameraConfig()}
    gate = GateConfig(call_timeout_s=0.3)
    with closing(make(tmp_path, gate, fault=fault, fault_at=4, cameras=cameras)) as host:
        start(host)
        for value in range(10):
            host.observe()
            report = host.step(action(float(value)))
            if report.mode[0] == Mode.FAULT:
                break
        host.stop(ONLY)
        assert report.mode[0] == Mode.FAULT
        assert report.watchdog[0] & Watchdog.PLANT
        assert value <= 3  # fewer where a busy machine skips a frame
        assert host.robot.is_blocked == ("block" in fault)  # nobody waits for a call that blocks
        host.robot.unblocked.set()
        assert np.isfinite(report.applied).all()
        assert re.search(FAULTS[fault], host.problem), host.problem
        with pytest.raises(RealtimeError, match="in a fault"):
            start(host)


def test_a_slow_device_is_late_and_counted_and_no_frame_is_repeated(tmp_path: Path) -> None:
    with closing(make(tmp_path, fault="slow", fault_at=4)) as host:
        start(host)
        skipped, numbers = 0, []
        for value in range(8):
            host.observe()
            report = host.step(action(float(value)))
            for one in (*report.missed, report):
                skipped += int(one.columns[keys.SKIPPED][0])
                numbers.append(one.number)
        host.stop(ONLY)
    assert skipped >= 5  # 0.15 s at 50 frames a second
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == len(numbers) - 1 + skipped


def test_a_frozen_camera_is_seen_in_the_age_of_its_images(tmp_path: Path) -> None:
    cameras = {"front": MockCameraConfig(fps=100), "wrist": MockCameraConfig(fps=100, freeze_after=3)}
    with closing(make(tmp_path, cameras=cameras)) as host:
        assert host.columns == {keys.IMAGE_AGE: ("front", "wrist")}
        start(host)
        for value in range(20):
            frame = host.observe()
            host.step(action(float(value)))
        host.stop(ONLY)
    front, wrist = frame.columns[keys.IMAGE_AGE][0]
    assert wrist > front + 0.1
    assert frame.age_ns[0] / 1e9 >= wrist


def test_the_first_observation_that_fails_ends_the_run(tmp_path: Path) -> None:
    with (
        closing(make(tmp_path, fault="disconnect", fault_at=1)) as host,
        pytest.raises(RealtimeError, match="cannot be observed: get_observation raised ConnectionError"),
    ):
        start(host)


def test_what_cannot_be_recorded_is_refused_before_the_robot_is_touched(tmp_path: Path) -> None:
    class Depth(MockArm):
        @property
        def observation_features(self) -> dict[str, Any]:
            return {**super().observation_features, "depth": (48, 64, 1)}

    robot = Depth(MockArmConfig(id="depth", calibration_dir=tmp_path))
    with pytest.raises(ConfigError, match=r"depth.*\(48, 64, 1\).*Switch depth off"):
        LeRobotHost(robot, FPS, GateConfig())
    assert not robot.is_connected


class Bare:
    """Does not keep its configuration: LeRobot's base class does not ask for that."""

    name, is_connected = "bare", False

    def __init__(self) -> None:
        self.observation_features = self.action_features = {"elbow.pos": float}

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False


def test_a_robot_need_not_keep_its_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = MockArmConfig(id="bare", calibration_dir=tmp_path, port=str(tmp_path))
    monkeypatch.setattr(stock, "make_robot_from_config", lambda _: Bare(), raising=False)
    with closing(make_external(config, FPS, GateConfig())) as host:
        assert host.config is config
        assert host.robot.is_connected
    assert not host.robot.is_connected


def test_a_robot_that_cannot_be_connected_leaves_nothing_behind(tmp_path: Path) -> None:
    config = MockArmConfig(id="none", calibration_dir=tmp_path, port=str(tmp_path), fault="no connection")
    before = threading.active_count()
    with pytest.raises(RealtimeError, match="'mock_arm' cannot be connected: ConnectionError: there is no such port"):
        make_external(config, FPS, GateConfig())
    assert threading.active_count() == before
    lock = RobotLock(config)  # nobody uses it
    command = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=(lock._file,)):
        lock.close()
        RobotLock(config).close()  # nor does one that was forked meanwhile


class MockBase(MockArm):
    """A base: its speeds go on until it gets others."""

    def __init__(self, config: MockArmConfig) -> None:
        super().__init__(config)
        self.rows: list[tuple[float, float]] = []
        self.at = 0.0

    @property
    def action_features(self) -> dict[str, Any]:
        return {"x.vel": float, "arm.pos": float}

    @property
    def observation_features(self) -> dict[str, Any]:
        return {"x.vel": float, "arm.pos": float}

    def get_observation(self) -> dict[str, Any]:
        super().get_observation()
        if self.config.fault and self.observed >= self.config.fault_at:
            raise ConnectionError("the bus does not answer")
        return {"x.vel": 0.1, "arm.pos": self.at}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.rows.append((action["x.vel"], action["arm.pos"]))
        return dict(action)


def base(*arguments: Any, kind: type[MockBase] = MockBase, **options: Any) -> tuple[LeRobotHost, Any]:
    host = make(*arguments, kind=kind, **options)
    return host, host.robot


@pytest.mark.parametrize("ending", ["stop", "close", "fault", "estop"])
def test_a_base_stands_whatever_ends_an_episode(tmp_path: Path, ending: str) -> None:
    host, robot = base(tmp_path, fault="bus" * (ending == "fault"), fault_at=4)
    with closing(host):
        start(host)
        for _ in range(5):
            host.observe()
            if host.step(np.array([[0.2, 1.0]])).mode[0] == Mode.FAULT:
                break
        if ending == "estop":
            host.estop()
            host.observe()
            host.step(np.array([[0.2, 1.0]]))
        if ending != "close":
            host.stop(ONLY)
            assert robot.rows[-1][0] == 0.0
    assert (0.2, 1.0) in robot.rows
    assert robot.rows[-1][0] == 0.0


def test_after_an_emergency_stop_nothing_moves_the_robot_again(tmp_path: Path) -> None:
    host, robot = base(tmp_path, fault="bus", fault_at=8)
    with closing(host):
        start(host)
        for _ in range(3):
            host.observe()
            host.step(np.array([[0.2, 50.0]]))
        robot.at = 7.0  # where it is when it is stopped, on its way to 50
        host.observe()
        host.step(np.array([[0.2, 50.0]]))
        host.estop()
        stopped = len(robot.rows)
        for _ in range(10):
            host.observe()
            if host.step(np.array([[0.2, 50.0]])).mode[0] == Mode.FAULT:
                break
        host.stop(ONLY)
    assert robot.rows[stopped:] == [(0.0, 7.0)]


class SaggingArm(MockArm):
    """Hangs below its commands, and grips something thick."""

    def get_observation(self) -> dict[str, Any]:
        seen = super().get_observation()
        return {**seen, "shoulder.pos": seen["shoulder.pos"] - 3.0, "gripper.pos": 40.0}


MOMENTS = [
    "the brain thinks",
    "the brain is silent",
    "between episodes",
    "at the end",
    "the next episode begins",
    "as it is closed",
]


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_emergency_stop_is_one_action_and_what_is_gripped_stays_gripped(tmp_path: Path, moment: str) -> None:
    with closing(make(tmp_path, GateConfig(brain_timeout_s=0.1), kind=SaggingArm)) as host:
        start(host)
        host.observe()
        host.step(np.array([[20.0, 20.0, 10.0]]))
        if moment == "the brain is silent":
            until(lambda: len(sent(tmp_path)) == 2, "it holds")
        if moment in ("between episodes", "as it is closed", "the next episode begins"):
            host.stop(ONLY)
        if moment == "the next episode begins":
            start(host)
        before = len(sent(tmp_path))
        host.estop()
        assert host.estop_pressed
        if moment != "as it is closed":
            until(lambda: len(sent(tmp_path)) > before, "it stops")
        if moment == "at the end":
            host.stop(ONLY)
            start(host)  # an episode that begins all the same
        if moment not in ("between episodes", "as it is closed"):
            frames_pass(host, 20)
            assert host.step(action(50.0)).mode[0] == Mode.ESTOP
    assert sent(tmp_path)[before:] == [[17.0, 20.0, 10.0]]


@pytest.mark.parametrize("presses", [0, 2])
def test_a_robot_that_was_not_driven_gets_nothing_before_the_first_action(tmp_path: Path, presses: int) -> None:
    """Where it is measured is not what its gripper was closed to, before."""
    with closing(make(tmp_path, GateConfig(brain_timeout_s=0.05))) as host:
        start(host)
        for _ in range(presses):
            host.estop()
        frames_pass(host, 10)
        assert host.step(None).mode[0] == (Mode.ESTOP if presses else Mode.HOLD)
    assert sent(tmp_path) == []


def test_an_emergency_stop_whose_call_raises_is_tried_once_more(tmp_path: Path) -> None:
    class Lossy(MockBase):
        loses = 0

        def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
            if self.loses:
                self.loses -= 1
                raise ConnectionError("There is no status packet!")
            return super().send_action(action)

    host, robot = base(tmp_path, kind=Lossy)
    robot.at = 7.0
    with closing(host):
        start(host)
        host.step(np.array([[0.2, 9.0]]))
        robot.loses = 1
        host.estop()
        until(lambda: host.step(None).mode[0] == Mode.FAULT, "the call has raised")
        host.stop(ONLY)
    assert robot.rows == [(0.2, 9.0), (0.0, 7.0)]


@pytest.mark.parametrize("timeout_s", [0.2, 5.0])
def test_an_emergency_stop_during_a_long_call_stops_where_the_robot_is_after_it(
    tmp_path: Path, timeout_s: float
) -> None:
    class Blocking(MockBase):
        def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
            super().send_action(action)
            if len(self.rows) == 1:
                self._block()
                self.at = 30.0
            return dict(action)

    host, robot = base(tmp_path, GateConfig(call_timeout_s=timeout_s), kind=Blocking)
    with closing(host):
        start(host)
        thread = threading.Thread(target=host.step, args=(np.array([[0.2, 50.0]]),))
        thread.start()
        until(lambda: robot.is_blocked, "the call blocks")
        host.estop()
        if timeout_s < 1:
            until(lambda: host.problem, "the call has timed out")
        else:
            time.sleep(3 / FPS)  # a call is long that lasts for more than a frame
        robot.unblocked.set()
        until(lambda: len(robot.rows) > 1, "it stops")
        thread.join()
    assert robot.rows == [(0.2, 50.0), (0.0, 30.0)]


@pytest.mark.parametrize("is_pressed", [False, True])
def test_motors_keep_their_torque_after_an_emergency_stop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], is_pressed: bool
) -> None:
    """Of a robot with two arms each has options of its own."""
    host = make(tmp_path)
    robot = host.robot
    robot.config.disable_torque_on_disconnect = True
    robot.left_arm = SimpleNamespace(config=SimpleNamespace(disable_torque_on_disconnect=True))
    if is_pressed:
        host.estop()
    host.close()
    assert not robot.is_connected
    switched_off = (robot.config.disable_torque_on_disconnect, robot.left_arm.config.disable_torque_on_disconnect)
    assert switched_off == (not is_pressed, not is_pressed)
    assert ("its motors stay on" in capsys.readouterr().err) == is_pressed


def test_an_emergency_stop_after_a_fault_asks_a_dead_bus_once(tmp_path: Path) -> None:
    host, robot = base(tmp_path)
    with closing(host):
        start(host)
        host.step(np.array([[0.2, 50.0]]))
        robot.config.fault, robot.config.fault_at = "bus", 0
        until(lambda: host.observe() and host.step(np.array([[0.2, 50.0]])).mode[0] == Mode.FAULT, "the bus is dead")
        before = robot.observed
        host.estop()
        until(lambda: robot.observed > before, "it was asked")
        time.sleep(0.2)
    assert robot.observed == before + 1
    assert robot.rows[-1] == (0.0, 50.0)


def test_a_silent_brain_is_one_action_too(tmp_path: Path) -> None:
    """A robot that goes a bounded step towards each action that it is sent would go on."""
    with closing(make(tmp_path, GateConfig(brain_timeout_s=0.05))) as host:
        start(host)
        for value in (5.0, 7.0):
            host.observe()
            host.step(action(value))
            frames_pass(host, 20)
    assert [row[0] for row in sent(tmp_path)] in ([5.0, 5.0, 7.0, 7.0], [5.0, 5.0, 7.0])


@pytest.mark.parametrize("what", ["disconnect", "is_connected"])
def test_a_robot_that_cannot_be_disconnected_is_reported_and_hides_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    def fail(self: MockArm) -> None:
        raise ConnectionError("the bus does not answer")

    host = make(tmp_path)
    monkeypatch.setattr(MockArm, what, fail if what == "disconnect" else property(fail))
    host.close()
    assert "mock_arm could not be disconnected: ConnectionError: the bus does not answer" in capsys.readouterr().err


def test_an_action_that_waits_behind_a_blocked_call_is_not_sent_after_the_fault(tmp_path: Path) -> None:
    gate = GateConfig(brain_timeout_s=0.05, call_timeout_s=0.2)
    with closing(make(tmp_path, gate, fps=4, fault="send blocks", fault_at=2)) as host:
        start(host)
        host.observe()
        host.step(action(1.0))
        until(lambda: host.robot.is_blocked, "the hold of the late brain blocks")
        host.observe()
        report = host.step(action(50.0))
        host.stop(ONLY)
        assert report.mode[0] == Mode.FAULT
        host.robot.unblocked.set()
        until(lambda: not host.robot.is_blocked, "the call returns")
        time.sleep(0.3)
    assert {row[0] for row in sent(tmp_path)} == {1.0}


def test_after_a_hold_a_base_speeds_up_from_rest(tmp_path: Path) -> None:
    host, robot = base(tmp_path, GateConfig(max_change={"x.vel": 0.1}, brain_timeout_s=0.06))
    with closing(host):
        start(host)
        for _ in range(5):
            host.observe()
            host.step(np.array([[0.5, 0.0]]))
        until(lambda: robot.rows[-1][0] == 0.0, "it is held")
        host.observe()
        host.step(np.array([[0.5, 0.0]]))
        host.stop(ONLY)
    speeds = [row[0] for row in robot.rows]
    # On a busy machine it may have been held more than once.
    assert 0.0 in speeds[1:]
    assert max(after - before for before, after in itertools.pairwise(speeds)) == pytest.approx(0.1)


def test_a_robot_may_use_the_array_of_an_image_again(tmp_path: Path) -> None:
    class Reusing(MockArm):
        image = np.zeros((48, 64, 3), np.uint8)

        def get_observation(self) -> dict[str, Any]:
            seen = super().get_observation()
            self.image[:] = self.observed
            return {**seen, "front": self.image}

    shown: list[int] = []
    with closing(make(tmp_path, kind=Reusing, cameras={"front": MockCameraConfig()})) as host:
        start(host)
        host.observe()
        frames_pass(host, 4)
        report = host.step(action(1.0))
        for one in report.missed:
            one.truth()
            host.render_later(0, "front", lambda image: shown.append(int(image[0, 0, 0])))
    assert len(shown) >= 3
    assert shown == sorted(set(shown))
