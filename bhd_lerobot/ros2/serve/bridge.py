"""`bhd-ros2 bridge`: the cerebellum between a brain on a ROS 2 network and a robot that is driven by a plant."""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from rich.console import Console

from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.recording.passive import PassiveRecording
from bhd_lerobot.robots.config import ROS2_PLANTS
from bhd_lerobot.robots.host.realtime import LiveHost, mirror_of
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.host.state import problem_of, raised
from bhd_lerobot.ros2.live.network import SENSOR_DATA
from bhd_lerobot.ros2.live.node import Node, Subscription
from bhd_lerobot.ros2.messages.table import ODOMETRY_TYPE
from bhd_lerobot.ros2.serve import articles
from bhd_lerobot.ros2.serve.articles import article_names
from bhd_lerobot.ros2.serve.config import BridgeConfig
from bhd_lerobot.ros2.serve.goals import ArmGoals, BaseGoals, Goals
from bhd_lerobot.ros2.serve.interface import RESET_TOPIC, InterfaceTopics
from bhd_lerobot.ros2.serve.server import Counts, Output, State, Topics, run_service
from bhd_lerobot.ros2.serve.setpoints import Setpoints

TWIST_TOPIC, POSITION_TOPIC = "/brain/cmd_vel", "/brain/commands"


class Faults(Topics):
    """Reports each fault of the robot once, with its cause and the remedy; one that no reset ends is an error."""

    def __init__(self, host: LiveHost, report: Callable[[str], None]) -> None:
        self._host, self._report, self._before, self._looks = host, report, host.bridge.latest.copy(), 0
        self.outputs = [Output(10.0, self._look)]  # which publishes nothing

    def _look(self, state: State) -> None:
        before, mode = self._before, Mode(int(state.robot.mode[0]))
        is_new = mode in (Mode.FAULT, Mode.ESTOP) and mode != before["state"]["mode"]
        self._looks = (self._looks + 1) * is_new
        if self._looks == 1:
            return  # a moment later the cause is known better: which topic is silent, which process has ended
        self._before, self._looks = state.row.copy(), 0
        if not is_new:
            return
        if mode == Mode.FAULT and self._host.is_lost:
            raise RealtimeError(f"{problem_of(state.row).removesuffix('.')}. The robot is stopped; start again.")
        _, flags = raised(before, state.row)
        noticed = ", ".join(str(flag.name).lower().replace("_", " ") for flag in Watchdog(flags))
        why = "the emergency stop was pressed" if mode == Mode.ESTOP else problem_of(state.row) or noticed
        self._report(f"{mode.name}: {why.removesuffix('.')}. A message on {RESET_TOPIC} lets the robot go on.")


def bridge(
    config: BridgeConfig, simulation: type[Simulation], console: Console, ended: threading.Event | None = None
) -> None:
    """Stand between brains and a robot until SIGINT, SIGTERM or SIGHUP. The robot starts where it is, and holds.

    Raises:
        DatasetError: what is at `record.root` is no dataset of this robot, or cannot be written.
        RealtimeError: the robot is not there, another program commands it, or a process of it has ended.
    """
    names = article_names(config.articles)
    extra = (articles.TWIST_TOPIC,) if config.articles else ()
    ended = ended or threading.Event()

    def report(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    def parts(host: LiveHost, node: Node, counts: Counts) -> list[Topics]:
        goals: Goals = ArmGoals(host) if host.body.arm is not None else BaseGoals(host, _odometry(config.robot, node))
        topics = (POSITION_TOPIC,) if host.body.arm is not None else (TWIST_TOPIC, *extra)
        if recording is not None:
            recording.begin(host)
        ended = (lambda result: None) if recording is None else recording.goal_ended
        return [
            InterfaceTopics(host, node, counts, config.state_hz, goals, ended=ended, names=names),
            *(Setpoints(host, node, counts, goals.interrupt, one) for one in topics),
            Faults(host, report),
        ]

    with _recording(config, simulation, report, ended) as recording:
        run_service(
            config,
            simulation,
            None,
            parts,
            console=console,
            ended=ended,
            name=f"{config.robot.type}_bridge",
            title="is behind a bridge",
        )


def _odometry(robot: Any, node: Node) -> Subscription | None:
    """Return the odometry that a robot publishes itself; its newest message waits until it is asked for."""
    if robot.plant != ROS2_PLANTS[True]:
        return None
    return node.raw_subscription(f"rt{robot.ros2.in_namespace('/odom')}", ODOMETRY_TYPE, SENSOR_DATA)


def _recording(
    config: BridgeConfig, simulation: type[Simulation], report: Callable[[str], None], ended: threading.Event
) -> AbstractContextManager[PassiveRecording | None]:
    """Return what records the robot, before it starts; nothing if it is not to be recorded."""
    if not config.record.root:
        return nullcontext()
    return PassiveRecording(config.record, mirror_of(simulation, config.robot), report, ended)
