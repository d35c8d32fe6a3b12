"""Records for mailboxes, and the processes at the other end of them."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.motion.planner import Plan
from bhd_lerobot.control.motion.trajectory import PlanFailure, Trajectory
from bhd_lerobot.realtime.mailbox import Mailbox
from bhd_lerobot.realtime.planning_link import PlanServer
from tests.control.support import shared_block

RECORD = np.dtype([("number", np.int64), ("flag", np.bool_), ("copies", np.int64, (100,))])  # 809 bytes: not aligned
CAPACITY = 4
DURATION_S = 1.0


def record(number: int) -> np.void:
    value = np.zeros(1, RECORD)[0]
    value["number"], value["flag"], value["copies"] = number, number % 2, number
    return value


class RampPlanner:
    """Plans as many ticks as the goal's `timeout_s` says, whose rows are the start and what its `gripper` adds."""

    def __init__(self, dof: int = 6, hz: int = 100) -> None:
        self.dof, self.width, self.hz = dof, dof + 1, hz
        self.planned: list[BrainCommand] = []

    def plan(
        self,
        command: BrainCommand,
        position: Any,
        velocity: Any,
        acceleration: Any,
        *,
        opening: float | None = None,
        held: Any = None,
    ) -> Plan | PlanFailure:
        self.planned.append(command)
        if command.max_velocity is not None:
            return PlanFailure(ResultCode.UNREACHABLE, f"{command.max_velocity} is what was asked for. " + "é" * 300)
        if command.max_acceleration is not None:
            raise ZeroDivisionError("no planner plans this")
        steps = (command.gripper or 0.0) * np.arange(1, int(command.timeout_s) + 1)[:, None]
        trajectory = Trajectory(position + steps, velocity + steps, acceleration + steps)
        return Plan(trajectory, np.full(self.dof + 1, -1.0 if opening is None else opening))


def post_numbers(path: Path, count: int) -> None:
    mailbox = Mailbox(RECORD, CAPACITY, shared_block(path))
    for number in range(count):
        while not mailbox.post(record(number)):
            pass


def serve_plans(path: Path, count: int) -> None:
    planner = RampPlanner()
    server = PlanServer(shared_block(path), planner, duration_s=DURATION_S)  # type: ignore[arg-type]
    server.serve(lambda: len(planner.planned) == count, lambda: time.sleep(1e-4))
