"""A table without a simulator: observations for brains that give goals, and results for their goals."""

import math

import numpy as np

from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS, OBJECT_FIELDS, TableObject, TableScene
from bhd_lerobot.bodies.ur5 import MAX_OPENING, ur5
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Goals, ResultCode
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.tasks.pick import ENVIRONMENT

OBSERVED = ("shoulder_pan.pos", "gripper.pos")
CUP = TableObject("cup", "red", 0.03, 0.03, 0.10, 0.5, 0.0)
BOX = TableObject("box", "blue", 0.04, 0.03, 0.06, 0.4, 0.2)
HOME = ur5().home


def scene(*objects: TableObject, target: int = 0) -> TableScene:
    return TableScene("pick", objects, HOME, target_object=target)


class Desk:
    """n tables, a brain, and the goals that it has given; a test says how they end."""

    def __init__(self, brain, scenes: list[TableScene], instructions: list[str] | None = None) -> None:
        self.n, self.brain = len(scenes), brain
        self.state = np.tile([0.0, MAX_OPENING], (self.n, 1))
        self.table = np.zeros((self.n, MAX_OBJECTS, len(OBJECT_FIELDS)))
        self.table[:, :, OBJECT_FIELDS.index("qw")] = 1.0
        for sim, one in enumerate(scenes):
            for number, thing in enumerate(one.objects):
                self.put(sim, number, thing, number == one.target_object)
        self.given: list[list[BrainCommand]] = [[] for _ in range(self.n)]
        brain.bind(RobotFeatures(OBSERVED, OBSERVED, 25, ENVIRONMENT))
        brain.reset(np.arange(self.n), [0] * self.n, self.n, instructions or [""] * self.n)

    def put(self, sim: int, number: int, thing: TableObject, target: bool, lifted: float = 0.0) -> None:
        pose = (thing.x, thing.y, thing.height / 2 + lifted, math.cos(thing.yaw / 2), 0, 0, math.sin(thing.yaw / 2))
        size = (2 * thing.size_x, 2 * thing.size_y, thing.height)
        self.table[sim, number] = 1, target, thing.kind == "box", *pose, *size, *COLOURS[thing.colour]

    def lift(self, sim: int, number: int = 0, by: float = 0.15) -> None:
        self.table[sim, number, 5] += by

    def look(
        self, results: dict[int, list[CommandResult]] | None = None, running: np.ndarray | None = None
    ) -> dict[int, BrainCommand]:
        """Let the brain see the tables; return the new goals."""
        environment = self.table.reshape(self.n, -1)
        goals = self.brain.act(Observation(OBSERVED, self.state, {}, environment, results or {}, running))
        assert isinstance(goals, Goals)
        new = {}
        for sim, commands in goals.commands.items():
            assert len(commands) == 1
            new[sim] = commands[0]
            assert new[sim].task_id not in [one.task_id for one in self.given[sim]]
            self.given[sim].append(new[sim])
        return new

    def end(self, sim: int = 0, success: bool = True, message: str = "") -> BrainCommand | None:
        """End the last goal of a simulation; return the next."""
        code = ResultCode.SUCCEEDED if success else ResultCode.PATH_TOLERANCE
        result = CommandResult(self.given[sim][-1].task_id, success, code, message)
        return self.look({sim: [result]}).get(sim)

    def steps(self, sim: int = 0) -> list[str]:
        """Return the goals so far, by what their names say."""
        return [one.task_id.split("-", 1)[1] for one in self.given[sim]]
