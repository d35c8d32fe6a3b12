"""A base on the wall clock, in a process of its own: its life, its motion, and every way to stop it."""

import os
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest
from lerobot.utils.errors import DeviceNotConnectedError

from bhd_lerobot.control.messages import Mode
from bhd_lerobot.errors import CommandRefusedError, RealtimeError
from bhd_lerobot.realtime.block import LiveBlock, Phase, Word
from bhd_lerobot.realtime.shared_memory import names
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.conformance import check_robot
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from tests.robots.host.support import drive, is_alive, is_gone, mode, relaxed, turtlebot, unique
from tests.waiting import until

NAME = unique("shared")


@pytest.fixture(scope="module")
def robot() -> Iterator[TurtleBot3]:
    with turtlebot(NAME) as robot:
        yield robot
    assert is_gone(NAME)


@pytest.fixture
def driving(robot: TurtleBot3) -> Iterator[TurtleBot3]:
    """The same robot on its way, whatever the test before did to it; afterwards it is ready again."""
    drive(robot)
    yield robot
    recover(robot)


def recover(robot: TurtleBot3) -> None:
    """Lead a robot out of an emergency stop."""

    def is_reset() -> bool:
        # A press that came after the last tick before the reset is latched by the next one.
        return bool(robot.host.bridge.reset().accepted[0]) and mode(robot) == Mode.INACTIVE

    until(is_reset, "the robot is at rest")
    with pytest.raises(CommandRefusedError, match="not active"):
        robot.send_action({"x.vel": 0.1, "theta.vel": 0.0})
    robot.activate()
    assert mode(robot) == Mode.HOLD


def expect_stop(robot: TurtleBot3) -> None:
    until(lambda: mode(robot) == Mode.ESTOP, "the emergency stop is latched")
    with pytest.raises(CommandRefusedError, match="emergency stop"):
        robot.send_action({"x.vel": 0.2, "theta.vel": 0.0})
    until(lambda: abs(robot.get_observation()["x.vel"]) < 0.01, "the base stands")
    with pytest.raises(CommandRefusedError, match="emergency stop"):
        robot.activate()
    assert mode(robot) == Mode.ESTOP


def test_the_real_time_process_has_imported_neither_torch_nor_lerobot(robot):
    link = robot.host.link
    assert link.about["heavy"] == ["mujoco"]  # it is simulated
    assert link.about["pid"] == link.pid != os.getpid()
    assert {grant["name"] for grant in link.grants} >= {"scheduler", "memory lock", "collector", "timer slack"}


def test_observations_flow_and_actions_move_it(driving):
    before = driving.get_observation()
    tick = int(driving.host.bridge.latest["tick"])
    until(lambda: driving.get_observation()["x.pos"] > before["x.pos"] + 0.02, "the base gets somewhere")
    assert int(driving.host.bridge.latest["tick"]) > tick
    applied = driving.send_action({"x.vel": 0.1, "theta.vel": 0.0})
    assert set(applied) == {"x.vel", "theta.vel"}
    driving.estop()
    expect_stop(driving)


def test_estop_from_a_wire_that_is_cut(driving):
    """A reset leads nowhere while it is cut."""
    reader, writer = os.pipe()
    driving.add_estop_input(reader, "button")
    try:
        os.close(writer)
        expect_stop(driving)
        with suppress(CommandRefusedError):  # it may still be braking
            driving.reset()
        until(lambda: mode(driving) == Mode.ESTOP, "the wire is still cut")
    finally:
        driving.remove_estop_inputs()
        os.close(reader)


def test_estop_from_another_process(driving):
    block = LiveBlock.attach(NAME)
    block.estop.press()
    block.close()
    expect_stop(driving)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("until_phase", [Phase.STARTING, Phase.STANDING, Phase.RUNNING], ids=lambda phase: phase.name)
def test_a_press_of_another_process_while_it_connects_stays_until_a_person_resets_it(robot, until_phase):
    """Beside another robot, which it does not concern."""
    name = unique("starting")

    def press() -> None:
        blocks: list[LiveBlock] = []

        def attached() -> bool:
            with suppress(RealtimeError):  # it is there a moment before it can be attached to
                blocks.append(LiveBlock.attach(name))
            return bool(blocks)

        until(lambda: name in names() and attached(), "the robot starts")
        (block,) = blocks
        until(lambda: block.words[Word.PHASE] >= until_phase, "it has got so far")
        block.estop.press()
        block.close()

    presser = threading.Thread(target=press)
    presser.start()
    with turtlebot(name) as second:
        presser.join()
        expect_stop(second)
        second.restart()  # of the scene, not of the emergency stop
        expect_stop(second)
        recover(second)
        assert {NAME, name} <= set(names())
        pid = second.host.link.pid
        assert pid != robot.host.link.pid
        drive(second)
        assert mode(robot) in (Mode.HOLD, Mode.TRACKING)
    assert is_gone(name)
    assert not is_alive(pid)
    with pytest.raises(DeviceNotConnectedError):
        second.get_observation()
    assert NAME in names()


@pytest.mark.parametrize("how", ["a button that is let go of", "robot.estop()"])
def test_a_press_in_this_process_while_it_connects_is_kept(how):
    starting = turtlebot(unique("pressed"))
    with pytest.raises(DeviceNotConnectedError):
        starting.estop()

    def button() -> bool:
        is_starting = not starting.is_connected
        if is_starting and how == "robot.estop()":
            starting.estop()
            return False
        return is_starting

    starting.add_estop_input(button, "button")
    with starting:
        expect_stop(starting)
        recover(starting)
    with pytest.raises(DeviceNotConnectedError):
        starting.estop()


def test_deactivation_ends_in_safe_off(driving):
    assert driving.host.bridge.deactivate().accepted.all()
    until(lambda: mode(driving) == Mode.SAFE_OFF, "the base is at rest")
    with pytest.raises(CommandRefusedError, match="not active"):
        driving.send_action({"x.vel": 0.2, "theta.vel": 0.0})


def test_a_second_robot_of_the_same_id_is_refused(robot):
    second = turtlebot(NAME)
    with pytest.raises(RealtimeError, match=f"{NAME}.*running already"):
        second.connect()
    assert not second.is_connected
    second.disconnect()
    assert NAME in names()
    robot.get_observation()


@pytest.mark.thorough
def test_it_keeps_lerobots_contract(robot):
    assert check_robot(lambda: turtlebot(unique("contract")), adversarial=True) == ()
    assert is_gone(unique("contract"))
    assert mode(robot) in (Mode.HOLD, Mode.TRACKING)


@pytest.mark.thorough
def test_a_base_on_the_wall_clock_stops_before_a_wall():
    config = TurtleBot3Config(
        id=unique("wall"), clock="realtime", collision_monitor=True, command_timeout_s=20.0, realtime=relaxed()
    )
    speeds: list[float] = []

    def stands() -> bool:
        speeds.append(robot.send_action({"x.vel": -0.22, "theta.vel": 0.0})["x.vel"])
        return min(speeds) < -0.2 and speeds[-1] > -0.01

    with TurtleBot3(config) as robot:
        until(stands, "it stands before a wall")
        assert not robot.host.truth().touched.any()
        assert mode(robot) == Mode.TRACKING
        assert robot.get_observation()["scan_180.pos"] < 0.25
