"""`make demo`: record, replay, train and evaluate two robots in a few minutes, and say where everything is.

How well the networks do is measured, not known beforehand: a minute is too short for a good policy, and the demo says
how far it got.
"""

import argparse
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.apps.demo.lessons import LESSONS, PICK, Lesson, Recording
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.evaluation import evaluate
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.results import EvalResults
from bhd_lerobot.evaluation.text import number, percent, verdict
from bhd_lerobot.recording import record
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout import replay
from bhd_lerobot.rollout.configuration import parse
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


class StoppedError(BhdError):
    """A signal ended a step.

    Args:
        status: the exit status that says which.
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
        for one in (*LESSONS, PICK):
            self._record(one)
        self._head("2. Look: a recorded episode of each robot again, and a dataset as LeRobot reads it")
        for one in (LESSONS[0], PICK):
            self._replay(one)
        self._read(PICK)
        self._head("3. Train: a small network imitates each rule, from the dataset alone")
        checkpoints = [self._train(one) for one in LESSONS]
        self._head("4. Evaluate: the network beside the rule, in scenes that it was not trained on")
        return [self._evaluate(one, checkpoint) for one, checkpoint in zip(LESSONS, checkpoints, strict=True)]

    def files(self) -> list[Path]:
        """Return what there is to look at."""
        folders = [self.folder / one.name for one in (*LESSONS, PICK)]
        return [path for folder in folders for name in _SHOWN for path in sorted(folder.glob(name))]

    def _record(self, one: Recording) -> None:
        folder = self.folder / one.name
        with self._step(one, f"records {one.episodes} episodes") as end:
            result = record.record(parse(RecordConfig, one.recorded(folder)), self._log)
            end["said"] = (
                f"{one.what}; {result.recorded} episodes, {result.frames:,} frames, {result.successes} successes"
            )
        _check(result.exit_status)
        if one.film and not (folder / "record/episode.mp4").exists():
            self._say(f"no film: images cannot be rendered here; {self.folder / LOG} says why")

    def _replay(self, one: Recording) -> None:
        folder = self.folder / one.name
        options = [f"--dataset.root={folder / 'dataset'}", f"--output_dir={folder / 'replay'}"]
        with self._step(one, "replays an episode") as end:
            results = replay.replay(parse(replay.ReplayConfig, options), self._log)
            names = {"open_loop": "the recorded commands again", "state": "the recorded states again"}
            end["said"] = "; ".join(
                f"{names[each.mode]}: "
                + ("same bits" if each.identical else f"up to {1000 * each.position_m.max():.3g} mm away")
                for each in results
            )

    def _read(self, one: Recording) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        root = self.folder / one.name / "dataset"
        dataset = LeRobotDataset(f"bhd/demo_{one.name}", root=root, video_backend="pyav")
        frame = dataset[dataset.num_frames // 2]
        self._say(
            f"LeRobotDataset({str(root)!r}): {dataset.num_episodes} episodes, {dataset.num_frames} frames; one of them:"
        )
        for key in ("task", "subtask"):
            self._say(f"  {key}: {frame[key]}")
        for key in ("observation.state", "observation.environment_state", "action"):
            self._say(f"  {key}: {frame[key].numel()} numbers")

    def _train(self, one: Lesson) -> Path:
        with self._step(one, f"trains for {one.steps:,} steps") as end:
            result = train.train(parse_train(one.trained(self.folder / one.name)), self._log)
            losses = [row["held_out_loss"] for row in result.rows if row.get("held_out_loss") is not None]
            told = f"; loss on held-out episodes {losses[0]:.3g} at first, {losses[-1]:.3g} at the end"
            end["said"] = f"{result.step:,} steps{told if losses else ''}"
        _check(result.exit_status)
        self._say(f"  curve: {result.output_dir / 'loss.png'}")
        assert result.checkpoint is not None
        return result.checkpoint

    def _evaluate(self, one: Lesson, checkpoint: Path) -> Path:
        # Two films of each brain would take too long; where there can be none, the report is to say why.
        can_film = (self.folder / PICK.name / "record/episode.mp4").exists()
        videos = (1 if can_film else None) if PICK.film else 0
        options = one.evaluated(self.folder / one.name, checkpoint, videos)
        with self._step(one, f"evaluates on {one.trials} episodes") as end:
            result = evaluate.evaluate(parse(EvalConfig, options), self._log)
            end["said"] = f"{one.what}; {one.trials} held-out episodes of each brain"
        _check(result.exit_status)
        self._console.print(_table(result.results, one))
        self._say(f"learned, beside the rule: {verdict(result.results.paired['learned'])}.")
        self._say(f"score: {one.score}. Training in full: {one.recipe}, docs/training.md")
        return result.report

    def _head(self, text: str) -> None:
        self._console.print(f"\n[bold]{escape(text)}[/bold]", soft_wrap=True, highlight=False)
        self._log.print(f"\n{text}\n", markup=False)

    def _say(self, text: str) -> None:
        self._console.print(f"  {escape(text)}", soft_wrap=True, highlight=False)

    @contextmanager
    def _step(self, one: Recording, doing: str) -> Iterator[dict[str, str]]:
        """Show that something is going on, then what `said` says about it, and how long it took."""
        end: dict[str, str] = {}
        started = time.perf_counter()
        with self._console.status(f"{one.name} {doing}"):
            yield end
        self._say(f"{one.name}: {end['said']} ({time.perf_counter() - started:.0f} s)")


def _table(results: EvalResults, one: Lesson) -> Table:
    whats = {"rule": one.brain, "learned": f"{one.steps:,} steps", "early": f"{one.early_steps:,} steps"}
    table = Table(box=SIMPLE_HEAD)
    for heading in ("brain", "", "success", "95 % interval", "score"):
        table.add_column(heading, no_wrap=True)
    for label, each in results.brains.items():
        rate, _, interval = percent(each.success).partition(" (")
        score = number(each.means["score"], 2).partition(" (")[0]
        count = f"{each.successes} of {each.episodes}, {rate}"
        table.add_row(label, whats.get(label, ""), count, interval.rstrip(")"), score)
    return table


def _check(status: int) -> None:
    if status:
        raise StoppedError(status)


def new_folder(path: Path) -> Path:
    """Make the folder that a demo goes to.

    Raises:
        ConfigError: there is something in it, or it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        there = sorted(one.name for one in path.iterdir())
    except OSError as error:
        raise ConfigError(f"The folder {path} cannot be used: {error.strerror}. Name another.") from error
    if there:
        raise ConfigError(
            f"The folder {path} is not empty: it holds {', '.join(there[:3])}{', …' if there[3:] else ''}. Name "
            "another; without a name the demo makes a new one."
        )
    return path


@contextmanager
def _log(path: Path) -> Iterator[TextIO]:
    """Open the log; what libraries log goes there, too."""
    with path.open("w", encoding="utf-8") as file:
        handler = logging.StreamHandler(file)
        logging.getLogger().addHandler(handler)
        try:
            yield file
        finally:
            logging.getLogger().removeHandler(handler)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bhd_lerobot.apps.demo.demo", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, help="new folder; one in outputs/demo if nothing")
    asked: Any = parser.parse_args(sys.argv[1:] if arguments is None else list(arguments))
    console = Console()
    started = time.perf_counter()
    try:
        folder = new_folder(asked.folder or Path(f"outputs/demo/{datetime.now():%Y-%m-%d_%H-%M-%S}"))
        with _log(folder / LOG) as file:
            demo = Demo(folder, console, Console(file=file, width=120))
            reports = demo.run()
    except StoppedError as error:
        print(error, file=sys.stderr)
        return error.status
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Interrupted. What was finished is complete.", file=sys.stderr)
        return 130
    console.print(f"\n[bold]Done in {time.perf_counter() - started:.0f} s[/bold]")
    for path in (*demo.files(), folder / LOG):
        console.print(f"  {escape(str(path))}", soft_wrap=True, highlight=False)
    console.print("Reports, for a browser:")
    for path in reports:
        console.print(escape(str(path)), soft_wrap=True, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
