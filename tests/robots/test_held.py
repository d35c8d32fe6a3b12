"""A box in the gripper: it is put back where it stood, and not pressed into the table or into what is declared."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import TableObject, TableScene
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose, ResultCode
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.policies.manipulation.grasp import pointing_down
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from tests.robots.forces import Contacts

FIRST = np.zeros(1, np.intp)
BOX = TableObject("box", "red", 0.03, 0.025, 0.1, 0.5, 0.1)
TAKEN_AT, LIFT = 0.07, 0.1  # [m] the tool's height, and by how much it is lifted
LIGHT_N = 20.0


class Hand:
    """A UR5 that holds a box over the table, with the force between both at every tick."""

    def __init__(self, fixtures: tuple[Shape, ...] = (), box: TableObject = BOX, **config: Any) -> None:
        self.arm = arm = Simulation(UR5Config(**config), 1, threads=1, fixtures=fixtures)
        arm.reset(FIRST, [TableScene("box", (box,), arm.body.arm.home)], [0])
        self.limits = self.watchdog = self._goals = 0
        self.forces: list[float] = []
        contacts = Contacts(arm)
        for height, opening in ((0.2, 0.085), (TAKEN_AT, None), (None, 0.02), (TAKEN_AT + LIFT, None)):
            assert self.goal(height, opening).success
        self.offset = self._box - self._tool
        arm._after_tick = lambda: self.forces.append(contacts.force("table", "object_0"))  # type: ignore[method-assign]

    def goal(self, height: float | None, opening: float | None = None, x: float = BOX.x) -> CommandResult:
        """Send the tool to a height [m] on a line, or the gripper to an opening [m], and wait."""
        pose = None if height is None else pointing_down(x, BOX.y, height, yaw=0.0)
        return self.reach(pose, opening)

    def reach(self, pose: Pose | None, opening: float | None = None, motion: str = "line") -> CommandResult:
        """Send the tool to a pose, or the gripper to an opening [m], and wait."""
        way = {} if pose is None else {"target_pose": pose, "motion": motion}
        way |= {"max_velocity": 0.25} if way and motion == "line" else {}
        self._goals += 1
        command = BrainCommand(f"goal {self._goals}", gripper=opening, **way)  # type: ignore[arg-type]
        assert self.arm.bridge.submit(command, 0) is None
        while not (results := self._step(None)):
            pass
        return results[0]

    def lower(self, height: float, speed: float) -> None:
        """Lower the tool to a height [m] by setpoints, at a speed [m/s], and wait a second."""
        arm, frames = self.arm, round((self._tool - height) / speed * 25)
        action, last = arm.cerebellum.command.copy(), arm.cerebellum.command[0, :6]
        for z in (*np.linspace(self._tool, height, frames), *[height] * 25):
            last = arm.kinematics.solve(pointing_down(BOX.x, BOX.y, float(z), yaw=0.0).matrix(), last).postures[0]
            action[0, :6] = last
            self._step(action)

    def _step(self, action: Any) -> Any:
        report = self.arm.step(action)
        self.limits |= int(report.limits[0])
        self.watchdog |= int(report.watchdog[0])
        return report.results.get(0, ())

    @property
    def slipped(self) -> float:
        """By how much the box moved in the fingers [m]."""
        return abs(self._box - self._tool - self.offset)

    @property
    def _box(self) -> float:
        return float(self.arm.truth().object_poses[0, 0, 2])

    @property
    def _tool(self) -> float:
        return float(self.arm.truth().tool_pose[0, 2])


def test_a_goal_that_would_press_the_box_into_the_table_is_refused_and_one_that_puts_it_back_is_not() -> None:
    hand = Hand()
    for height in (TAKEN_AT - 0.03, TAKEN_AT - 0.001):
        result = hand.goal(height)
        assert result.code == ResultCode.TABLE_COLLISION
        assert result.message.startswith("On the way what the gripper holds comes within ")
    assert not any(hand.forces)
    assert hand.goal(TAKEN_AT).success
    assert max(hand.forces) < LIGHT_N
    assert hand.slipped < 1e-3
    assert hand.goal(None, 0.085).success  # it stands: the tool may go lower
    assert hand.goal(TAKEN_AT - 0.03).success


TILTS = [
    (0.27, 0.03, -0.0007),
    (-0.17, 0.09, -0.0003),
    (-0.36, 0.53, 0.001),
    (0.36, 0.51, -0.002),
    (0.11, -0.19, 0.0017),
]
"""About x and y [rad], and the tool's height above where the box was taken [m]. Without its edges: up to 175 N."""


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("size", [(0.03, 0.025), (0.015, 0.01), (0.02, 0.03)])
@pytest.mark.parametrize("motion", ["line", "joint"])
def test_goals_that_tilt_the_box_near_the_table_are_refused_or_touch_it_lightly(
    size: tuple[float, float], motion: str
) -> None:
    hand = Hand(box=TableObject("box", "red", *size, 0.1, BOX.x, BOX.y))
    down = Rotation.from_quat(np.roll(pointing_down(BOX.x, BOX.y, 0.1, yaw=0.0).quaternion, -1))
    succeeded = []
    for about_x, about_y, above in (*TILTS, (0.2, -0.2, 0.03)):
        x, y, z, w = (Rotation.from_euler("xy", (about_x, about_y)) * down).as_quat()
        result = hand.reach(Pose((BOX.x, BOX.y, TAKEN_AT + above), (w, x, y, z)), motion=motion)
        succeeded.append(result.success)
        assert max(hand.forces, default=0.0) < LIGHT_N
        assert hand.goal(TAKEN_AT + LIFT).success
    assert succeeded[-1]  # high enough above the table
    assert not all(succeeded)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("speed", [0.25, 0.05])
def test_setpoints_that_would_press_the_box_into_the_table_put_it_down(speed: float) -> None:
    hand = Hand()
    hand.lower(TAKEN_AT - 0.03, speed)
    assert max(hand.forces) < LIGHT_N
    assert hand.slipped < 1e-3
    assert hand._tool < TAKEN_AT + 0.005
    assert (Mode(int(hand.arm.cerebellum.mode[0])), Watchdog(hand.watchdog)) == (Mode.TRACKING, Watchdog(0))
    assert hand.limits & Limit.CLEARANCE
    assert hand.goal(None, 0.085).success
    hand.lower(TAKEN_AT - 0.03, 0.1)
    assert hand._tool < TAKEN_AT - 0.029


def test_the_box_is_not_set_onto_what_is_declared_unless_that_is_wanted() -> None:
    """With `held_clearance` false only the arm keeps away; the force limit is what is left."""
    post = Shape("cylinder", 0.4, BOX.y, 0.0, 0.03, 0.03, 0.05)
    for keeps in (True, False):
        hand = Hand((post,), obstacles=[[0.4, BOX.y, 0.0, 0.4, BOX.y, 0.05, 0.03]], held_clearance=keeps)
        assert hand.goal(TAKEN_AT + LIFT, x=0.4).success
        result = hand.goal(TAKEN_AT + 0.055, x=0.4)
        assert result.success is not keeps
        if keeps:
            assert result.code == ResultCode.SELF_COLLISION
            assert "On the way what the gripper holds comes within" in result.message
            assert "of obstacle_0;" in result.message
        else:
            hand.goal(TAKEN_AT + LIFT)
            hand.goal(TAKEN_AT - 0.03)
            assert max(hand.forces) > 100.0
