"""`make demo`: record, replay, train and evaluate two robots in a few minutes, and print where the results are.

A minute of training is too short for a good policy; the demo measures how good it is.
"""

import logging
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import yaml
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
class Command:
    """A command line of the demo.

    Attributes:
        name: of the folder that it works in; its dataset is `bhd/demo_NAME`.
        line: program and options, with words in braces.
        what: what it does, in words.
        notes: lines that are printed after its result.
    """

    name: str
    line: str
    what: str = ""
    notes: Sequence[str] = ()


def read_steps() -> tuple[dict[str, list[Command]], dict[str, str]]:
    """Return the commands by the heading of their step, and the words in braces."""
    file = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    return {heading: [Command(**one) for one in step] for heading, step in file["steps"].items()}, file["words"]


def options_of(command: Command, words: Mapping[str, str], at: Path, videos: str = "") -> list[str]:
    """Return the options of a command that works in a folder."""
    line, words = command.line, {**words, "name": command.name, "at": str(at), "videos": videos}
    while "{" in line:
        line = line.format_map(words)
    return line.split()[1:]


class StoppedError(BhdError):
    """A signal ended a step; `status` says which."""

    def __init__(self, status: int) -> None:
        super().__init__("Stopped. What was finished is complete; the log describes how to continue.")
        self.status = status


def _record(command: Command, options: list[str], log: Console) -> Iterator[str]:
    result = record.record(parse(RecordConfig, options), log)
    _check(result.exit_status)
    successes = "" if "--brain.type=noop" in options else f", {result.successes} successes"
    yield f"{command.what}; {counted(result.recorded, 'episode')}, {result.frames:,} frames{successes}"
    if "--preview_video=false" not in options and not (result.output_dir / "episode.mp4").exists():
        yield f"no video: images cannot be rendered here; {LOG} has the reason"


def _replay(_: Command, options: list[str], log: Console) -> Iterator[str]:
    for result in replay.replay(parse(replay.ReplayConfig, options), log):
        same = "same bits" if result.identical else f"up to {1000 * result.position_m.max():.3g} mm away"
        yield f"replay of the {result.mode.replace('_', ' ')}: {same}"


def _read(command: Command, options: list[str], _: Console) -> Iterator[str]:
    from bhd_lerobot.stock import LeRobotDataset

    (root,) = options
    dataset = LeRobotDataset(f"bhd/demo_{command.name}", root=root, video_backend="pyav")
    frame = dataset[dataset.num_frames // 2]
    yield (
        f"LeRobotDataset({root!r}): {dataset.num_episodes} episodes, {dataset.num_frames} frames; one of them is of "
        f"the task {frame['task']!r}, at {frame['subtask']!r}, with an action of {frame['action'].numel()} numbers"
    )


def _train(_: Command, options: list[str], log: Console) -> Iterator[str]:
    result = train.train(parse_train(options), log)
    _check(result.exit_status)
    losses = [row["held_out_loss"] for row in result.rows if row.get("held_out_loss") is not None]
    shown = f"; loss on held-out episodes {losses[0]:.3g} at first, {losses[-1]:.3g} at the end" if losses else ""
    yield f"{result.step:,} steps{shown}; curve: {result.output_dir / 'loss.png'}"


def _evaluate(command: Command, options: list[str], log: Console) -> Iterator[str]:
    result = evaluate.evaluate(parse(EvalConfig, options), log)
    _check(result.exit_status)
    yield from (command.what, *sentences(result.results))
    for name, brain in result.results.brains.items():
        if brain.perception is not None:
            yield f"{name} {perception_sentence(brain.perception)}"


_PROGRAMS: dict[str, Callable[[Command, list[str], Console], Iterator[str]]] = {
    "bhd-record": _record,
    "bhd-replay": _replay,
    "LeRobotDataset": _read,
    "bhd-train": _train,
    "bhd-eval": _evaluate,
}


def _check(status: int) -> None:
    if status:
        raise StoppedError(status)


def can_render(folder: Path) -> bool:
    """Whether images can be rendered here: a recording has a video."""
    return any(folder.glob("*/record/episode.mp4"))


def run_commands(folder: Path, console: Console, log: Console) -> None:
    """Run every command.

    Args:
        folder: an empty folder; gets one for each robot and task.
        console: where the user reads.
        log: gets everything that the programs print.

    Raises:
        BhdError: a command failed. What was finished before is intact.
    """
    steps, words = read_steps()
    for heading, commands in steps.items():
        console.print(f"\n[bold]{escape(heading)}[/bold]", soft_wrap=True, highlight=False)
        log.print(f"\n{heading}\n", markup=False)
        if heading.startswith("5. See") and not can_render(folder):
            _print(console, f"left out: images cannot be rendered here; {folder / LOG} has the reason")
            continue
        # Two videos of each brain would take too long; where there can be none, the report has the reason.
        videos = "--videos=1" if can_render(folder) else ""
        for command in commands:
            program, started = command.line.split()[0], time.perf_counter()
            options = options_of(command, words, folder / command.name, videos)
            with console.status(f"{command.name}: {program}"):
                first, *lines = _PROGRAMS[program](command, options, log)
            _print(console, f"{command.name}: {first} ({time.perf_counter() - started:.0f} s)")
            for line in (*lines, *command.notes):
                _print(console, f"  {line}")


def _print(console: Console, text: str) -> None:
    console.print(f"  {escape(text)}", soft_wrap=True, highlight=False)


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
            run_commands(folder, console, Console(file=log.stream, width=120))
        finally:
            logging.getLogger().removeHandler(log)
            log.close()
    except StoppedError as error:
        print(error, file=sys.stderr)
        return error.status
    console.print(f"\n[bold]Done in {time.perf_counter() - started:.0f} s[/bold]")
    places = [folder / name for name in dict.fromkeys(one.name for step in read_steps()[0].values() for one in step)]
    for path in (*(path for one in places for name in _SHOWN for path in sorted(one.glob(name))), folder / LOG):
        console.print(f"  {escape(str(path))}", soft_wrap=True, highlight=False)
    console.print("Reports, for a browser:")
    for path in (report for one in places if (report := one / "eval/report.html").exists()):
        console.print(escape(str(path)), soft_wrap=True, highlight=False)
    return 0
