"""When a gripper counts as holding something, and what it is taken to hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import HELD, Capsule, Placement
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.held import follow_gripper, held_capsule
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.kernels import as_objects

ARM, HZ, STALL = ur5(), 500, 50
FORWARD = ForwardKinematics(ARM.arm.chain)
KINEMATICS = ArmKinematics(ARM.arm.chain, ARM.limits)
LEAST = ARM.arm.chain.min_distance


def posture(height: float, tilt: float = 0.0) -> np.ndarray:
    """Return a posture with the tool at a height [m], and tilted from pointing down [rad]."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yx", (tilt, np.pi)).as_matrix()
    pose[:3, 3] = 0.5, 0.1, height
    return KINEMATICS.solve(pose, np.array(ARM.arm.home[:6])).postures[0]


class Hand:
    """n grippers, as they are commanded and measured."""

    def __init__(self, *postures: np.ndarray) -> None:
        self.controller = controller = ArmController(ARM, len(postures), HZ, 20)
        self.command, self.position = controller.command, controller.states["position"][:, :7]
        self.command[:, :6], self.command[:, 6] = postures, 0.085
        self.position[:] = self.command
        [self._limits] = as_objects(controller.arm_limits)
        self._records = list(zip(as_objects(controller.states), as_objects(controller.arms), strict=True))

    def run(self, opening: float, command: float, ticks: int = STALL + 1, speed: float = 0.0) -> dict:
        """Measure and command openings [m] for some ticks; return what changed, by arm."""
        states, changes = self.controller.states, {}
        self.position[:, -1], self.command[:, -1], states["velocity"][:, 6] = opening, command, speed
        for _ in range(ticks):
            for number, (state, arm) in enumerate(self._records):
                if follow_gripper(state, arm, self._limits):
                    records = states[number], self.controller.arms[number]
                    changes[number] = held_capsule(ARM.arm.chain, FORWARD, *records)
        return changes


def test_what_a_stalled_gripper_holds_reaches_down_to_the_table() -> None:
    """At any height and tilt of the tool; it may come back to there, and no lower."""
    cases = [(height, tilt) for height in (0.02, 0.07, 0.15) for tilt in (-0.5, 0.0, 0.7) if height > 0.02 or not tilt]
    postures = [posture(height, tilt) for height, tilt in cases]
    held = Hand(*postures).run(0.05, 0.02)
    assert sorted(held) == list(range(len(cases)))
    for arm, (height, tilt) in enumerate(cases):
        capsule = held[arm]
        assert isinstance(capsule, Capsule)
        assert (capsule.name, capsule.start) == (HELD, ARM.arm.chain.tool.position)
        assert capsule.radius <= 0.025
        model = CollisionModel(ARM.arm.chain.holding(capsule))
        rows = np.stack([posture(height + up, tilt) for up in (0.0, 0.01, -0.001)])
        heights = model.each(rows)[-1]
        assert LEAST < heights[0] < LEAST + 3e-4
        np.testing.assert_allclose(heights - heights[0], (0.0, 0.01, -0.001), atol=1e-9)
        without = CollisionModel(ARM.arm.chain).each(rows)
        assert (model.each(rows)[: len(ARM.arm.chain.disjoint)] == without[: len(ARM.arm.chain.disjoint)]).all()


def test_a_gripper_that_moves_is_empty_or_that_nothing_stood_under_holds_nothing() -> None:
    low, high = posture(0.07), posture(0.28)
    for opening, command, speed in ((0.05, 0.02, -0.05), (0.05, 0.048, 0.0), (0.0, 0.0, 0.0), (0.05, 0.085, 0.0)):
        assert Hand(low).run(opening, command, 10 * STALL, speed) == {}
    assert Hand(low).run(0.05, 0.02, STALL - 1) == {}
    assert Hand(low, high).run(0.05, 0.02)[1] is None


@pytest.mark.parametrize(("opening", "command"), [(0.05, 0.085), (0.02, 0.02), (0.05, 0.05)])
def test_it_is_forgotten_when_the_gripper_opens_or_closes_without_it(opening: float, command: float) -> None:
    hand = Hand(posture(0.07))
    first = hand.run(0.05, 0.02)[0]
    assert first is not None
    assert hand.run(0.045, 0.02, speed=-0.01) == {}  # it gives way a little: it is still there
    hand.command[:, :6] = posture(0.2)
    hand.position[:, :6] = posture(0.2)
    assert hand.run(0.05, 0.02) == {}
    assert hand.run(opening, command) == {0: None}
    again = hand.run(0.05, 0.02)[0]
    assert again is not None
    assert again.end[2] > first.end[2]  # taken from where the tool is now
    hand.controller.restart(np.zeros(1, np.intp))
    assert hand.run(0.085, 0.085) == {}


def test_it_is_the_same_whatever_the_frame_of_the_flange_is() -> None:
    """With its edges, which lie along the fingers' way."""
    chain, at = ARM.arm.chain, posture(0.07, 0.4)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", (0.4, -1.2, 2.0)).as_matrix()
    turned = replace(
        chain,
        links=(*chain.links[:-1], Placement.of(chain.links[-1].matrix() @ turn)),
        tool=Placement.of(turn.T @ chain.tool.matrix()),
        capsules=tuple(capsule for capsule in chain.capsules if capsule.frame < 6),
        disjoint=(),
    )
    np.testing.assert_allclose(ForwardKinematics(turned).tool(at), FORWARD.tool(at), atol=1e-12)
    state, arm = {"position": np.array([*at, 0.05])}, {"held_ticks": STALL, "held_at": at}
    held = [held_capsule(one, ForwardKinematics(one), state, arm) for one in (chain, turned)]
    ends = []
    for one, capsule in zip((chain, turned), held, strict=True):
        assert capsule is not None
        frame = ForwardKinematics(one).frames(at)[6]
        parts = one.holding(capsule).capsules[-5:]
        points = np.array([point for part in parts for point in (part.start, part.end)])
        ends.append(points @ frame[:3, :3].T + frame[:3, 3])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
