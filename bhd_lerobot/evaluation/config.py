"""Configuration of `bhd-eval`."""

from dataclasses import dataclass, field
from typing import Annotated, Any, cast

from lerobot.robots.config import RobotConfig

from bhd_lerobot.cluster.config import ENGINES, RayConfig, check_engine
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.options.declared import Count, OneOf, Options, Range, Share, Whole
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.registry import check_brain, check_robot_and_task, is_ours
from bhd_lerobot.robots.external.config import FPS, GateConfig
from bhd_lerobot.robots.host.config import check_view
from bhd_lerobot.tasks.free import FreeConfig
from bhd_lerobot.tasks.task import SPLITS, TaskConfig

YARDSTICKS = ("noop", "random")
"""Brains that are there to be compared with; `fail_below` does not apply to them."""


@dataclass
class EvalDatasetConfig:
    """Where the runs of an evaluation are recorded: a LeRobotDataset for each brain, named after it.

    Attributes:
        repo_id: name of the datasets on the Hub, `user/name`; `_` and the brain's name are added. By default
            nothing is recorded.
        root: folder for the brains' folders; by default LeRobot's place.
    """

    repo_id: str | None = None
    root: str | None = None


class Comparison(Options):
    """What every evaluation has: brains by name, one of them the baseline."""

    brains: dict[str, BrainConfig]
    brain: BrainConfig | None
    only: list[str] | None
    baseline: str | None
    seed: int
    record: EvalDatasetConfig
    sequential: bool
    fail_below: float | None

    @property
    def by_person(self) -> bool:
        """Whether a person sets up the scenes, or judges: then the brains run in turns, and which is not said."""
        return False

    @property
    def chosen(self) -> dict[str, BrainConfig]:
        """The brains that are run, in order."""
        return {label: brain for label, brain in self.brains.items() if self.only is None or label in self.only}

    @property
    def reference(self) -> str:
        """The brain that the others are compared with: the baseline, or the first that is run."""
        return self.baseline if self.baseline in self.chosen else next(iter(self.chosen))

    @property
    def heading(self) -> str:
        """Which episodes are run, as text."""
        raise NotImplementedError

    def again(self, episode: int) -> list[str]:
        """Return the options that run a single episode again."""
        raise NotImplementedError

    def _name_brains(self) -> None:
        """Refuse brains, or names of them, that are missing; `brain` becomes one of `brains`."""
        if self.brain is not None:
            name = str(self.brain.get_choice_name(type(self.brain)))
            if name in self.brains:
                raise ConfigError(f"There are two brains of the name {name!r}: brain, and one of brains. Rename one.")
            self.brains[name], self.brain = self.brain, None
        if not self.brains:
            raise ConfigError(
                "There is no brain to evaluate; set --brains.NAME.type, or --brain.path for a checkpoint."
            )
        for key, labels in (("only", self.only or []), ("baseline", [self.baseline] if self.baseline else [])):
            for label in labels:
                if label not in self.brains:
                    raise ConfigError(unknown_name(f"brain in {key}", label, self.brains))
        if self.only is not None and not self.only:
            raise ConfigError("only is empty; name at least one brain, or leave it out.")


@dataclass
class EvalConfig(Comparison):
    """Compare brains on the same episodes; with `--env.type=TYPE`, policies in an environment of LeRobot.

    Attributes:
        robot: the robot, in simulation; with `robot.clock=realtime` on the wall clock. A real robot runs the brains in
            turns, and a person sets up each scene without knowing which brain runs.
        task: the task, and its scenes; with a robot of another package `free`.
        brains: the brains to compare, each under a name of your choice: `--brains.NAME.type=…`. On a command line,
            `--brains.NAME=null` removes one of the file.
        brain: short for one more brain, named after its type: `--brain.type=…`; `--brain.path=…` alone is a checkpoint.
        only: run only these of the brains.
        n_episodes: number of episodes of each brain.
        episodes: run only these, by number, for example `[17]`: each is the same as in the whole run.
        seed: run seed, from which, with its number, each episode's seed is computed.
        split: set of seeds: `held_out`, `validation` or `train`.
        baseline: name of the brain with which the others are compared; by default the first.
        n_envs: number of parallel simulations; changes only the speed.
        threads: threads that step the physics; by default one for each processor.
        engine: where episodes run: `local`, in this process, or `ray`, on a cluster; changes only the speed.
        ray: the cluster, and the share of it that is used.
        videos: number of failures of each brain with a video, earliest first; a brain without failures gets one of its
            first episode. By default 2 if images can be rendered, otherwise none.
        view: show the simulation in MuJoCo's viewer, a window on this machine; of parallel simulations, the first. On
            the lockstep clock it moves as fast as it is simulated. Closing the window does not end the evaluation.
        gate: limits of what is sent to a robot of another package.
        fps: frames a second of a robot of another package [Hz]; 30 if 0. Ours have `robot.fps`.
        plan: print how many episodes show a difference of `plan_points`, and run none.
        plan_points: difference of two success rates that `plan` is about [percentage points].
        sequential: end as soon as a difference in success from the baseline is certain for every other brain, after
            `n_episodes` at the latest. The test may be repeated after every pair of episodes; in simulation it is
            after every `n_envs` of them.
        record: datasets in which the runs are recorded, if any.
        fail_below: end with exit status 1 if the lower end of a brain's 95 % interval of success is below this. It does
            not apply to `noop` and `random`.
        output_dir: folder for results and report; by default a new one in `outputs/eval`.
    """

    robot: RobotConfig
    task: TaskConfig
    brains: dict[str, BrainConfig] = field(default_factory=dict)
    brain: BrainConfig | None = None
    only: list[str] | None = None
    n_episodes: Count = 100
    episodes: list[Whole] | None = None
    seed: Whole = 0
    split: Annotated[str, OneOf(SPLITS)] = "held_out"
    baseline: str | None = None
    n_envs: Count = 16
    threads: Count | None = None
    engine: Annotated[str, OneOf(ENGINES)] = "local"
    ray: RayConfig = field(default_factory=RayConfig)
    videos: Whole | None = None
    view: bool = False
    gate: GateConfig = field(default_factory=GateConfig)
    fps: Whole = 0
    plan: bool = False
    plan_points: Annotated[float, Range("(0, 100)")] = 10.0
    sequential: bool = False
    record: EvalDatasetConfig = field(default_factory=EvalDatasetConfig)
    fail_below: Share | None = None
    output_dir: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_robot_and_task(self.robot, self.task, "bhd-eval")
        self._name_brains()
        for label, brain in self.brains.items():
            check_brain(f"brains.{label}", brain, self.robot)
        check_engine(self)
        check_view(self.view, self.robot)
        if isinstance(self.task, FreeConfig) and not self.is_live:
            raise ConfigError(
                "task.type is 'free', which a person judges, and robot.clock is 'lockstep', on which nobody can watch. "
                "Add --robot.clock=realtime, or choose a task that the simulator judges."
            )
        if not is_ours(self.robot.type):
            self.fps = self.fps or FPS
        self._check_episodes()
        self._check_comparison()

    @property
    def is_live(self) -> bool:
        """Whether the robot runs on the wall clock."""
        return not is_ours(self.robot.type) or cast(Any, self.robot).clock == "realtime"

    @property
    def by_person(self) -> bool:
        """Whether a person sets up the scenes, or judges: then the brains run in turns, and which is not said."""
        is_real = not is_ours(self.robot.type) or bool(cast(Any, self.robot).plant)
        return is_real or (self.is_live and isinstance(self.task, FreeConfig))

    @property
    def indices(self) -> list[int]:
        """Numbers of the episodes that are run, in ascending order."""
        return list(range(self.n_episodes)) if self.episodes is None else sorted(self.episodes)

    @property
    def heading(self) -> str:
        """Which episodes are run, as text."""
        return f"{len(self.indices)} {self.split.replace('_', '-')} episodes, seed {self.seed}"

    def again(self, episode: int) -> list[str]:
        """Return the options that run a single episode again."""
        return [f"--episodes=[{episode}]"]

    def _check_episodes(self) -> None:
        if self.episodes is not None and (not self.episodes or len(set(self.episodes)) != len(self.episodes)):
            raise ConfigError(f"episodes is {self.episodes}; it must name at least one episode, and none twice.")
        if self.fps and is_ours(self.robot.type):
            raise ConfigError(f"fps is {self.fps}, and robot.type is {self.robot.type!r}: set --robot.fps instead.")
        if self.record.root is not None and self.record.repo_id is None:
            raise ConfigError("record.root is set and record.repo_id is not; datasets need a name, such as me/eval.")

    def _check_comparison(self) -> None:
        """Refuse a plan, or a test, of what is not compared."""
        for name in ("plan", "sequential"):
            if not getattr(self, name):
                continue
            if self.baseline is not None and self.baseline not in self.chosen:
                raise ConfigError(
                    f"{name} is true and baseline is {self.baseline!r}, which only leaves out. Add it to only, or name "
                    f"another baseline: {', '.join(self.chosen)}."
                )
            if len(self.chosen) < 2:
                raise ConfigError(
                    f"{name} is true, and {next(iter(self.chosen))!r} is the only brain: nothing is compared. Add one "
                    "with --brains.NAME.type, or leave it out."
                )
        if self.sequential and self.engine != "local":
            raise ConfigError(
                f"sequential is true and engine is {self.engine!r}: a cluster runs all episodes at once. Use "
                "--engine=local, or leave sequential out."
            )
