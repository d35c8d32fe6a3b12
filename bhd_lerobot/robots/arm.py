"""A simulated arm as a LeRobot robot."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.robots.config_arm import ArmConfig, FileArmConfig, SO101Config
from bhd_lerobot.robots.robot import BhdRobot
from bhd_lerobot.tasks.fetch import FetchConfig, FetchTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask

_TASKS: dict[str, Callable[..., Any]] = {
    "reach": partial(ReachTask, ReachConfig()),
    "pick": partial(PickTask, PickConfig()),
    "fetch": partial(FetchTask, FetchConfig()),
}
"""What makes the tasks whose scenes a robot may be in by itself."""


class SimulatedArm(BhdRobot):
    """An arm with a gripper. A subclass says its name and its configuration, which says its body.

    Action: `.pos` of each joint [rad] and `gripper.pos` [m of opening]; or, with `action_space = "tool"`, `tool_x.pos`,
    `tool_y.pos`, `tool_z.pos` [m], the quaternion `tool_qw.pos` … `tool_qz.pos`, and `gripper.pos`. Observation: `.pos`
    and `.vel` of the joints and of the gripper; by option the pose of the tool, under the names that it has in actions,
    and the images of the body's cameras.

    Args:
        config: the configuration.
    """

    def __init__(self, config: ArmConfig) -> None:
        super().__init__(config)
        made = _TASKS.get(config.scene)
        self._task: Any = made and made(1, config.fps, self.body)
        self._scene: Any = None

    def make_scene(self) -> Any:
        """Return the configured scene."""
        scene = super().make_scene()
        if self._task is not None:
            self._task.begin(np.zeros(1, np.intp), [scene])
        self._scene = scene
        return scene

    @property
    def environment(self) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """Environment state of the scene: target and objects, names and values of shape (k,)."""
        if self._task is None:
            return (), np.zeros(0)
        return self._task.environment_names, self._task.environment_state(self.host.truth())[0]

    @property
    def instruction(self) -> str:
        """What a person would ask for in the scene."""
        return "" if self._task is None or self._scene is None else self._task.instruction(self._scene)


class FileArm(SimulatedArm):
    """An arm from an MJCF or a URDF: its joints, and `gripper` if it has one."""

    config_class = FileArmConfig
    name = "arm"


class SO101(SimulatedArm):
    """SO-101 with its jaw: `shoulder_pan`, `shoulder_lift`, `elbow_flex`, `wrist_flex`, `wrist_roll`, `gripper`."""

    config_class = SO101Config
    name = "so101"
