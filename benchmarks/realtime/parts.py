"""What the benchmark consists of: loops that take turns, and experiments that are done once."""

import os
import random
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.realtime.cases import Case, CaseError, cyclictest_case, python_case
from benchmarks.realtime.injections import (
    WATCHDOGS,
    Drops,
    Losses,
    PlantStop,
    Stops,
    count_drops,
    drops_spec,
    kill_brain,
    kill_cerebellum,
    lose_spec,
    plant_spec,
    press_stops,
    stop_brain,
)
from benchmarks.realtime.load import cpu_load
from benchmarks.realtime.owner import OwnerSpec
from benchmarks.realtime.robots import OwnedRobot, owned_robot, robot_case
from benchmarks.realtime.stage import FPS, HZ
from bhd_lerobot.errors import unknown_name

TITLES = {
    "twin": "C++ twin",
    "bhd": "bhd-lerobot, UR5",
    "python": "plain Python, own process",
    "cyclictest": "cyclictest",
    "thread": "Python beside a busy thread",
    "torch": "… with a torch brain and video",
    "running": "… recorder running",
    "stopped": "… recorder stopped",
}
EXPERIMENTS = {
    "estop": "emergency stops",
    "brain": "losses of the brain",
    "drops": "losses of the recorder",
    "plant": "losses of the cerebellum",
}
PARTS = {
    "loop": ("twin", "bhd", "python", "cyclictest", "thread"),
    "recording": ("bhd", "torch"),
    "recorder": ("running", "stopped", "drops"),
}
NAMES = (*TITLES, *EXPERIMENTS)
_RATES = {"control_hz": HZ, "physics_hz": HZ, "fps": FPS}
_LOAD_S = 600.0


def expand(names: Sequence[str]) -> list[str]:
    """Return what names of parts, cases and experiments stand for, in the order of `NAMES`.

    Raises:
        ValueError: there is nothing of such a name.
    """
    chosen: set[str] = set()
    for name in names:
        if name not in PARTS and name not in NAMES:
            raise ValueError(unknown_name("part", name, (*PARTS, *NAMES)))
        chosen.update(PARTS.get(name, (name,)))
    return [name for name in NAMES if name in chosen]


@dataclass
class Experiments:
    """What the experiments found; None of those that were not done.

    Attributes:
        stops: by robot and condition.
        losses: of the brain.
        drops: of the recorder.
        plant: kills of the cerebellum.
        missing: why an experiment was not done, or not to its end.
    """

    stops: dict[tuple[str, str], Stops] = field(default_factory=dict)
    losses: Losses | None = None
    drops: Drops | None = None
    plant: list[PlantStop] | None = None
    missing: dict[str, str] = field(default_factory=dict)


class Bench:
    """Makes cases and robots, and ends them all.

    Args:
        folder: where everything may write.
        stack: ends what was started.
        say: is told what is going on.
    """

    def __init__(self, folder: Path, stack: ExitStack, say: Callable[[str], None]) -> None:
        self.folder, self._stack, self._say = folder, stack, say
        self.reports: list[dict[str, Any]] = []
        self._robots: dict[str, OwnedRobot] = {}

    def cases(self, names: Sequence[str], absent: dict[str, str]) -> list[Case]:
        """Return the cases of these names; why one cannot be is written into `absent`."""
        # All robots start at the same time: most of it is importing.
        for name in names:
            if name in ("bhd", "torch", "running", "stopped"):
                self._robot(name)
        cases = []
        for name in names:
            self._say(f"preparing {TITLES[name]}")
            try:
                cases.append(self._case(name))
            except CaseError as error:
                absent[name] = str(error)
                self._say(f"LEFT OUT: {TITLES[name]}: {error}")
        return cases

    def _case(self, name: str) -> Case:
        title = TITLES[name]
        if name == "twin":
            from benchmarks.realtime.twin import twin_case

            return twin_case(self.folder)
        if name == "cyclictest":
            return cyclictest_case()
        if name in ("python", "thread"):
            return python_case(self.folder, beside_busy_thread=name == "thread")
        robot = self._robot(name)
        robot.prepare()
        robot.sleep()
        return robot_case(name, title, robot, reports=self.reports, stop="recorder" if name == "stopped" else "")

    def _robot(self, case: str) -> OwnedRobot:
        name = "recorder" if case in ("running", "stopped") else case
        if name not in self._robots:
            if name == "recorder":
                # The robot is to go on, though its recorder is stopped for a whole block.
                spec = self.spec(name, {"recorder_timeout_s": 3600.0}, drive="setpoints")
            else:
                config = {"camera": name == "torch"}
                spec = self.spec(name, {}, config, drive="episode", network=name == "torch")
            self._robots[name] = self._stack.enter_context(owned_robot(spec))
        return self._robots[name]

    def spec(self, name: str, realtime: dict[str, Any], config: dict[str, Any] | None = None, **more: Any) -> OwnerSpec:
        """Return a UR5 at the benchmark's rates."""
        return OwnerSpec(
            self.name(name), "ur5", {**_RATES, **(config or {})}, realtime, folder=str(self.folder), **more
        )

    def name(self, what: str) -> str:
        """Return a name for a robot that no other has."""
        return f"bench-{os.getpid()}-{what}"

    # --- experiments -------------------------------------------------------------------------------------------------

    def experiments(self, names: Sequence[str], conditions: Sequence[str], sizes: "Sizes") -> Experiments:
        """Do experiments, one after the other; one that cannot be done is left out, and why is kept."""
        found, rng = Experiments(), random.Random(0)
        doing: dict[str, Callable[[], None]] = {
            "estop": lambda: self._stop_robots(found, conditions, sizes, rng),
            "brain": lambda: self._lose_brains(found, sizes, rng),
            "drops": lambda: self._lose_states(found, sizes),
            "plant": lambda: self._lose_cerebellum(found, sizes, rng),
        }
        for name in names:
            self._say(EXPERIMENTS[name])
            try:
                doing[name]()
            except CaseError as error:
                found.missing[name] = str(error)
                self._say(f"LEFT OUT: {EXPERIMENTS[name]}: {error}")
        return found

    def _stop_robots(self, found: Experiments, conditions: Sequence[str], sizes: "Sizes", rng: random.Random) -> None:
        kinds = {"ur5": self.spec("estop-ur5", {}), "turtlebot3": OwnerSpec(self.name("estop-base"), "turtlebot3")}
        count = -(-sizes.presses // (len(kinds) * len(conditions)))
        with ExitStack() as stack:
            robots = {kind: stack.enter_context(owned_robot(spec)) for kind, spec in kinds.items()}
            for robot in robots.values():
                robot.prepare()
            for condition in conditions:
                loaded: AbstractContextManager[Any] = cpu_load(_LOAD_S) if condition == "load" else nullcontext()
                with loaded:
                    for kind, robot in robots.items():
                        self._say(f"{count} emergency stops of the {kind}, {condition}")
                        stops = found.stops[kind, condition] = Stops()
                        press_stops(robot, count, stops, rng)

    def _lose_brains(self, found: Experiments, sizes: "Sizes", rng: random.Random) -> None:
        losses = Losses()
        for number in range(sizes.kills):
            specs = [lose_spec(self.name(f"{drive}-{number}"), drive, str(self.folder)) for drive in WATCHDOGS]
            with ExitStack() as stack:
                robots = [stack.enter_context(owned_robot(spec)) for spec in specs]
                for robot in robots:
                    robot.prepare()
                    self._say(f"the brain of {robot.spec.name} is stopped and killed")
                    if number == 0:
                        stop_brain(robot, sizes.losses, losses, rng)
                    kill_brain(robot, losses, rng)
        found.losses = losses

    def _lose_states(self, found: Experiments, sizes: "Sizes") -> None:
        with owned_robot(drops_spec(self.name("drops"), str(self.folder))) as robot:
            robot.prepare()
            found.drops = count_drops(robot, list(sizes.stopped_s))

    def _lose_cerebellum(self, found: Experiments, sizes: "Sizes", rng: random.Random) -> None:
        stops = []
        for number in range(sizes.kills):
            with owned_robot(plant_spec(self.name(f"plant-{number}"), str(self.folder))) as robot:
                robot.prepare()
                stops.append(kill_cerebellum(robot, rng))
        found.plant = stops


@dataclass(frozen=True)
class Sizes:
    """How often experiments are repeated.

    Attributes:
        presses: emergency stops, of all robots under all conditions.
        losses: how often each brain is stopped.
        kills: how often each brain and the cerebellum are killed; each takes a new robot.
        stopped_s: how long the recorder is stopped, one time after the other [s].
    """

    presses: int = 1000
    losses: int = 10
    kills: int = 3
    stopped_s: tuple[float, ...] = (0.2, 0.6, 1.0, 1.5, 2.0)


QUICK_SIZES = Sizes(40, 3, 1, (0.2, 1.0))
