"""`make demo`: record, replay, train and evaluate two robots in a few minutes, and print where the results are.

A minute of training is too short for a good policy; the demo measures how good it is.
"""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from bhd_lerobot.errors import BhdError, ConfigError, counted
from bhd_lerobot.evaluation import evaluate
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.text import perception_sentence, sentences
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording import record
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout import replay
from bhd_lerobot.training import train
from bhd_lerobot.training.arguments import parse_train

LOG = "log.txt"
_SHOWN = (
    "dataset",
    "record/trajectories*.png",
    "record/episode.png",
    "record/episode.mp4",
    "replay/episode_000000_open_loop.png",
    "train/loss.png",
    "train/checkpoints/last",
    "eval/results.json",
    "eval/videos",
)


@dataclass(frozen=True)
class Lesson:
    """Episodes that a brain drives, and a network that learns from them and is evaluated beside it.

    Attributes:
        name: of its folder, and of its dataset: `bhd/demo_NAME`.
        what: what the robot does, as text.
        world: options of robot and task, for recording and evaluating alike.
        brain: type of the brain that drives.
        episodes: how many.
        seed: every episode's seed follows from this.
        options: of `bhd-record`, besides.
        video: whether the first episode gets a video, where images can be rendered.
        network: type of the policy that is trained.
        batch: samples in a step of the training.
        policy: options of `bhd-train`; nothing is trained if there are none.
        steps: of the training; a number of steps, not a time, so that the same comes out on any day.
        early_steps: step of another checkpoint that is compared, too; none if 0.
        trials: held-out episodes of each brain in the evaluation.
        yardstick: type of a brain that is compared, too; none if nothing.
        score: what the task's score is, as text.
        recipe: configuration of a training that is not as short.
    """

    name: str
    what: str
    world: tuple[str, ...]
    brain: str
    episodes: int
    seed: int
    options: tuple[str, ...] = ()
    video: bool = True
    network: str = "bhd_mlp"
    batch: int = 256
    policy: tuple[str, ...] = ()
    steps: int = 1500
    early_steps: int = 0
    trials: int = 24
    yardstick: str = ""
    score: str = ""
    recipe: str = ""

    def record_options(self, folder: Path) -> list[str]:
        """Return the options of `bhd-record`; the dataset is in `folder`/dataset."""
        return [
            *self.world,
            f"--brain.type={self.brain}",
            f"--seed={self.seed}",
            f"--dataset.repo_id=bhd/demo_{self.name}",
            f"--dataset.root={folder / 'dataset'}",
            f"--dataset.num_episodes={self.episodes}",
            f"--n_envs={min(self.episodes, 32)}",
            f"--output_dir={folder / 'record'}",
            *(() if self.video else ("--preview_video=false",)),
            *self.options,
        ]

    def train_options(self, folder: Path) -> list[str]:
        """Return the options of `bhd-train`."""
        return [
            f"--dataset.repo_id=bhd/demo_{self.name}",
            f"--dataset.root={folder / 'dataset'}",
            "--dataset.eval_split=0.05",
            f"--output_dir={folder / 'train'}",
            f"--policy.type={self.network}",
            "--policy.device=cpu",
            *self.policy,
            f"--batch_size={self.batch}",
            f"--steps={self.steps}",
            f"--log_freq={max(self.steps // 30, 1)}",
            f"--eval_steps={max(self.steps // 5, 1)}",
            f"--save_freq={self.early_steps}",
            "--env_eval_freq=0",
            "--seed=0",
            # A second one gains little with so small a network, and loses on a busy machine.
            *(("--threads=1",) if self.network == "bhd_mlp" else ()),
        ]

    def eval_options(self, folder: Path, checkpoint: Path, videos: int | None) -> list[str]:
        """Return the options of `bhd-eval`.

        Args:
            folder: gets the folder `eval`.
            checkpoint: what was learned.
            videos: videos of each brain; None leaves the choice to `bhd-eval`, which prints why there are none.
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


PICK = Lesson(
    name="ur5_pick",
    what="a UR5 picks up what an instruction names",
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
        "--policy.ignore=['*.vel']",  # docs/reference/policies.md states what happens otherwise
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
    video=False,
    policy=(
        "--policy.chunk_size=16",
        "--policy.n_action_steps=8",
        "--policy.hidden_dims=[256,256,256]",
        "--policy.activation=gelu",
        "--policy.optimizer_lr=2e-3",
        "--selection.outcome=[success]",
    ),
    steps=1500,
    # `random` and `noop` drive joints, not tool poses.
    early_steps=300,
    score="share of the way to the target that was covered",
    recipe="configs/train/bc_ur5_reach.yaml",
)
LESSONS = (AVOID, REACH, PICK)
SEE = Lesson(
    name="ur5_see",
    what="tables with cups and boxes, each an image and the true poses of its objects",
    world=("--robot.type=ur5", "--robot.camera=true", "--robot.camera_width=160", "--robot.camera_height=120"),
    brain="noop",
    episodes=600,
    seed=3,
    options=("--task.type=pick", "--task.duration_s=0.04"),
    video=False,
    network="bhd_perception",
    # So short a training has no room for sizes and shades that it is not shown: 96 of 120 picks, and 84 with both.
    policy=(
        *("--policy.optimizer_lr=3e-3", "--policy.scheduler_warmup_steps=50"),
        *("--policy.zoom=0", "--policy.tint=0"),
    ),
    batch=16,
    steps=600,
    trials=12,
    recipe="configs/train/perception_ur5.yaml",
)


class StoppedError(BhdError):
    """A signal ended a step.

    Args:
        status: the exit status that states which.
    """

    def __init__(self, status: int) -> None:
        super().__init__("Stopped. What was finished is complete; the log says how to go on with the rest.")
        self.status = status


class Demo:
    """The steps of the demo.

    Args:
        folder: an empty folder; gets one for each robot and task.
        console: where the user reads.
        log: gets everything that the programs print.
    """

    def __init__(self, folder: Path, console: Console, log: Console) -> None:
        self.folder, self._console, self._log = folder, console, log

    def run(self) -> list[Path]:
        """Run every step; return the HTML reports.

        Raises:
            BhdError: a step failed. What was finished before is intact.
        """
        self._head("1. Record: rules drive simulated robots, and every frame goes into a LeRobotDataset")
        for lesson in LESSONS:
            self._record(lesson)
        self._head("2. Replay: a recorded episode of each robot again, and a dataset as LeRobot reads it")
        for lesson in (LESSONS[0], LESSONS[-1]):
            self._replay(lesson)
        self._read(LESSONS[-1])
        self._head("3. Train: a small network imitates each rule, from the dataset alone")
        trained = [(lesson, self._train(lesson)) for lesson in LESSONS if lesson.policy]
        self._head("4. Evaluate: the network beside the rule, in scenes that it was not trained on")
        reports = [self._evaluate(lesson, checkpoint) for lesson, checkpoint in trained]
        self._head(
            "5. See: a network learns what a camera shows, and the arm picks up what it sees and a sentence names"
        )
        if not self._can_render:
            self._print(f"left out: images cannot be rendered here; {self.folder / LOG} has the reason")
            return reports
        return [*reports, self._see(SEE)]

    def files(self) -> list[Path]:
        """Return what there is to see."""
        folders = [self.folder / lesson.name for lesson in (*LESSONS, SEE)]
        return [path for folder in folders for name in _SHOWN for path in sorted(folder.glob(name))]

    def _record(self, lesson: Lesson) -> None:
        folder = self.folder / lesson.name
        with self._step(lesson, f"records {counted(lesson.episodes, 'episode')}") as lines:
            result = record.record(parse(RecordConfig, lesson.record_options(folder)), self._log)
            counts = f"{counted(result.recorded, 'episode')}, {result.frames:,} frames"
            if lesson.brain != "noop":
                counts += f", {result.successes} successes"
            lines.append(f"{lesson.what}; {counts}")
            _check(result.exit_status)
            if lesson.video and not (folder / "record/episode.mp4").exists():
                lines.append(f"no video: images cannot be rendered here; {self.folder / LOG} has the reason")

    def _replay(self, lesson: Lesson) -> None:
        folder = self.folder / lesson.name
        options = [f"--dataset.root={folder / 'dataset'}", f"--output_dir={folder / 'replay'}"]
        with self._step(lesson, "replays an episode") as lines:
            for result in replay.replay(parse(replay.ReplayConfig, options), self._log):
                same = "same bits" if result.identical else f"up to {1000 * result.position_m.max():.3g} mm away"
                lines.append(f"replay of the {result.mode.replace('_', ' ')}: {same}")

    def _read(self, lesson: Lesson) -> None:
        from bhd_lerobot.stock import LeRobotDataset

        root = self.folder / lesson.name / "dataset"
        dataset = LeRobotDataset(f"bhd/demo_{lesson.name}", root=root, video_backend="pyav")
        frame = dataset[dataset.num_frames // 2]
        self._print(
            f"LeRobotDataset({str(root)!r}): {dataset.num_episodes} episodes, {dataset.num_frames} frames; one of them "
            f"is of the task {frame['task']!r}, at {frame['subtask']!r}, with an action of {frame['action'].numel()} "
            "numbers"
        )

    def _train(self, lesson: Lesson) -> Path:
        folder = self.folder / lesson.name
        with self._step(lesson, f"trains for {lesson.steps:,} steps") as lines:
            result = train.train(parse_train(lesson.train_options(folder)), self._log)
            losses = [row["held_out_loss"] for row in result.rows if row.get("held_out_loss") is not None]
            shown = f"; loss on held-out episodes {losses[0]:.3g} at first, {losses[-1]:.3g} at the end"
            lines.append(f"{result.step:,} steps{shown if losses else ''}; curve: {result.output_dir / 'loss.png'}")
            _check(result.exit_status)
        assert result.checkpoint is not None
        return result.checkpoint

    def _evaluate(self, lesson: Lesson, checkpoint: Path) -> Path:
        options = lesson.eval_options(self.folder / lesson.name, checkpoint, self._videos)
        with self._step(lesson, f"evaluates on {lesson.trials} episodes") as lines:
            result = evaluate.evaluate(parse(EvalConfig, options), self._log)
            _check(result.exit_status)
            lines += [f"{lesson.what}, on {lesson.trials} held-out episodes", *sentences(result.results)]
            lines.append(f"score: {lesson.score}. Training in full: {lesson.recipe}, docs/how_to/training.md")
        return result.report

    def _see(self, lesson: Lesson) -> Path:
        """Learn to see from tables, and carry out sentences with nothing else of the objects than the image."""
        self._record(lesson)
        checkpoint = self._train(lesson)
        options = [
            *lesson.world,
            "--task.type=pick",
            "--task.language=any",
            "--brains.rule.type=language",
            "--brains.seeing.type=language",
            f"--brains.seeing.perception.path={checkpoint}",
            f"--n_episodes={lesson.trials}",
            f"--n_envs={lesson.trials}",
            "--baseline=rule",
            f"--videos={self._videos}",
            f"--output_dir={self.folder / lesson.name / 'eval'}",
        ]
        with self._step(lesson, f"evaluates on {lesson.trials} episodes") as lines:
            result = evaluate.evaluate(parse(EvalConfig, options), self._log)
            _check(result.exit_status)
            saw = result.results.brains["seeing"].perception
            assert saw is not None
            lines += ["a UR5 picks up what an instruction names; seeing is told nothing of the objects"]
            lines += [*sentences(result.results), f"seeing {perception_sentence(saw)}"]
            lines.append(f"Training in full: {lesson.recipe}, docs/tutorials/cameras.md")
        return result.report

    @property
    def _can_render(self) -> bool:
        return (self.folder / PICK.name / "record/episode.mp4").exists()

    @property
    def _videos(self) -> int | None:
        # Two videos of each brain would take too long; where there can be none, the report has the reason.
        return (1 if self._can_render else None) if LESSONS[-1].video else 0

    def _head(self, text: str) -> None:
        self._console.print(f"\n[bold]{escape(text)}[/bold]", soft_wrap=True, highlight=False)
        self._log.print(f"\n{text}\n", markup=False)

    def _print(self, text: str) -> None:
        self._console.print(f"  {escape(text)}", soft_wrap=True, highlight=False)

    @contextmanager
    def _step(self, lesson: Lesson, doing: str) -> Iterator[list[str]]:
        """Show that something is continuing, then how long it took, and the lines that the step gave."""
        lines: list[str] = []
        started = time.perf_counter()
        with self._console.status(f"{lesson.name} {doing}"):
            yield lines
        self._print(f"{lesson.name}: {lines[0]} ({time.perf_counter() - started:.0f} s)")
        for line in lines[1:]:
            self._print(f"  {line}")


def _check(status: int) -> None:
    if status:
        raise StoppedError(status)


def new_folder(path: Path) -> Path:
    """Make the folder that a demo goes to.

    Raises:
        ConfigError: it holds something, or cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        held = sorted(entry.name for entry in path.iterdir())
    except OSError as error:
        raise ConfigError(f"The folder {path} cannot be used: {error.strerror}. Name another.") from error
    if held:
        raise ConfigError(f"The folder {path} is not empty: it holds {held[0]}. Name another or none.")
    return path


def run(folder: Path | None = None) -> int:
    """Run the demo in a new folder, one in outputs/demo if None; return the exit status."""
    console = Console()
    started = time.perf_counter()
    try:
        folder = new_folder(folder or Path(f"outputs/demo/{datetime.now():%Y-%m-%d_%H-%M-%S}"))
        log = logging.FileHandler(folder / LOG, mode="w", encoding="utf-8")  # what libraries log goes there, too
        logging.getLogger().addHandler(log)
        try:
            demo = Demo(folder, console, Console(file=log.stream, width=120))
            reports = demo.run()
        finally:
            logging.getLogger().removeHandler(log)
            log.close()
    except StoppedError as error:
        print(error, file=sys.stderr)
        return error.status
    console.print(f"\n[bold]Done in {time.perf_counter() - started:.0f} s[/bold]")
    for path in (*demo.files(), folder / LOG):
        console.print(f"  {escape(str(path))}", soft_wrap=True, highlight=False)
    console.print("Reports, for a browser:")
    for path in reports:
        console.print(escape(str(path)), soft_wrap=True, highlight=False)
    return 0
