"""A plant of another package: whatever it raises, returns or claims, the robot is stopped and the loop goes on."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Watchdog
from bhd_lerobot.control.plant import Plant, PlantReading, SafetyStatus
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.checked_plant import CheckedPlant, plant_class
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.parts.arm import ArmPart
from bhd_lerobot.tasks.operator import OperatorTask, judged
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Event
from tests.cases import each_case
from tests.control.support import wheel_speeds

START = np.array([3.0, -1.4, 1.5, -1.6, -1.5, 0.2, 0.04])
FIRST = np.zeros(1, np.intp)


class Perfect(Plant):
    """Joints that are where they were commanded to be a tick ago; a test may break each of its calls."""

    n = 1

    def __init__(self, sensors: int = 0, start: Any = START) -> None:
        self.position = np.array(start, np.float64)
        self.offset, self.safety = 1, SafetyStatus.NORMAL
        self.time: Callable[[], int] = lambda: 0
        self.written: list[NDArray[np.float64]] = []
        self.modes: list[Mode] = []
        self.calls: list[str] = []
        self.broken: dict[str, Callable[..., Any]] = {}
        self.sensors = np.linspace(1.0, 2.0, sensors)

    @property
    def now(self) -> int:
        return self.offset + self.time()

    def _call(self, name: str, *arguments: Any) -> Any:
        self.calls.append(name)
        return self.broken[name](*arguments) if name in self.broken else None

    def open(self) -> None:
        self._call("open")

    def enable(self) -> None:
        self._call("enable")

    def read(self, out: PlantReading) -> None:
        out.position[0] = self.position
        out.safety[0] = self.safety
        out.sensors[0], out.sensors_ns[0] = self.sensors, self.now
        assert out.stamp_ns is not None
        out.stamp_ns[0] = self.now
        if "read" in self.broken:
            self.broken["read"](out)

    def write(self, ctrl: NDArray[np.float64]) -> None:
        self._call("write", ctrl)
        self.written.append(ctrl[0].copy())
        self.position = ctrl[0].copy()

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        self.modes.append(Mode(int(mode[0])))
        self._call("set_mode", mode)

    def recover(self) -> bool:
        return bool(self._call("recover"))

    def close(self) -> None:
        self._call("close")


class Rig:
    """An arm without a world, in lockstep."""

    def __init__(self, plant: Perfect | None = None) -> None:
        self.plant = plant or Perfect()
        self.slept = 0.0
        self.checked = CheckedPlant(self.plant, "mine:Arm", NANOSECONDS, lambda: self.plant.now, self._sleep)
        self.host = Host(UR5Config(control_hz=125, physics_hz=500), self.checked)
        self.plant.time = lambda: self.host.bridge.now_ns
        self.checked.open()

    def _sleep(self, seconds: float) -> None:
        self.slept += seconds
        self.plant.offset += round(seconds * NANOSECONDS)

    def start(self) -> None:
        self.checked.prepare(self.host.cerebellum.reading)
        self.host.cerebellum.stamp_origin_ns = self.plant.offset
        self.host.reset(FIRST, [None], [0])

    def drive(self, frames: int = 1, turn: float = 0.01) -> Mode:
        for _ in range(frames):
            action = self.host.cerebellum.command.copy()
            action[0, 5] += turn
            self.host.step(action)
        return Mode(int(self.host.modes[0]))


def test_nothing_is_written_before_it_is_known_where_the_robot_is_and_then_it_stays_there() -> None:
    rig = Rig()
    rig.host.bridge.advance_frame()
    assert rig.host.modes[0] == Mode.UNCONFIGURED
    assert not rig.plant.written
    rig.start()
    rig.host.step(None)
    assert np.abs(np.array(rig.plant.written) - START).max() < 1e-12


def test_the_plant_is_told_every_mode_before_what_is_written_in_it() -> None:
    rig = Rig()
    rig.start()
    rig.host.step(None)
    assert rig.drive(3) == Mode.TRACKING
    rig.host.bridge.deactivate()
    for _ in range(25):
        rig.host.step(None)
    assert rig.plant.modes == [Mode.HOLD, Mode.TRACKING, Mode.STOPPING, Mode.SAFE_OFF]
    assert rig.plant.calls[:3] == ["open", "enable", "set_mode"]


def boom(*_: Any) -> None:
    raise OSError("the cable is out")


def not_a_number(out: PlantReading) -> None:
    out.position[0, 2] = np.nan


def no_stamp(out: PlantReading) -> None:
    out.stamp_ns = None


def ten_seconds_ahead(out: PlantReading) -> None:
    assert out.stamp_ns is not None
    out.stamp_ns[0] += 10 * NANOSECONDS


def wrong_shape(out: PlantReading) -> None:
    out.position[0] = np.zeros(3)


def a_code_of_its_own(out: PlantReading) -> None:
    out.safety[0] = 9


@pytest.mark.law
@each_case(
    "call, how",
    [
        ("read", boom),
        ("read", not_a_number),
        ("read", no_stamp),
        ("read", ten_seconds_ahead),
        ("read", wrong_shape),
        ("read", a_code_of_its_own),
        ("write", boom),
        ("set_mode", boom),
    ],
)
def test_a_plant_that_fails_is_a_fault_that_stays_until_a_reset(call: str, how: Callable[..., Any]) -> None:
    rig = Rig()
    rig.start()
    assert rig.drive(3, 0.05) == Mode.TRACKING
    rig.plant.broken[call] = how
    if call == "set_mode":
        rig.host.bridge.deactivate()
    before = len(rig.plant.written)
    rig.drive(2)
    assert rig.host.modes[0] == Mode.FAULT
    written = np.array(rig.plant.written[before - 1 :])
    assert np.isfinite(written).all()
    assert np.abs(np.diff(written, axis=0)).max(initial=0.0) < 0.05
    assert rig.checked.not_ready(rig.host.cerebellum.reading)
    rig.plant.broken.clear()
    for _ in range(25):
        rig.host.step(None)
    assert rig.host.modes[0] == Mode.FAULT
    assert rig.host.bridge.reset().accepted.all()
    assert rig.host.bridge.activate().accepted.all()
    assert rig.drive(2) == Mode.TRACKING


@each_case("status, mode", [(SafetyStatus.STOPPED, Mode.FAULT), (SafetyStatus.EMERGENCY_STOP, Mode.ESTOP)])
def test_the_robots_own_safety_functions_are_heard_and_a_reset_starts_from_where_it_is(
    status: SafetyStatus, mode: Mode
) -> None:
    rig = Rig()
    rig.plant.broken["recover"] = lambda: True
    rig.start()
    assert rig.drive(3) == Mode.TRACKING
    rig.plant.safety = status
    report = rig.host.step(None)
    assert rig.host.modes[0] == mode
    if mode == Mode.FAULT:
        assert report.watchdog[0] & Watchdog.PLANT
    where = rig.plant.position + np.eye(7)[0] * 0.3  # it fell, say
    for _ in range(400):
        rig.plant.position = where.copy()
        rig.host.bridge.advance_ticks(1)
    rig.plant.safety = SafetyStatus.NORMAL
    rig.plant.position = where.copy()
    rig.host.bridge.advance_ticks(1)
    rig.plant.position = where.copy()
    assert rig.host.bridge.reset().accepted.all()
    before = len(rig.plant.written)
    rig.host.bridge.advance_ticks(3)
    assert np.abs(np.array(rig.plant.written[before:])[:, :6] - where[:6]).max() < 1e-9


@each_case(
    "how, why",
    [
        (lambda plant: plant.broken.update(read=no_stamp), "has read nothing yet"),
        (lambda plant: setattr(plant, "safety", SafetyStatus.STOPPED), "its safety status is STOPPED"),
        (lambda plant: setattr(plant, "safety", 9), "its safety status is 9, which is no SafetyStatus"),
        (lambda plant: plant.broken.update(read=not_a_number), "not a finite number"),
        (lambda plant: plant.broken.update(read=ten_seconds_ahead), "a stamp is 10.000 s ahead of now"),
        (lambda plant: plant.broken.update(read=boom), "OSError: the cable is out"),
    ],
)
def test_a_robot_that_is_not_ready_is_waited_for_and_then_given_up(how: Callable[[Any], Any], why: str) -> None:
    rig = Rig()
    how(rig.plant)
    with pytest.raises(RealtimeError, match=f"mine:Arm is not ready after 10 s: .*{why}"):
        rig.start()
    assert rig.slept >= 10
    assert not rig.plant.written


@each_case("asked", [1, 2, 7])
def test_a_stop_of_its_own_that_is_not_left_at_once_is_left_when_it_is_asked_again(asked: int) -> None:
    rig = Rig()
    rig.plant.safety = SafetyStatus.STOPPED

    def unlock() -> bool:
        if rig.plant.calls.count("recover") == asked:
            rig.plant.safety = SafetyStatus.NORMAL
        return True

    rig.plant.broken["recover"] = unlock
    rig.start()
    assert rig.plant.calls.count("recover") == asked
    assert rig.drive(2) == Mode.TRACKING


@each_case("ends", ["with its stop", "by itself"])
def test_a_robot_that_cannot_be_read_yet_is_asked_to_leave_a_stop_and_waited_for(ends: str) -> None:
    rig = Rig()
    left = [3]

    def flaky(out: PlantReading) -> None:
        left[0] -= ends == "by itself"
        if left[0] >= 0:
            boom()

    rig.plant.broken["read"] = flaky
    if ends == "with its stop":
        rig.plant.broken["recover"] = lambda: rig.plant.broken.pop("read") is not None
    rig.start()
    assert rig.slept < 1
    assert rig.checked.problem == ""
    assert rig.drive(2) == Mode.TRACKING


@each_case("done", ["opened", "enabled"])
def test_a_robot_that_cannot_be_reached_is_named(done: str) -> None:
    plant = Perfect()
    plant.broken["open" if done == "opened" else "enable"] = boom
    with pytest.raises(RealtimeError, match=f"The plant mine:Arm cannot be {done}: OSError: the cable is out"):
        Rig(plant).start()


def taking(what: str) -> Rig:
    plant = Perfect()
    plant.takes = what
    return Rig(plant)


@each_case(
    "make, why",
    [
        (lambda: plant_class("nowhere.at_all:Arm"), "cannot be imported: ModuleNotFoundError"),
        (lambda: plant_class("bhd_lerobot.control.plant:Nothing"), "cannot be imported: AttributeError"),
        (lambda: plant_class("bhd_lerobot.control.plant:SafetyStatus"), "has no open and no enable"),
        (lambda: UR5Config(plant="my plant", clock="realtime"), "name a class as package.module:Class"),
        (lambda: UR5Config(plant="mine:Arm"), "use --robot.clock=realtime"),
        (lambda: UR5Config(plant="m:Arm", clock="realtime", camera=True), "robot.camera is of simulated robots"),
        (
            lambda: CheckedPlant.made(f"{__name__}:Refusing", UR5Config(), None, NANOSECONDS),
            "Refusing cannot be made of this configuration: ValueError: no",
        ),
        (lambda: taking("velocities"), r"The plant mine:Arm takes 'velocities'; .* 'actuators' or 'twist'"),
        (lambda: taking("twist"), r"takes twists .* 'ur5' is no base"),
    ],
)
def test_what_is_no_plant_of_this_robot_is_refused(make: Callable[[], object], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        make()


class Refusing(Perfect):
    def __init__(self, config: Any, body: Any) -> None:
        raise ValueError("no such address")


def test_a_base_observes_what_its_plant_measures() -> None:
    plant = Perfect(sensors=39, start=[0.0, 0.0])
    config = TurtleBot3Config(beams=36, imu=True, odometry=True)
    checked = CheckedPlant(plant, "mine:Base", NANOSECONDS, lambda: plant.now)
    base = Host(config, checked)
    checked.prepare(base.cerebellum.reading)
    plant.time = lambda: base.bridge.now_ns
    base.reset(FIRST, [None], [0])
    base.step(None)
    seen = dict(zip(base.observation_names, base.observe().state[0], strict=True))
    assert [seen[f"scan_{beam:03d}.pos"] for beam in range(36)] == plant.sensors[:36].tolist()
    assert [seen[f"imu_{axis}.vel"] for axis in "xyz"] == plant.sensors[36:].tolist()
    for _ in range(20):
        base.step(np.array([[0.1, 0.5]]))
    pose, odometry = base.truth().base_pose_in_world[0], base.cerebellum.controller.odometry()[0]
    assert pose.tolist() == odometry.tolist()
    base.place(FIRST, [Arena("here", (), (-1, 1, -1, 1), (0.5, 0.0, np.pi / 2))])
    turned = [0.5 - odometry[1], odometry[0], np.pi / 2 + odometry[2]]
    np.testing.assert_allclose(base.truth().base_pose_in_world[0], turned, atol=1e-12)
    plant.sensors[3] = np.inf
    base.step(None)
    assert base.modes[0] == Mode.FAULT


class Twisted(Perfect):
    """A base whose own controller turns twists into wheel speeds."""

    takes = "twist"

    def write(self, ctrl: NDArray[np.float64]) -> None:
        self.written.append(ctrl[0].copy())
        self.position = self.position + wheel_speeds(ctrl)[0] / 200

    def read(self, out: PlantReading) -> None:
        super().read(out)
        out.velocity[:] = wheel_speeds(np.array(self.written[-1:] or [[0.0, 0.0]]))


def test_a_base_whose_plant_takes_twists_writes_twists_within_its_limits() -> None:
    plant = Twisted(sensors=36, start=[0.0, 0.0])
    checked = CheckedPlant(plant, "mine:Base", NANOSECONDS, lambda: plant.now)
    base = Host(TurtleBot3Config(beams=36), checked)
    checked.prepare(base.cerebellum.reading)
    plant.time = lambda: base.bridge.now_ns
    base.reset(FIRST, [None], [0])
    for action in ([0.1, 0.5], [9.0, 0.0], [-9.0, 9.0]):
        for _ in range(20):
            base.step(np.array([action]))
            assert plant.written[-1].tolist() == base.cerebellum.command[0].tolist()
    written, limits = np.array(plant.written), base.body.limits
    assert (np.abs(written).max(axis=0) <= np.array(limits.velocity) + 1e-9).all()
    most = np.array(limits.acceleration) / 200
    assert (np.abs(np.diff(written, axis=0)).max(axis=0) <= most + 1e-12).all()
    assert base.observe().state[0, :2].tolist() == pytest.approx(written[-1].tolist())
    assert base.modes[0] == Mode.TRACKING


def test_what_a_robot_does_not_measure_a_person_judges() -> None:
    knows = ArmPart.knows
    assert isinstance(judged(ReachTask(ReachConfig(), 1, 25), knows, 1, 25), ReachTask)
    task = PickTask(PickConfig(duration_s=0.2), 1, 25)
    assert judged(task, None, 1, 25) is task
    asked = judged(task, knows, 1, 25)
    assert isinstance(asked, OperatorTask)
    assert asked.environment_names == ()
    asked.begin(FIRST, [asked.sample(0)])
    events = [int(asked.judge(None, np.ones(1, np.bool_))[1][0]) for _ in range(5)]
    assert events == [Event.NOTHING] * 4 + [Event.TIMEOUT]
    assert asked.outcome(0, Event.SUCCESS).success
    assert not asked.outcome(0, Event.FAILURE).success
    assert asked.parameters()["judged_by"] == "operator"
