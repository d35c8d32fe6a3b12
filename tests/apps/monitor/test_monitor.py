"""`bhd-monitor` beside a real block: it reads, changes nothing but the emergency stop, and notices how a robot ends."""

import functools
import json
import math
import os
import pty
import select
import subprocess
import sys
import termios
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.apps.monitor import monitor
from bhd_lerobot.apps.monitor.monitor import Keys, find
from bhd_lerobot.apps.monitor.state import Count, Sampler
from bhd_lerobot.cli.monitor import main
from bhd_lerobot.control.commands import Feedback, GoalPhase
from bhd_lerobot.control.messages import Limit, Mode, Reason, Watchdog
from bhd_lerobot.control.motion.goal_codec import write_feedback
from bhd_lerobot.control.record import STATE
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.realtime import shared_memory
from bhd_lerobot.realtime.block import LiveBlock, LiveLayout, Phase, Word
from bhd_lerobot.realtime.keys import KeySource, KeyTerminal
from bhd_lerobot.realtime.shared_memory import SharedBlock, names
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_simulation
from bhd_lerobot.robots.host.state import LIMITS, WATCHDOGS, published_dtype
from tests.realtime.test_shared_memory import files
from tests.recording.support import options
from tests.waiting import until

S = 1_000_000_000
NAME = f"test-monitor-{os.getpid()}"


def room(name: str) -> int:
    """Return how many values a field of the record holds."""
    return math.prod(STATE[name].shape)


@functools.cache
def published() -> np.dtype:
    config: Any = parse(RecordConfig, options(Path("unused"), robot__beams=4))
    return published_dtype(make_simulation(config.robot))


class Robot:
    """The maker's side of a block, on a clock of its own: what a running TurtleBot3 writes, written by hand."""

    def __init__(self, name: str = NAME) -> None:
        dtype = published()
        layout = LiveLayout(dtype, 64, 2, 16)
        names = ["x.vel", "theta.vel"]
        about = {"robot": "turtlebot3", "fps": 10, "control_hz": 200, "commands": names, "drives": True}
        self.block = layout.create(name, about)
        self.made = int(self.block.about["made_ns"])
        self.now = self.made + 100 * S
        self.statistics = TimingStatistics(S // 200, self.block.section("statistics"))
        self.state = np.zeros((), dtype)
        self.start()

    def start(self, segment: int = 1) -> None:
        words = self.block.words
        words[Word.START], words[Word.SEGMENT], words[Word.PHASE] = self.now, segment, Phase.RUNNING
        self.state["segment"], self.state["executed"], self.state["state"]["mode"] = segment, 0, Mode.HOLD
        self.statistics.reset()
        self.tick(0)

    def tick(self, ticks: int = 1, **fields: Any) -> None:
        """Let ticks pass, of which the last one publishes."""
        self.now += ticks * S // 200
        state, words = self.state, self.block.words
        state["executed"] += ticks
        state["due_ns"], state["start_ns"], state["sensed_ns"] = self.now, self.now, self.now
        for name, value in fields.items():
            if name in STATE.names and name != "limits":
                values = np.ravel(value)
                state["state"][name] = values[0] if values.size == 1 else np.pad(values, (0, room(name) - values.size))
            else:
                state[name] = value
        self.block.ring.publish(state)
        for word in (Word.BRAIN_ALIVE, Word.CEREBELLUM_ALIVE):
            words[word] = self.now


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    yield made
    made.block.close()


@pytest.fixture
def sampler(robot: Robot) -> Iterator[Sampler]:
    with closing(LiveBlock.watch(NAME)) as block:
        yield Sampler(block, lambda: robot.now)


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the robots of others that run on this machine."""
    monkeypatch.setattr(monitor, "names", lambda: [name for name in names() if name.startswith(NAME)])


@pytest.mark.law
def test_who_watches_can_write_nothing_but_the_emergency_stop(robot: Robot) -> None:
    block = LiveBlock.watch(robot.block.name)
    with pytest.raises(ValueError, match="read-only"):
        block.words[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        block.estop.press()
    with pytest.raises(ValueError, match="read-only"):
        block.fifo.push(1, 0, np.zeros((1, 2)), np.ones(1, np.bool_))
    with pytest.raises(ValueError, match="read-only"):
        block.ring.publish(robot.state)
    before = bytes(robot.block.section("words"))
    block.set_estop()
    after = robot.block.words.copy()
    assert 0 < after[Word.ESTOP] <= time.monotonic_ns()
    after[Word.ESTOP] = 0
    assert after.tobytes() == before
    block.close()


def test_writing_beside_a_section_is_refused(robot: Robot) -> None:
    block = SharedBlock.watch(NAME)
    with pytest.raises(ConfigError, match="section 'words'"):
        block.write("words", 64 * 8, b"x")
    with pytest.raises(ConfigError, match="section 'words'"):
        block.write("words", -1, b"x")
    block.close()


def test_who_watches_does_not_hold_the_name() -> None:
    robot = Robot(f"{NAME}-held")
    block = LiveBlock.watch(robot.block.name)
    assert block.is_held
    robot.block.close()
    assert not block.is_held
    again = Robot(f"{NAME}-held")
    assert not block.is_held  # another robot of the same name is another robot
    assert block.words[Word.SEGMENT] == 1  # what was seen last can still be read
    block.close()
    block.close()
    assert not block.is_held
    assert again.block.name in names()
    again.block.close()
    with pytest.raises(RealtimeError, match="No running robot is called"):
        LiveBlock.watch(f"{NAME}-held")


def test_what_nobody_holds_any_more_is_not_watched() -> None:
    name = f"{NAME}-dead"
    code = (
        "import os; from bhd_lerobot.realtime.shared_memory import SharedBlock\n"
        f"SharedBlock.create({name!r}, {{'words': 512}}, {{}}); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", code], check=False)
    assert files(name)
    with pytest.raises(RealtimeError, match="no process holds it any more"):
        SharedBlock.watch(name)
    shared_memory.sweep()
    assert not files(name)


def test_rates_are_those_of_the_last_two_seconds(robot: Robot, sampler: Sampler) -> None:
    first = sampler.sample()
    assert (first.control_rate, first.frame_rate, first.command_rate) == (None, None, None)
    for _ in range(40):
        robot.tick(25, setpoints_taken=robot.state["state"]["setpoints_taken"] + 1)
        robot.block.words[Word.RECORDER_FRAMES] += 1
        shown = sampler.sample()
    assert shown.control_rate == pytest.approx(200)
    assert shown.frame_rate == pytest.approx(8)
    assert shown.command_rate == pytest.approx(8)
    assert shown.executed == 1000
    for _ in range(30):
        robot.tick(10)  # half as fast from now on
        robot.now += 10 * S // 200
        robot.block.words[Word.CEREBELLUM_ALIVE] = robot.now
        shown = sampler.sample()
    assert shown.control_rate == pytest.approx(100, rel=0.03)
    robot.now += 5 * S
    assert sampler.sample().control_rate == 0  # a loop that hangs


def test_rates_begin_anew_with_an_episode_and_need_one(robot: Robot, sampler: Sampler) -> None:
    sampler.sample()
    robot.tick(200, limits=[5 * (limit == Limit.VELOCITY) for limit in LIMITS])
    assert sampler.sample().limits["VELOCITY"].per_second == pytest.approx(5)
    robot.block.words[Word.PHASE] = Phase.STANDING
    standing = sampler.sample()
    assert (standing.control_rate, standing.episode_time, standing.observation_age) == (None, None, None)
    robot.tick(1, limits=0)
    robot.start(2)
    assert sampler.sample().control_rate is None
    robot.tick(200, limits=[int(limit == Limit.VELOCITY) for limit in LIMITS])
    shown = sampler.sample()
    assert shown.limits["VELOCITY"] == Count(1, pytest.approx(1))
    assert shown.episode == 2


@pytest.mark.law
def test_a_state_is_in_seconds_and_names(robot: Robot, sampler: Sampler) -> None:
    words = robot.block.words
    robot.block.fifo.push(1, 0, np.zeros((1, 2)), np.ones(1, np.bool_))
    robot.tick(
        400,
        mode=Mode.TRACKING,
        setpoints_taken=7,
        now_ns=30_000_000,
        oldest_ns=150_000_000,
        skipped=3,
        overruns=4,
        requested=[[0.2, 1.0]],
        command=[[0.1, 0.5]],
        measured=[[0.09, 0.4]],
        odometry=[[1.0, 2.0, 3.0]],
        limits=[int(limit == Limit.EFFORT) for limit in LIMITS],
        watchdogs=[2 * int(watchdog == Watchdog.BRAIN) for watchdog in WATCHDOGS],
        refusals=[9 if reason in (Reason.ACCEPTED, Reason.STALE) else 0 for reason in Reason],
    )
    words[Word.CATCH_UP_LOST], words[Word.RECORDER_DROPS] = 5, 6
    robot.now += S // 100
    shown = sampler.sample()
    assert (shown.id, shown.robot, shown.mode, shown.phase) == (NAME, "turtlebot3", "TRACKING", "RUNNING")
    assert shown.uptime == pytest.approx(102.01)
    assert shown.episode_time == pytest.approx(2.01)
    assert shown.command_age == pytest.approx(0.04)
    assert shown.observation_age == pytest.approx(0.16)
    assert shown.alive == dict.fromkeys(("brain", "cerebellum"), pytest.approx(0.01))
    assert [(d.name, d.requested, d.applied, d.measured) for d in shown.dimensions] == [
        ("x.vel", 0.2, 0.1, 0.09),
        ("theta.vel", 1.0, 0.5, 0.4),
    ]
    assert (shown.fifo_fill, shown.fifo_capacity) == (1, 16)
    assert (shown.skipped, shown.overruns, shown.catch_up_lost, shown.recorder_drops) == (3, 4, 5, 6)
    assert {name: one.count for name, one in shown.limits.items() if one.count} == {"EFFORT": 1}
    assert {name: one.count for name, one in shown.watchdogs.items() if one.count} == {"BRAIN": 2}
    assert shown.refusals == {"STALE": 9}
    assert shown.pose == {"x": 1.0, "y": 2.0, "yaw": 3.0}
    assert len(robot.block.fifo) == 1
    json.dumps(shown.as_dict(), allow_nan=False)


def test_under_a_goal_there_is_progress_and_no_setpoint(robot: Robot, sampler: Sampler) -> None:
    write_feedback(robot.state["feedback"], Feedback("2-down", GoalPhase.EXECUTING, 0.25, 1.5, 0.01))
    robot.tick(1, mode=Mode.TRACKING, setpoints_taken=7)
    shown = sampler.sample()
    assert shown.goal is not None
    assert {
        "task_id": "2-down",
        "phase": "EXECUTING",
        "progress": 0.25,
        "remaining_s": 1.5,
    }.items() <= shown.goal.items()
    assert (shown.command_age, shown.dimensions[0].requested) == (None, None)


def test_timing_is_that_of_the_ticks(robot: Robot, sampler: Sampler) -> None:
    assert sampler.sample().lateness is None
    for _ in range(99):
        robot.statistics.add(0, 20_000, 320_000)
    robot.statistics.add(0, 2_000_000, 4_000_000)
    late, takes = sampler.sample().lateness, sampler.sample().duration
    assert late is not None
    assert takes is not None
    assert (late.p50, late.p99, late.max) == (pytest.approx(20e-6, rel=0.13), pytest.approx(20e-6, rel=0.13), 2e-3)
    assert takes.max == 2e-3


def test_before_anything_is_published_there_is_something_to_show() -> None:
    layout = LiveLayout(np.dtype([("x", np.float64)]), 4)
    made = layout.create(f"{NAME}-bare", {"robot": "ur5", "fps": 25, "control_hz": 500, "commands": []})
    block = LiveBlock.watch(made.name)
    shown = Sampler(block).sample()
    assert (shown.phase, shown.mode, shown.episode, shown.lateness) == ("STARTING", None, 0, None)
    block.close()
    made.close()


def test_how_a_robot_ended_is_reported(robot: Robot, sampler: Sampler) -> None:
    assert sampler.end() is None
    words = robot.block.words
    words[Word.PHASE] = Phase.ENDED
    for pause, end in ((0, 0), (1, 0), (0, 1)):
        words[Word.PAUSE], words[Word.END] = pause, end
        assert "its brain's process has ended" in str(sampler.end())
    words[Word.PAUSE] = words[Word.END] = 1
    assert sampler.end() == "ended"
    robot.block.words[Word.PHASE] = Phase.RUNNING
    assert sampler.end() is None
    robot.block.close()
    assert "killed" in str(sampler.end())


@pytest.mark.usefixtures("only")
def test_a_robot_that_ends_while_it_is_watched(robot: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    words = robot.block.words
    for phase, status, message in ((Phase.ENDED, 0, "has ended."), (Phase.RUNNING, 1, "killed")):
        words[Word.PHASE], words[Word.PAUSE], words[Word.END] = phase, 1, 1
        ender = threading.Timer(0.2, robot.block.close)
        if phase == Phase.RUNNING:
            ender.start()
        assert main([NAME]) == status
        printed = capsys.readouterr()
        assert f"The robot {NAME!r}" in printed.err
        assert message in printed.err
        assert NAME in printed.out  # no terminal: a line now and then
        ender.cancel()


@pytest.mark.usefixtures("only")
def test_the_only_robot_is_found_and_of_several_one_is_to_be_named(robot: Robot) -> None:
    found = find(None)
    assert found.name == NAME
    found.close()
    other = Robot(f"{NAME}-other")
    beside = SharedBlock.create(f"{NAME}-no-robot", {"a": 8}, {})
    with pytest.raises(RealtimeError, match=rf"Several robots run: {NAME} \(turtlebot3\), {NAME}-other"):
        find(None)
    with pytest.raises(
        RealtimeError, match=rf"'nobody'\. Running: {NAME} \(turtlebot3\), {NAME}-other \(turtlebot3\)\."
    ):
        find("nobody")
    found = find(NAME)
    assert found.name == NAME
    found.close()
    other.block.close()
    beside.close()


@pytest.mark.usefixtures("only")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "No robot runs"),
        (["nobody"], "'nobody'"),
        (["--seconds=0"], "--seconds is 0"),
        (["--seconds=nan"], "is nan"),
        (["--3d", "--once"], "leave --once and --json out"),
        (["--3d", "--json"], "leave --once and --json out"),
    ],
)
def test_bad_arguments_end_with_a_message_and_status_2(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.usefixtures("only")
def test_snapshots_as_text_and_as_json(robot: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    robot.block.words[Word.PHASE] = Phase.STANDING
    assert main([NAME, "--once"]) == 0
    text = capsys.readouterr().out
    assert "HOLD" in text
    assert "x.vel" in text
    assert "\x1b" not in text
    assert "emergency stop" not in text
    assert main(["--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["id"], shown["mode"], shown["control_hz"]) == (NAME, "HOLD", 200)
    assert main(["--json", "--seconds=0.01"]) == 0
    assert [json.loads(line)["id"] for line in capsys.readouterr().out.splitlines()] == [NAME, NAME]


@pytest.mark.usefixtures("only")
def test_a_page_is_served_for_as_long_as_it_watches(robot: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([NAME, "--3d", "--no-browser", "--port=0", "--json", "--seconds=0.01"]) == 0
    printed = capsys.readouterr()
    assert [json.loads(line)["id"] for line in printed.out.splitlines()] == [NAME, NAME]
    address = printed.err.split()[-1]
    assert address.startswith("http://127.0.0.1:")
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)
    assert main([NAME, "--3d", "--port=70000"]) == 2
    assert "--port is 70000" in capsys.readouterr().err


# It is to be its controlling terminal, in whose foreground it is.
LOGIN = (
    "import os, sys; os.login_tty(int(sys.argv[1]))\n"
    "from bhd_lerobot.cli.monitor import main; sys.exit(main(sys.argv[2:]))"
)


class Terminal:
    """`bhd-monitor` in a terminal of its own."""

    def __init__(self, *arguments: str) -> None:
        self.master, slave = pty.openpty()
        termios.tcsetwinsize(slave, (24, 80))
        self.before = termios.tcgetattr(slave)
        self.slave = slave
        self.output = b""
        self.process = subprocess.Popen(
            [sys.executable, "-c", LOGIN, str(slave), *arguments],
            pass_fds=(slave,),
            env={**os.environ, "TERM": "xterm-256color"},
        )

    def see(self, text: str) -> None:
        def there() -> bool:
            while select.select([self.master], [], [], 0)[0]:
                self.output += os.read(self.master, 65536)
            return text.encode() in self.output

        until(there)

    def press(self, key: bytes) -> None:
        os.write(self.master, key)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def terminal(robot: Robot) -> Iterator[Terminal]:
    made = Terminal(NAME)
    yield made
    made.close()


def test_two_keys_stop_the_robot_at_once_and_q_leaves(robot: Robot, terminal: Terminal) -> None:
    terminal.see("emergency stop")
    assert robot.block.words[Word.ESTOP] == 0
    terminal.press(b"x")
    for key in (b"e", b" "):
        robot.block.words[Word.ESTOP] = 0
        terminal.press(key)
        until(lambda: robot.block.estop.pressed[0])
    terminal.see("EMERGENCY STOP was set here")
    terminal.press(b"q")
    assert terminal.process.wait(60) == 0
    assert termios.tcgetattr(terminal.slave) == terminal.before  # the terminal is as it was
    assert robot.block.words[Word.PHASE] == Phase.RUNNING  # and so is the robot


def test_leaving_by_ctrl_c_gives_the_terminal_back(robot: Robot, terminal: Terminal) -> None:
    terminal.see("emergency stop")
    terminal.press(b"\x03")
    assert terminal.process.wait(60) == 130
    assert termios.tcgetattr(terminal.slave) == terminal.before
    assert robot.block.words[Word.ESTOP] == 0


def test_a_stop_does_not_wait_for_an_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KeyTerminal, "usable", staticmethod(lambda descriptor: True))
    master, slave = pty.openpty()
    pressed = threading.Event()
    try:
        with Keys(pressed.set, KeySource(slave)) as keys:
            os.write(master, b"e")
            assert pressed.wait(30)  # nothing is drawn or requested meanwhile
            assert not keys.quit.is_set()
            os.write(master, b"q")
            assert keys.quit.wait(30)
        assert keys.pressed == 1
    finally:
        os.close(master)
        os.close(slave)
