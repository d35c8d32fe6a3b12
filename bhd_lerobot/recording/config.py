"""Configuration of `bhd-record`."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.cluster.config import RayConfig, check_engine
from bhd_lerobot.control.estop import estop_signal
from bhd_lerobot.control.tolerance import TimingTolerance
from bhd_lerobot.datasets.format.identity import local_name
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.recording.live_view import check_options
from bhd_lerobot.registry import check_brain, check_robot_and_task
from bhd_lerobot.tasks.task import SPLITS, TaskConfig


@dataclass
class DatasetConfig:
    """What is recorded and where. The names are those of `lerobot-record`.

    Attributes:
        repo_id: name of the dataset on the Hub, `user/name`; `local/` and the folder's name if only `root` is given.
        root: folder of the dataset; LeRobot's default place if nothing.
        fps: frames a second [Hz]; the robot's own if 0.
        num_episodes: number of episodes that the dataset holds in the end.
        episode_time_s: longest duration of an episode [s]; the task's if nothing.
        language: also write what the brain was doing, and its plan, into LeRobot's column `language_persistent`, for
            brains with a plan. Off, because PyTorch's own collating and `lerobot-dataset-viz` fail on that column;
            LeRobot's training knows it.
        expert_action: also record what the expert would do in every frame, `expert.action`: of the brain `dagger` its
            expert; of any other rule what it does.
        push_to_hub: upload the dataset when it is complete.
        private: whether the uploaded dataset is private.
        tags: tags of the uploaded dataset.
    """

    repo_id: str = ""
    root: str | None = None
    fps: int = 0
    num_episodes: int = 50
    episode_time_s: float | None = None
    language: bool = False
    expert_action: bool = False
    push_to_hub: bool = False
    private: bool = False
    tags: list[str] = field(default_factory=list)


@dataclass
class RecordConfig:
    """Record episodes of a simulated robot, driven by a brain, into a LeRobotDataset.

    Attributes:
        robot: the robot; its `fps` is the dataset's.
        dataset: what is recorded and where.
        brain: what drives the robot.
        task: what it is to achieve, and where.
        timing: how unpunctual frames may be, and what becomes of an episode with too many of them.
        seed: every episode's seed follows from this and its number.
        split: `train`, `validation` or `held_out`: which set of seeds.
        n_envs: simulations that run side by side; changes the speed and nothing else.
        threads: threads that step the physics; all processors if nothing.
        engine: where episodes run: `local`, in this process, or `ray`, on a cluster; changes the speed, nothing else.
        ray: which cluster, and how much of it.
        resume: continue the dataset at `dataset.root`, or start it if there is none.
        output_dir: run folder, for the resolved configuration and images; a new one in `outputs/record` if nothing.
        preview_video: make an MP4 of the first episode; if nothing, where images can be rendered.
        estop_key: space or `e` in the terminal is an emergency stop, `s` ends the episode as a success and `f` as a
            failure, and with `i` an intervention begins or ends; if nothing, where there is a terminal and the robot
            runs on the wall clock.
        estop_signal: this signal is an emergency stop, too: `SIGUSR1`, `SIGUSR2` or `SIGQUIT`.
        display_data: show what happens live in Rerun or Foxglove; of robots side by side the first. The names of these
            options are those of `lerobot-record`.
        display_mode: where: `rerun` or `foxglove`.
        display_ip: for `rerun`, where a viewer runs, if not here; for `foxglove`, the interface that it can connect to,
            127.0.0.1 if nothing.
        display_port: for `rerun`, the viewer's port, if it does not run here; for `foxglove`, the port that it can
            connect to, 8765 if nothing.
        display_compressed_images: send images as JPEG; always so to a viewer that does not run here.
    """

    robot: RobotConfig
    brain: BrainConfig
    task: TaskConfig
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    timing: TimingTolerance = field(default_factory=TimingTolerance)
    seed: int = 0
    split: str = "train"
    n_envs: int = 1
    threads: int | None = None
    engine: str = "local"
    ray: RayConfig = field(default_factory=RayConfig)
    resume: bool = False
    output_dir: str | None = None
    preview_video: bool | None = None
    estop_key: bool | None = None
    estop_signal: str = "SIGUSR1"
    display_data: bool = False
    display_mode: str = "rerun"
    display_ip: str | None = None
    display_port: int | None = None
    display_compressed_images: bool = False

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        if not self.dataset.repo_id:
            if self.dataset.push_to_hub:
                raise ConfigError("dataset.push_to_hub is true: set --dataset.repo_id=user/name, or leave it out.")
            self.dataset.repo_id = local_name(self.dataset.root)
        check_robot_and_task(self.robot, self.task, "bhd-record")
        check_brain("brain", self.brain, self.robot.type)
        for name, value in (
            ("dataset.num_episodes", self.dataset.num_episodes),
            ("n_envs", self.n_envs),
            ("threads", 1 if self.threads is None else self.threads),
        ):
            if value < 1:
                raise ConfigError(f"{name} is {value}; it must be at least 1.")
        if self.seed < 0:
            raise ConfigError(f"seed is {self.seed}; seeds start at 0.")
        check_options(self)
        check_engine(self)
        estop_signal(self.estop_signal)
        if self.split not in SPLITS:
            raise ConfigError(f"split is {self.split!r}. Valid: {', '.join(SPLITS)}.")
        robot: Any = self.robot
        if self.dataset.fps == 0:
            self.dataset.fps = robot.fps
        if robot.fps not in (self.dataset.fps, type(robot).fps):
            raise ConfigError(
                f"robot.fps is {robot.fps} and dataset.fps is {self.dataset.fps}; leave robot.fps out, "
                "the robot acts at the dataset's rate."
            )
        robot.fps = self.dataset.fps
        _ = robot.rates
        if self.dataset.episode_time_s is not None:
            if not 0 < self.dataset.episode_time_s < float("inf"):
                raise ConfigError(f"dataset.episode_time_s is {self.dataset.episode_time_s}; it must be positive.")
            chosen: Any = self.task
            if chosen.duration_s not in (type(chosen).duration_s, self.dataset.episode_time_s):
                raise ConfigError(
                    f"task.duration_s is {chosen.duration_s} and dataset.episode_time_s is "
                    f"{self.dataset.episode_time_s}. Both say how long an episode may take; set them alike, or one."
                )
            chosen.duration_s = self.dataset.episode_time_s
