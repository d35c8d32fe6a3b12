"""`bhd-ros2 serve`: a simulated robot with the topics of a real one."""

import threading
from functools import partial

from rich.console import Console

from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.viewer.viewer import prepare_view
from bhd_lerobot.ros2.live.network import require_cyclonedds
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.robot_views import robot_view
from bhd_lerobot.ros2.serve.arm import ArmTopics
from bhd_lerobot.ros2.serve.articles import TWIST_TOPIC, TrajectoryController, article_names
from bhd_lerobot.ros2.serve.base import BaseTopics
from bhd_lerobot.ros2.serve.config import ServeConfig
from bhd_lerobot.ros2.serve.description import publish_description
from bhd_lerobot.ros2.serve.extras import CameraTopics, ClockTopic
from bhd_lerobot.ros2.serve.foxglove import FoxgloveServer, MirroredNode
from bhd_lerobot.ros2.serve.goals import ArmGoals, BaseGoals, Goals
from bhd_lerobot.ros2.serve.interface import InterfaceTopics, Names
from bhd_lerobot.ros2.serve.paths import DrivenPath, PlannedPath
from bhd_lerobot.ros2.serve.server import Counts, Topics, run_service
from bhd_lerobot.ros2.serve.setpoints import Setpoints
from bhd_lerobot.sim.description import parts_of


def serve(
    config: ServeConfig, simulation: type[Simulation], console: Console, ended: threading.Event | None = None
) -> None:
    """Serve a robot until SIGINT, SIGTERM or SIGHUP.

    Raises:
        ConfigError: Cyclone DDS is not installed, or Foxglove cannot be served.
        RealtimeError: a process of the robot could not be started or has ended, or the network cannot be used.
    """
    require_cyclonedds()
    prepare_view(config.view)
    foxglove = FoxgloveServer(config.robot.type, config.foxglove_port) if config.foxglove_port else None
    names = article_names(config.articles)
    node = partial(MirroredNode, server=foxglove) if foxglove else Node

    def parts(host: LiveHost, node: Node, counts: Counts) -> list[Topics]:
        made = _parts(config, host, node, counts, names)
        if foxglove:
            foxglove.start()
            console.print(f"Foxglove: Open connection, ws://localhost:{config.foxglove_port}")
        return made

    try:
        scene = config.robot.start_scene()
        state = run_service(
            config,
            simulation,
            scene,
            parts,
            console=console,
            ended=ended,
            node=node,
            view=config.view,
            title="is a ROS 2 robot",
        )
        touched, ticks = int(state["touches"].sum()), int(state["executed"])
        console.print(f"Contact in {touched} of {ticks} control ticks.")
    finally:
        if foxglove:
            foxglove.close()


def _parts(config: ServeConfig, host: LiveHost, node: Node, counts: Counts, names: tuple[Names, ...]) -> list[Topics]:
    view = robot_view(config.robot.type)
    is_arm = host.body.arm is not None
    goals: Goals = ArmGoals(host) if is_arm else BaseGoals(host)
    parts: list[Topics]
    if is_arm:
        arm = ArmTopics(host, node, counts, view, config.joint_states_hz)
        interface = InterfaceTopics(host, node, counts, config.state_hz, goals, taken=arm.interrupt, names=names)
        parts = [interface, arm, PlannedPath(host, node, arm.trajectory)]
        if config.articles:
            parts.append(TrajectoryController(host, node, arm.follow))
    else:
        interface = InterfaceTopics(host, node, counts, config.state_hz, goals, names=names)
        twists = ("/cmd_vel", *((TWIST_TOPIC,) if config.articles else ()))
        commands = [Setpoints(host, node, counts, goals.interrupt, topic) for topic in twists]
        parts = [interface, BaseTopics(host, node, view), *commands, DrivenPath(node)]
    if view.joints:
        publish_description(node, config.robot.type, view, parts_of(host.body))
    if host.camera_shapes:
        parts.append(CameraTopics(host, node))
    if config.clock:
        parts.append(ClockTopic(node))
    return parts
