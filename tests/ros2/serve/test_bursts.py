"""Bursts and floods of real nodes: each goal has exactly one result, and the emergency stop waits behind none."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bhd_lerobot.ros2.serve.interface import COMMAND, COMMAND_TOPIC
from tests.ros2.peer_env import Peer, environment
from tests.ros2.programs import Program, Served
from tests.ros2.serve.bridges import FORWARD, NEAR, STAND, TWIST, arm, base, twist
from tests.waiting import until

COUNT = 100
GOALS = {  # one that can be followed and one that cannot; why others than the first are refused or end early
    "turtlebot3": (("--goal=0.3,0,0", "--goal=nan,0,0"), ("took its place", "The target pose is")),
    "ur5": ((NEAR[0], "--goal=3,0,0.3,0,1,0,0"), ("goals wait already", "too far away")),
}


@contextmanager
def running(robot: str, domain: int, folder: Path, *, is_bridge: bool) -> Iterator[Program]:
    environment(messages=True)
    if not is_bridge:
        with Served(robot, domain=domain, log=folder / "log") as served:
            yield served
    elif robot == "ur5":
        with arm(domain, folder) as (bridge, _, _):
            yield bridge
    else:
        with base(domain, folder) as (side, _, _):
            yield side.served


@pytest.mark.parametrize("is_bridge", [False, True], ids=["served", "bridge"])
@pytest.mark.parametrize("robot", GOALS)
def test_each_goal_of_a_burst_has_one_result(robot: str, is_bridge: bool, domain: int, tmp_path: Path) -> None:
    goals, causes = GOALS[robot]
    with (
        running(robot, domain, tmp_path, is_bridge=is_bridge) as program,
        # A deeper queue than the usual ten: this process may wait for its turn while results come.
        Peer("brain_node.py", *goals, f"--burst={COUNT}", f"--depth={COUNT}", domain=domain) as brain,
    ):
        summary = brain.wait_event("summary")
        program.wait_for(f": {COMMAND_TOPIC}: ")  # refused ones are counted
    counts = {key: summary[key] for key in ("sent", "once", "twice", "never", "unknown")}
    assert counts == {"sent": COUNT, "once": COUNT, "twice": 0, "never": 0, "unknown": 0}
    results = brain.events("result")
    assert any(line["success"] for line in results), results
    for cause in causes:
        assert any(cause in line["message"] for line in results if not line["success"]), cause


AHEAD = {"task_id": "flood", "target_pose": {"position": {"x": 0.3}, "orientation": {"w": 1.0}}}


@pytest.mark.parametrize(
    ("topic", "msgtype", "fields"),
    [("/brain/cmd_vel", TWIST, FORWARD), (COMMAND_TOPIC, COMMAND, AHEAD)],
    ids=["twists", "goals"],
)
def test_a_flood_through_a_bridge_is_followed_and_the_stop_is_not_behind_it(
    topic: str, msgtype: str, fields: dict[str, Any], domain: int, tmp_path: Path
) -> None:
    environment(messages=True)
    with base(domain, tmp_path) as (side, _, log):
        with Peer("topic.py", "pub", topic, msgtype, json.dumps(fields), "--hz=1000", domain=domain):
            until(lambda: twist(log)[0] > 0.05, "it drives")
            side.press()
            until(lambda: twist(log) == STAND, "it is stopped")
            side.reset()
            until(lambda: twist(log)[0] > 0.05, "it drives again")
        until(lambda: twist(log) == STAND, "it stands after the flood")
