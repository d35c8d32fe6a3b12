"""Configuration of `bhd-record`."""

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, cast

from lerobot.robots.config import RobotConfig

from bhd_lerobot.cluster.config import ENGINES, RayConfig, check_engine
from bhd_lerobot.datasets.format.identity import local_name
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, NotNegative, OneOf, Options, Positive, Range, Whole
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.teleop.config import PersonConfig, TeleopConfig
from bhd_lerobot.policies.topic.config import TopicConfig
from bhd_lerobot.realtime.estop import estop_signal
from bhd_lerobot.recording.live_view import PACKAGES, check_display
from bhd_lerobot.registry import check_brain, check_robot_and_task, is_ours
from bhd_lerobot.robots.external.config import FPS, GateConfig
from bhd_lerobot.robots.host.config import check_view
from bhd_lerobot.rollout.tolerance import TimingTolerance
from bhd_lerobot.tasks.free import FreeConfig
from bhd_lerobot.tasks.task import SPLITS, TaskConfig
from bhd_lerobot.teleoperators import (  # noqa: F401  registers them
    config_bhd_keyboard_arm,
    config_bhd_keyboard_base,
)


@dataclass
class DatasetConfig(Options, prefix="dataset."):
    """What is recorded and where. The names are those of `lerobot-record`.

    Attributes:
        repo_id: name of the dataset on the Hub, `user/name`; by default `local/` and the folder's name.
        root: folder of the dataset; by default LeRobot's place for `repo_id`.
        fps: frames a second [Hz]; the robot's own if 0.
        num_episodes: total number of episodes in the dataset.
        reset_time_s: time to set up the scene of a real robot between two episodes [s]; Enter ends it, and a
            teleoperator drives the robot meanwhile.
        episode_time_s: maximum duration of an episode [s]; by default the task's.
        language: also write the brain's plan and its current step into LeRobot's column `language_persistent`, for
            brains with a plan. Off by default, because PyTorch's collating and `lerobot-dataset-viz` fail on that
            column; LeRobot's training supports it.
        expert_action: also record the expert's action in every frame, `expert.action`: with the brain `dagger`, that
            of its expert; with another rule, the rule's own action.
        push_to_hub: upload the dataset when it is complete.
        private: whether the uploaded dataset is private.
        tags: tags of the uploaded dataset.
    """

    of_lerobot: ClassVar[dict[str, str]] = {
        "single_task": "--task.type=free --task.instruction='…'",
        "video": "--robot.camera=true or false; images of other robots are those of --robot.cameras",
        "no_stamp": "leave it out; a folder is named as it is given",
        **dict.fromkeys(
            (
                "num_image_writer_processes",
                "num_image_writer_threads_per_camera",
                "video_encoding_batch_size",
                "streaming_encoding",
                "encoder_queue_maxsize",
                "encoder_threads",
                "rgb_encoder",
                "depth_encoder",
            ),
            "leave it out; images are encoded while the robot runs, by a process of its own",
        ),
    }

    repo_id: str = ""
    root: str | None = None
    fps: Whole = 0
    num_episodes: Count = 50
    episode_time_s: Positive | None = None
    reset_time_s: NotNegative = 0.0
    language: bool = False
    expert_action: bool = False
    push_to_hub: bool = False
    private: bool = False
    tags: list[str] = field(default_factory=list)


@dataclass
class RecordConfig(Options):
    """Record episodes of a robot, driven by a brain or a person, into a LeRobotDataset.

    Attributes:
        robot: the robot; its `fps` is the dataset's.
        dataset: contents and place of the dataset.
        task: the task, and its scenes; `free` by default.
        brain: the brain that drives the robot.
        teleop: the teleoperator with which a person drives the robot or, beside a brain, takes over from it; short for
            `brain.type=teleop`. Any teleoperator of LeRobot and of plug-ins.
        map: sources of the robot's actions among those of the teleoperator, see the brain `teleop`.
        processor: function between teleoperator and robot, see the brain `teleop`.
        gate: limits of what is sent to a robot of another package.
        timing: tolerance for late frames, and whether an episode with too many of them is rejected.
        seed: run seed, from which, with its number, each episode's seed is computed.
        split: set of seeds: `train`, `validation` or `held_out`.
        n_envs: number of parallel simulations; changes only the speed.
        threads: threads that step the physics; by default one for each processor.
        engine: where episodes run: `local`, in this process, or `ray`, on a cluster; changes only the speed.
        ray: the cluster, and the share of it that is used.
        resume: continue the dataset at `dataset.root`, or start it if there is none.
        output_dir: run folder, for the resolved configuration and images; by default a new one in `outputs/record`.
        preview_video: make an MP4 of the first episode; by default if images can be rendered.
        estop_key: space or `e` in the terminal triggers an emergency stop, `s` ends the episode as a success, `f` as a
            failure, and `i` begins or ends an intervention (Enter, Backspace and Tab with a keyboard teleoperator of
            ours); by default if there is a terminal and the robot runs on the wall clock.
        estop_signal: signal that also triggers an emergency stop: `SIGUSR1`, `SIGUSR2` or `SIGQUIT`.
        bell: ring the terminal's bell when a take on the wall clock begins and when it ends.
        view: show the simulation in MuJoCo's viewer, a window on this machine; of parallel simulations, the first. On
            the lockstep clock it moves as fast as it is simulated. Closing the window does not end the recording.
        display_data: show the recording live in Rerun or Foxglove; of parallel simulations, the first. The names of
            these options are those of `lerobot-record`.
        display_mode: the viewer.
        display_ip: for `rerun`, the address of a viewer on another machine; for `foxglove`, the interface that it can
            connect to, by default 127.0.0.1.
        display_port: for `rerun`, the port of a viewer on another machine; for `foxglove`, the port that it can connect
            to, by default 8765.
        display_compressed_images: send images as JPEG; always on for a viewer on another machine.
    """

    of_lerobot: ClassVar[dict[str, str]] = {
        "policy": "--brain.type=learned --brain.path=CHECKPOINT",
        "play_sounds": "leave it out; a terminal's bell takes their place",
        "interpolation_multiplier": "leave it out; setpoints are interpolated at robot.control_hz",
    }

    robot: RobotConfig
    task: TaskConfig = field(default_factory=FreeConfig)
    brain: BrainConfig | None = None
    teleop: PersonConfig | None = None
    map: dict[str, Any] = field(default_factory=dict)
    processor: str = ""
    gate: GateConfig = field(default_factory=GateConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    timing: TimingTolerance = field(default_factory=TimingTolerance)
    seed: Whole = 0
    split: Annotated[str, OneOf(SPLITS)] = "train"
    n_envs: Count = 1
    threads: Count | None = None
    engine: Annotated[str, OneOf(ENGINES)] = "local"
    ray: RayConfig = field(default_factory=RayConfig)
    resume: bool = False
    output_dir: str | None = None
    preview_video: bool | None = None
    estop_key: bool | None = None
    estop_signal: str = "SIGUSR1"
    bell: bool = True
    view: bool = False
    display_data: bool = False
    display_mode: Annotated[str, OneOf(PACKAGES)] = "rerun"
    display_ip: str | None = None
    display_port: Annotated[int, Range("[1, 65535]")] | None = None
    display_compressed_images: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.dataset.repo_id:
            if self.dataset.push_to_hub:
                raise ConfigError("dataset.push_to_hub is true: set --dataset.repo_id=user/name, or leave it out.")
            self.dataset.repo_id = local_name(self.dataset.root)
        check_robot_and_task(self.robot, self.task, "bhd-record")
        self._settle_brain()
        check_display(self)
        check_view(self.view, self.robot)
        check_engine(self)
        estop_signal(self.estop_signal)
        robot: Any = self.robot
        if not is_ours(robot.type):
            self.dataset.fps = self.dataset.fps or FPS
            self._settle_duration()
            return
        if self.dataset.fps == 0:
            self.dataset.fps = robot.fps
        if robot.fps not in (self.dataset.fps, type(robot).fps):
            raise ConfigError(
                f"robot.fps is {robot.fps} and dataset.fps is {self.dataset.fps}; leave robot.fps out, "
                "the robot acts at the dataset's rate."
            )
        robot.fps = self.dataset.fps
        _ = robot.rates
        self._settle_duration()

    @property
    def is_live(self) -> bool:
        """Whether the robot runs on the wall clock."""
        return not is_ours(self.robot.type) or cast(Any, self.robot).clock == "realtime"

    def _settle_brain(self) -> None:
        """Put the teleoperator into the place of the brain, if there is no other."""
        person = TeleopConfig(self.teleop, self.map, self.processor) if self.teleop is not None else None
        if person is None and (self.map or self.processor):
            raise ConfigError("map and processor belong to a teleoperator; set --teleop.type as well.")
        if self.brain is None:
            if person is None:
                raise ConfigError("Nothing drives the robot; set --brain.type, or --teleop.type for a person.")
            self.brain, self.teleop, self.map, self.processor = person, None, {}, ""
        check_brain("brain", self.brain, self.robot)
        if (self.teleop is not None or isinstance(self.brain, TeleopConfig | TopicConfig)) and not self.is_live:
            who = "Another node" if isinstance(self.brain, TopicConfig) else "A person"
            raise ConfigError(
                f"{who} drives on the wall clock, and robot.clock is 'lockstep', on which time advances as fast as "
                "this machine can simulate. Add --robot.clock=realtime."
            )

    def _settle_duration(self) -> None:
        if self.dataset.episode_time_s is not None:
            chosen: Any = self.task
            if chosen.duration_s not in (type(chosen).duration_s, self.dataset.episode_time_s):
                raise ConfigError(
                    f"task.duration_s is {chosen.duration_s} and dataset.episode_time_s is "
                    f"{self.dataset.episode_time_s}. Both limit an episode's duration; set one of them, or both to the "
                    "same value."
                )
            chosen.duration_s = self.dataset.episode_time_s


@dataclass
class PassiveRecordConfig(Options, prefix="record."):
    """What is recorded of a robot that others command.

    Attributes:
        root: folder of the dataset, which is continued if it is there; nothing is recorded without one.
        task: what the robot is to do, the instruction of the episodes.
        episode_time_s: maximum duration of an episode [s]; the next one begins with the next command.
        idle_s: an episode ends when no command was followed for so long [s].
    """

    root: str = ""
    task: str = "Follow the commands of the brain."
    episode_time_s: Positive = 60.0
    idle_s: Positive = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.task:
            raise ConfigError("record.task is empty; it is a sentence, the instruction of the episodes.")
