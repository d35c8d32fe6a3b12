"""A table without a simulator: observations for brains that give goals, and results for their goals."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS, OBJECT_FIELDS, TableObject, TableScene
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Goals, ResultCode
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.pick import ENVIRONMENT
from bhd_lerobot.tasks.task import Task, TaskConfig

OBSERVED = ("shoulder_pan.pos", "gripper.pos")
CUP = TableObject("cup", "red", 0.03, 0.03, 0.10, 0.5, 0.0)
BOX = TableObject("box", "blue", 0.04, 0.03, 0.06, 0.4, 0.2)
HOME = ur5().arm.home


def scene(*objects: TableObject, target: int = 0) -> TableScene:
    return TableScene("pick", objects, HOME, target_object=target)


class Bench:
    """n simulations without a simulator, a brain, and the goals that it has given; a test says how they end."""

    failure, message = ResultCode.PATH_TOLERANCE, ""

    def __init__(
        self, brain, environment: np.ndarray, names: Sequence[str], observed: Sequence[str] = OBSERVED
    ) -> None:
        self.n, self.brain, self.environment = len(environment), brain, environment
        self.observed, self.names = observed, names
        self.state = np.zeros((self.n, len(observed)))
        self.given: list[list[BrainCommand]] = [[] for _ in range(self.n)]

    def begin(self, instructions: Sequence[str] = ()) -> None:
        self.brain.bind(RobotFeatures(self.observed, self.observed, 25, self.names, body=ur5()))
        self.brain.reset(np.arange(self.n), [0] * self.n, self.n, instructions or [""] * self.n)

    def look(
        self, results: dict[int, list[CommandResult]] | None = None, running: np.ndarray | None = None
    ) -> dict[int, BrainCommand]:
        """Let the brain see the simulations; return the new goals."""
        environment = self.environment.reshape(self.n, -1)
        return self.show(Observation(self.observed, self.state, {}, environment, results or {}, running))

    def show(self, observation: Observation) -> dict[int, BrainCommand]:
        """Let the brain see this; return the new goals."""
        goals = self.brain.act(observation)
        assert isinstance(goals, Goals)
        new = {}
        for sim, commands in goals.commands.items():
            (new[sim],) = commands
            assert new[sim].task_id not in [one.task_id for one in self.given[sim]]
            self.given[sim].append(new[sim])
        return new

    def end(self, sim: int = 0, success: bool = True, message: str = "") -> BrainCommand | None:
        """End the last goal of a simulation; return the next."""
        code = ResultCode.SUCCEEDED if success else self.failure
        result = CommandResult(self.given[sim][-1].task_id, success, code, message or self.message)
        return self.look({sim: [result]}).get(sim)

    def steps(self, sim: int = 0) -> list[str]:
        """Return the goals so far, by what their names say."""
        return [one.task_id.rsplit("-", 1)[1] for one in self.given[sim]]


class Desk(Bench):
    """n tables."""

    def __init__(self, brain, scenes: list[TableScene], instructions: Sequence[str] = ()) -> None:
        self.table = np.zeros((len(scenes), MAX_OBJECTS, len(OBJECT_FIELDS)))
        self.table[:, :, OBJECT_FIELDS.index("qw")] = 1.0
        super().__init__(brain, self.table, ENVIRONMENT)
        self.state[:, 1] = MAX_OPENING
        for sim, one in enumerate(scenes):
            for number, thing in enumerate(one.objects):
                self.put(sim, number, thing, number == one.target_object)
        self.begin(instructions)

    def put(self, sim: int, number: int, thing: TableObject, target: bool, lifted: float = 0.0) -> None:
        pose = (thing.x, thing.y, thing.height / 2 + lifted, math.cos(thing.yaw / 2), 0, 0, math.sin(thing.yaw / 2))
        size = (2 * thing.size_x, 2 * thing.size_y, thing.height)
        self.table[sim, number] = 1, target, thing.kind == "box", *pose, *size, *COLOURS[thing.colour]

    def lift(self, sim: int, number: int = 0, by: float = 0.15) -> None:
        self.table[sim, number, 5] += by


def episodes(
    brain, task: Callable[..., Task], config: TaskConfig, seeds: Sequence[int], *, n: int = 0, simulation=None, **robot
) -> list[Episode]:
    """Return the episodes of a brain in the simulator, by their seeds; all side by side unless `n` is given."""
    simulation = simulation or Simulation(UR5Config(**robot), n or len(seeds), threads=1)
    judge = task(config, simulation.n, simulation.config.fps)
    return list(EpisodeLoop(simulation, judge, brain).run([EpisodeSpec(k, seed) for k, seed in enumerate(seeds)]))
