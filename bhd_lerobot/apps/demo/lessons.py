"""What the demo records, trains and evaluates, and how much of it: as options of the command lines."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Recording:
    """Episodes that a brain drives.

    Attributes:
        name: of its folder, and of its dataset: `bhd/demo_NAME`.
        what: what the robot does, in words.
        world: options of robot and task, for recording and evaluating alike.
        brain: type of the brain that drives.
        episodes: how many.
        seed: every episode's seed follows from this.
        options: of `bhd-record`, besides.
        film: whether the first episode is filmed, where images can be rendered.
    """

    name: str
    what: str
    world: tuple[str, ...]
    brain: str
    episodes: int
    seed: int
    options: tuple[str, ...] = ()
    film: bool = True

    def recorded(self, folder: Path) -> list[str]:
        """Return the command line of `bhd-record`; the dataset is in `folder`/dataset."""
        film = () if self.film else ("--preview_video=false",)
        return [
            *self.world,
            f"--brain.type={self.brain}",
            f"--seed={self.seed}",
            f"--dataset.repo_id=bhd/demo_{self.name}",
            f"--dataset.root={folder / 'dataset'}",
            f"--dataset.num_episodes={self.episodes}",
            f"--n_envs={min(self.episodes, 32)}",
            f"--output_dir={folder / 'record'}",
            *film,
            *self.options,
        ]


@dataclass(frozen=True)
class Lesson(Recording):
    """Episodes that a network learns from, and how it is compared with the brain that drove them.

    Attributes:
        policy: options of `bhd-train`.
        steps: of the training; a number of steps, not a time, so that the same comes out on any day.
        early_steps: step of another checkpoint that is compared, too; none if 0.
        trials: held-out episodes of each brain in the evaluation.
        yardstick: type of a brain that is compared, too; none if nothing.
        score: what the task's score is, in words.
        recipe: configuration of a training that is not as short.
    """

    policy: tuple[str, ...] = ()
    steps: int = 1500
    early_steps: int = 0
    trials: int = 24
    yardstick: str = ""
    score: str = ""
    recipe: str = ""

    def trained(self, folder: Path) -> list[str]:
        """Return the command line of `bhd-train`."""
        return [
            f"--dataset.repo_id=bhd/demo_{self.name}",
            f"--dataset.root={folder / 'dataset'}",
            "--dataset.eval_split=0.05",
            f"--output_dir={folder / 'train'}",
            "--policy.type=bhd_mlp",
            "--policy.device=cpu",
            *self.policy,
            "--batch_size=256",
            f"--steps={self.steps}",
            f"--log_freq={max(self.steps // 30, 1)}",
            f"--eval_steps={max(self.steps // 5, 1)}",
            f"--save_freq={self.early_steps}",
            "--env_eval_freq=0",
            "--seed=0",
            "--threads=1",  # a second one gains little with so small a network, and loses on a busy machine
        ]

    def evaluated(self, folder: Path, checkpoint: Path, videos: int | None) -> list[str]:
        """Return the command line of `bhd-eval`.

        Args:
            folder: gets the folder `eval`.
            checkpoint: what was learned.
            videos: films of each brain; None leaves the choice to `bhd-eval`, which says why there are none.
        """
        options = [
            *self.world,
            f"--brains.rule.type={self.brain}",
            "--brains.learned.type=learned",
            f"--brains.learned.path={checkpoint}",
            f"--n_episodes={self.trials}",
            f"--n_envs={self.trials}",
            "--baseline=rule",
            f"--output_dir={folder / 'eval'}",
        ]
        if self.early_steps:
            early = checkpoint.parent / f"{self.early_steps:0{len(checkpoint.name)}d}"
            options += ["--brains.early.type=learned", f"--brains.early.path={early}"]
        if self.yardstick:
            options += [f"--brains.{self.yardstick}.type={self.yardstick}"]
        return options if videos is None else [*options, f"--videos={videos}"]


PICK = Recording(
    name="ur5_pick",
    what="a UR5 picks up what it is told to",
    world=("--robot.type=ur5", "--task.type=pick", "--task.language=any"),
    brain="language",
    episodes=6,
    seed=11,
)
AVOID = Lesson(
    name="turtlebot3_avoid",
    what="a TurtleBot3 roams random arenas",
    # Half of the task's usual time: more arenas in the same number of frames.
    world=("--robot.type=turtlebot3", "--task.type=avoid", "--task.duration_s=30"),
    brain="avoidance",
    episodes=128,
    seed=1,
    policy=(
        "--policy.chunk_size=1",
        "--policy.hidden_dims=[256,256]",
        "--policy.scan.transform=inverse",
        "--policy.ignore=['*.vel']",  # docs/policies.md says what happens otherwise
    ),
    steps=3000,
    yardstick="random",
    score="share of the free floor that was visited before a contact",
    recipe="configs/train/bc_turtlebot3_avoid.yaml",
)
REACH = Lesson(
    name="ur5_reach",
    what="a UR5 brings its tool to random poses, within 30 mm and 10°",
    # Coarser than the task's own 5 mm and 2°, for which the network would have to learn longer.
    world=(
        *("--robot.type=ur5", "--robot.action_space=tool", "--robot.tool_pose=true"),
        *("--task.type=reach", "--task.tolerance_m=0.03", "--task.tolerance_deg=10", "--task.duration_s=6"),
    ),
    brain="reach",
    episodes=480,
    seed=1,
    # Recorded episodes stay at the target for a second, so that there are frames to learn that from.
    options=("--task.hold_s=1.0",),
    film=False,
    policy=(
        "--policy.chunk_size=16",
        "--policy.n_action_steps=8",
        "--policy.hidden_dims=[512,512,512]",
        "--policy.activation=gelu",
        "--selection.outcome=[success]",
    ),
    steps=2500,
    # `random` and `noop` drive joints, not tool poses.
    early_steps=500,
    score="share of the way to the target that was covered",
    recipe="configs/train/bc_ur5_reach.yaml",
)
LESSONS = (AVOID, REACH)
