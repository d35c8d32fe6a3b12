"""Configurations of simulated arms."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from bhd_lerobot.bodies.body import OBSTACLE, Body, Capsule
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import OneOf, Positive, Range
from bhd_lerobot.robots.config import BhdRobotConfig


@dataclass(kw_only=True)
class ArmConfig(BhdRobotConfig):
    """Options of every arm with a gripper. A subclass states what it is made of, in `body`.

    Attributes:
        control: ``"servo"``: position servos, stiff and precise, with goals; ``"impedance"``: joint torques that make
            the tool a damped spring, for contact; needs `action_space = "tool"` and takes no goals.
        action_space: ``"joint"``: joint positions; ``"tool"``: a tool pose, from which the bridge computes them.
        tool_pose: observe the tool's pose as well, computed from the joint positions.
        scene: what is on the table when the robot is used by itself: ``"empty"``, ``"reach"`` (a target pose) or
            ``"pick"`` (objects). In a task the task decides.
        max_force: force [N] with which the tool may press on something, whatever moves it; more is a protective stop.
            It is estimated from the motors' efforts: with 150 N the arm is stopped at 160 N in the median, below 190 N
            in 95 % and below 240 N in 99 % of postures and directions at 0.02 m/s, and at 0.25 m/s at 270, 380 and 430
            N; the others are those that its joints hardly feel. A force on another part of the arm counts with what the
            joints feel of it. Of a plant that measures no efforts, such as a ROS 2 driver, nothing is limited.
        payload: mass of what the gripper is going to carry [kg]. Accelerations are planned so that the motors can move
            it; what it weighs beyond that, by 20 N, stops the arm when it is at rest.
        held_clearance: keep what the gripper holds away from table, arm and obstacles as well. It is taken to reach as
            far down as the table was below the tool when the gripper closed, at most 0.2 m; false where things are
            taken from something that stands on the table, and put lower. Used with ``control = "servo"``.
        obstacles: what is known to be in its way besides the table and itself: capsules, each with x, y, z of one end,
            x, y, z of the other, and the radius, in the base frame [m]. Goals and setpoints keep away from them.
        wrench: record what the surroundings put on the tool as well, force and moment as estimated from the motors'
            efforts: `control.wrench`.
        stale_after_s: time after the end of the frame that a setpoint was for, until the arm decelerates and holds [s].
    """

    fps: int = 25
    control_hz: int = 500
    physics_hz: int = 500
    control: Annotated[str, OneOf(("servo", "impedance"))] = "servo"
    action_space: Annotated[str, OneOf(("joint", "tool"))] = "joint"
    tool_pose: bool = False
    scene: Annotated[str, OneOf(("empty", "reach", "pick"))] = "empty"
    max_force: Annotated[float, Range("(0, inf]")] = 150.0
    payload: float = 0.0
    held_clearance: bool = True
    obstacles: list[list[float]] = field(default_factory=list)
    wrench: bool = False
    stale_after_s: Positive = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control == "impedance" and self.action_space != "tool":
            raise ConfigError(
                f"robot.control is 'impedance' and robot.action_space is {self.action_space!r}; "
                "an impedance is commanded by tool poses: use --robot.action_space=tool."
            )
        for number, values in enumerate(self.obstacles):
            if len(values) != 7 or not np.isfinite(values).all() or not values[6] > 0:
                raise ConfigError(
                    f"robot.obstacles has {values} as number {number}; an obstacle is 7 finite numbers [m]: x, y, z of "
                    "one end, x, y, z of the other, and the radius, which is positive."
                )
        self.check_rates()

    @property
    def capsules(self) -> list[Capsule]:
        """What is known to be in the way, as `bodies.body.ArmChain` takes it."""
        return [
            Capsule(f"{OBSTACLE}{number}", 0, (x, y, z), (to_x, to_y, to_z), radius)
            for number, (x, y, z, to_x, to_y, to_z, radius) in enumerate(self.obstacles)
        ]

    @abstractmethod
    def body(self) -> Body:
        """Return the hardware that this configuration describes."""
