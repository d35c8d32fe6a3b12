"""What a robot reports of itself beside its readings: by the record of its last tick, whoever reads it."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.control.drive import twist_from_wheels
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.registry import make_simulation, robot_configs
from tests.cases import each_case

ROBOTS: list[tuple[str, dict[str, Any]]] = [
    ("turtlebot3", {"beams": 24}),
    ("ur5", {"wrench": True}),
    ("ur5", {"control": "impedance", "action_space": "tool", "tool_pose": True}),
    ("so101", {"camera": False}),
    ("turtlebot3_manipulation", {"camera": False}),
]


@each_case("robot", ROBOTS)
@pytest.mark.parametrize("measures", [True, False], ids=["measured", "commanded"])
def test_reports_are_of_what_was_read_in_the_last_tick(robot: tuple[str, dict[str, Any]], measures: bool) -> None:
    kind, options = robot
    arm = make_simulation(robot_configs()[kind](**options), 2, threads=1)  # type: ignore[call-arg]
    cerebellum, plant, read = arm.cerebellum, arm.plant, arm.plant.read
    if not measures:

        def read_without(out: Any) -> None:
            read(out)
            out.has_effort = False
            out.effort[:] = 0.0

        plant.read = read_without
    scene = None if arm.body.drive is None else make_arena("empty", 0)
    arm.reset(np.arange(2), [scene, scene], [0, 1])
    seen = arm.bridge.state()  # no tick has run yet
    joints = 0 if arm.body.arm is None else len(arm.body.arm.limits.names)
    rng = np.random.default_rng(0)
    for frame in range(6):
        reading = cerebellum.reading
        if arm.body.drive is not None:
            wheels = twist_from_wheels(arm.body.need(Drive), reading.velocity[:, joints:])
            np.testing.assert_array_equal(seen.measured[:, -2:], wheels)
        if options.get("control") == "impedance":
            tool = pose_vectors(arm.kinematics.tool(reading.position[:, :6]))
            np.testing.assert_allclose(seen.measured[:, :7], tool, atol=1e-9)
        else:
            np.testing.assert_array_equal(seen.measured[:, :joints], reading.position[:, :joints])
        if measures:
            np.testing.assert_array_equal(seen.joint_efforts, reading.effort)
        elif frame:
            assert seen.joint_efforts.any(axis=1).all()
            most = arm.body.arm.limits.effort if joints else ()
            assert (np.abs(seen.joint_efforts[:, :joints]) <= np.array(most)).all()
        report = arm.step(cerebellum.command + rng.uniform(-0.02, 0.02, cerebellum.command.shape))
        seen = arm.bridge.state()
        np.testing.assert_array_equal(report.columns["control.effort"], seen.joint_efforts)
    arm.close()
