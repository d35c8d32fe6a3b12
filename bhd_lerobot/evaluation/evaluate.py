"""`bhd-eval`: brains beside each other on the same held-out episodes, with intervals, a report and videos."""

import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from bhd_lerobot.cluster.loop import open_pool
from bhd_lerobot.errors import BhdError, ConfigError, RenderingError, counted
from bhd_lerobot.evaluation.config import YARDSTICKS, Comparison, EvalConfig
from bhd_lerobot.evaluation.operator import Operator, drawn_orders
from bhd_lerobot.evaluation.report import ReportInput, Video, write_report
from bhd_lerobot.evaluation.results import (
    RESULTS_NAME,
    BrainSummary,
    EvalResults,
    summarise,
    write_json,
    write_table,
)
from bhd_lerobot.evaluation.run import BrainRun, jerk_of, open_dataset, prepare, run_episodes, specs_of
from bhd_lerobot.evaluation.text import number, percent, perception_sentence, sequential_sentence
from bhd_lerobot.options.parse import RUN_CONFIG, encode, read_file
from bhd_lerobot.options.terminal import Terminal
from bhd_lerobot.realtime.estop import EstopInputs, estop_signal
from bhd_lerobot.registry import make_robot, make_simulation
from bhd_lerobot.robots.host.host import describe
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.robots.viewer.viewer import prepare_view, viewed
from bhd_lerobot.rollout.preview import Preview
from bhd_lerobot.rollout.progress import ESTOP_STATUS, FAULT_STATUS, print_notes, progress_bars
from bhd_lerobot.rollout.provenance import versions
from bhd_lerobot.rollout.run_folder import run_folder
from bhd_lerobot.rollout.signals import StopRequest, stop_on_signals
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.task import outcomes_of


def print_summary(console: Console, config: Comparison, result: "EvalResult") -> None:
    """Print the results, and where they are; of a blinded evaluation that goes on later only that it does."""
    results = result.results
    if not (result.is_blinded and results.is_partial and config.record.repo_id):
        _print_results(console, config, results)
    if result.estop is not None:
        console.print(f"[bold]Emergency stop ({escape(result.estop)}).[/bold] No further episode was started.")
    if result.fault is not None:
        console.print(
            f"[bold]The robot stopped by a fault: {escape(result.fault)}.[/bold] No further episode was started."
        )
    if results.is_partial:
        by = f" by {result.stopped_by.name}" if result.stopped_by else " by the key q" if result.has_quit else ""
        again = " The same command runs the missing episodes" if config.record.repo_id else ""
        again += ", and shows the results at the end." if result.is_blinded and again else "." * bool(again)
        console.print(f"Stopped{by}: the results are partial, with all finished episodes.{again}")
    for label in result.missed:
        low, wanted = 100 * results.brains[label].success.low, 100 * (config.fail_below or 0.0)
        console.print(f"[bold]{escape(label)} missed fail_below:[/bold] {low:.1f} % is below {wanted:.1f} %.")
    console.print(f"Report: {escape(str(result.report))}", soft_wrap=True)


def _print_results(console: Console, config: Comparison, results: EvalResults) -> None:
    baseline = config.reference
    table = Table(
        title=config.heading,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("brain", overflow="fold")  # a name that is too wide for the terminal is never cut off
    has_scores = any("score" in one.means for one in results.brains.values())
    what, name = ("score", "score") if has_scores else ("return", "reward")
    for heading in ("success, 95 %", f"{what}, 95 %", *(["success minus\nbaseline's, 95 %"] if results.paired else [])):
        table.add_column(heading, no_wrap=True)
    failures = {}
    for label, one in results.brains.items():
        failures[label] = [f"{name} {count}" for name, count in one.outcomes.items() if name != "success"]
        pair = results.paired.get(label)
        table.add_row(
            escape(label) + "".join(f"\n({mark})" for mark in _marks(one, baseline, len(results.brains))),
            _lines(f"{one.successes}/{one.episodes} = {percent(one.success)}"),
            _lines(number(one.means[name], 3)),
            *([_lines(percent(pair.success, sign=True)) if pair else ""] if results.paired else []),
        )
    console.print(table)
    for label, causes in failures.items():
        if causes:
            console.print(f"{escape(label)} failed: {', '.join(causes)}", highlight=False)
    for label, one in results.brains.items():
        if one.perception is not None:
            console.print(escape(f"{label}: {perception_sentence(one.perception)}"), soft_wrap=True)
    if config.sequential:
        console.print(escape(sequential_sentence(results)), soft_wrap=True, highlight=False)


def _marks(one: BrainSummary, baseline: str, count: int) -> list[str]:
    """Return what is said of a brain beside its name."""
    marks = ["baseline"] if one.brain == baseline and count > 1 else []
    return [*marks, "privileged"] if one.privileged else marks


def _lines(text: str) -> str:
    """Return a number with its interval below it: both are read at a glance, and fit."""
    return text.replace(" (", "\n").rstrip(")")


FAILED_STATUS = 1  # exit status of an evaluation in which a brain missed `fail_below`


@dataclass
class EvalResult:
    """The results of an evaluation, and where they are.

    Attributes:
        output_dir: the folder.
        results: everything that does not depend on the wall clock.
        timing: what was measured on the wall clock, by brain.
        report: the HTML report.
        missed: brains whose interval of success begins below `fail_below`.
        stopped_by: the signal that ended the run early, or None.
        fault: why a real robot's fault ended the run, as text; None if none did.
        estop: what pressed the emergency stop that ended the run, as text; None if there was none.
        has_quit: whether a person ended the run.
        is_blinded: whether a person judges, who is not to know which brain ran.
    """

    output_dir: Path
    results: EvalResults
    timing: dict[str, Any]
    report: Path
    missed: list[str] = field(default_factory=list)
    stopped_by: StopRequest | None = None
    estop: str | None = None
    fault: str | None = None
    has_quit: bool = False
    is_blinded: bool = False

    @property
    def exit_status(self) -> int:
        """The program's exit status: 0 if all episodes were run and no brain missed `fail_below`."""
        if self.estop is not None:
            return ESTOP_STATUS
        if self.fault is not None:
            return FAULT_STATUS
        if self.stopped_by:
            return self.stopped_by.exit_status
        return FAILED_STATUS if self.missed else 0


def evaluate(config: EvalConfig, console: Console | None = None) -> EvalResult:
    """Run every brain on the same episodes, write results and report."""
    printed = console or Terminal()
    console = console or Console(stderr=True)
    refuse_results(config)
    prepare_view(config.view)
    n = 1 if config.is_live else min(config.n_envs, len(config.indices))
    robots = make_robot(config.robot, n, config.threads, fps=config.fps, gate=config.gate)
    person = Operator(
        console, len(config.chosen) * len(config.indices), outcomes_of(config.task.get_choice_name(type(config.task)))
    )
    pressed = EstopInputs(robots.estop, *([person.on_key] if config.by_person else []))
    with closing(robots), stop_on_signals() as stop, pressed, ExitStack() as opened:
        opened.enter_context(viewed(robots, config.view))
        pool = None if config.engine == "local" else opened.enter_context(open_pool(config.ray, console))
        runs = []
        for label in config.chosen:
            runs.append(prepare(config, label, robots, pool))
            opened.callback(runs[-1].close)
        print_notes(console, robots, runs[0].loop.task)
        if (
            pool is None
            and robots.camera_shapes
            and (config.record.repo_id or any(brain_run.loop.brain.uses_images for brain_run in runs))
        ):
            robots.start_rendering()  # a machine without OpenGL fails here, before the first episode
        if robots.clock is not None:
            _add_keys(config, pressed, person, console)
        preview, no_videos = _make_preview(config, robots, console)
        with run_folder(config, "eval") as output_dir:
            orders = drawn_orders(output_dir, list(config.chosen), config.indices) if config.by_person else {}
            facts = _facts(config, robots, runs, orders)
            for one in runs:
                opened.enter_context(open_dataset(config, one))

        def summary() -> EvalResults:
            return _summary(config, facts, runs)

        for _ in _run(config, runs, orders, person, lambda: bool(stop) or person.has_quit, console=console):
            if config.sequential and summary().is_decided:
                break
        for one in (one for one in runs if one.recorded):
            console.print(
                f"{escape(one.label)}: {counted(len(one.recorded), 'episode')} of {len(config.indices)} had been "
                "recorded before, and were not run again."
            )
        estop = None
        if any(brain_run.loop.emergency_stop for brain_run in runs) or (config.by_person and robots.estop_pressed):
            estop = pressed.cause(robots.estop_pressed)
        faulty = [brain_run.loop for brain_run in runs if brain_run.loop.fault]
        fault = faulty[0].problem or robots.problem if faulty else None
    results = summary()
    timing = {
        "made": datetime.now().astimezone().isoformat(timespec="seconds"),
        "n_envs": n,
        "clock": "realtime" if config.is_live else "lockstep",
        "brains": {brain_run.label: brain_run.timing() for brain_run in runs if brain_run.loop.act_times},
    }
    result = EvalResult(output_dir, results, timing, output_dir / "report.html", stopped_by=stop, estop=estop)
    result.fault, result.has_quit, result.is_blinded = fault, person.has_quit, config.by_person
    finish(printed, config, result, lambda: _report_input(config, result, runs, preview, no_videos))
    return result


def finish(console: Console, config: Comparison, result: EvalResult, make: Callable[[], ReportInput]) -> None:
    """Write results and report, of what a function returns, and print the summary."""
    result.missed = _missed(config, result.results)
    try:
        write_json(result.output_dir / RESULTS_NAME, result.results.plain())
        write_json(result.output_dir / "timing.json", result.timing)
        write_table(result.output_dir / "episodes.parquet", result.results.episodes)
        write_report(make(), result.report)
    except OSError as error:
        print_summary(console, config, result)  # so that the numbers, at least, are not lost
        raise BhdError(
            f"The results cannot be written to {result.output_dir}: {error.strerror or error}. What is printed above "
            "is complete. Make room, or set another --output_dir, and run it again: the numbers will be the same."
        ) from error
    print_summary(console, config, result)


def _add_keys(config: EvalConfig, pressed: EstopInputs, person: Operator, console: Console) -> None:
    """Let a signal and, in a terminal, a key press the emergency stop; and let a person judge there."""
    number = estop_signal("SIGUSR1")
    pressed.add_signal(number)
    has_key = pressed.add_key()
    key = "space or e, or " if has_key else ""
    console.print(f"Emergency stop: {key}kill -{number.name.removeprefix('SIG')} this process")
    if not config.by_person:
        return
    person.is_there = has_key
    if not has_key:
        console.print("Standard input is not a terminal: no key can mark an episode, and no scene is waited for.")
    if config.record.repo_id is None:
        console.print(
            "The episodes are not recorded: after an interruption all are run again. To keep them, add "
            "--record.repo_id=me/eval."
        )


def _run(
    config: EvalConfig,
    runs: Sequence[BrainRun],
    orders: Mapping[str, Sequence[str]],
    person: Operator,
    stop: Callable[[], bool],
    *,
    console: Console,
) -> Iterator[None]:
    """Run the episodes, and yield where a sequential test may end the run: all brains have run the same ones."""
    robots, number = runs[0].loop.robots, 0

    def ended() -> bool:
        is_pressed = config.by_person and robots.estop_pressed  # perhaps while nothing runs
        return stop() or is_pressed or any(one.loop.emergency_stop or one.loop.fault for one in runs)

    with progress_bars(console, "success") as progress:
        shown = [("episodes", runs)] if config.by_person else [(escape(one.label), [one]) for one in runs]
        bars: dict[str, Callable[[], None]] = {}
        for name, shared in shown:
            bar = progress.add_task(name, total=len(shared) * len(config.indices), success="")
            bars |= {one.label: _shower(progress, bar, shared) for one in shared}
        for together in _rounds(config, runs, orders, robots.n):
            for one, specs in together:
                if config.by_person:
                    number, task = number + 1, one.loop.task
                    one.loop.marks = person
                    if specs[0].index not in one.recorded and not ended():
                        person.set_up(number, specs[0], task.instruction(task.sample(specs[0].seed)), ended)
                if ended():
                    return
                run_episodes(config, one, specs, stop, bars[one.label])
            yield


def _rounds(
    config: EvalConfig, runs: Sequence[BrainRun], orders: Mapping[str, Sequence[str]], n: int
) -> Iterator[list[tuple[BrainRun, Sequence[EpisodeSpec]]]]:
    """Yield the brains with episodes that they all run before any runs others, in the order in which they do.

    With a person, that is one episode, in the order drawn for it; with a sequential test n of them; otherwise all.
    """
    specs, by_label = specs_of(config), {one.label: one for one in runs}
    if config.by_person:
        for spec in specs:
            yield [(by_label[label], [spec]) for label in orders[str(spec.index)]]
        return
    size = n if config.sequential else len(specs)
    for first in range(0, len(specs), size):
        yield [(one, specs[first : first + size]) for one in runs]


def _shower(progress: Progress, bar: Any, runs: Sequence[BrainRun]) -> Callable[[], None]:
    def show() -> None:
        episodes = [metrics for one in runs for metrics in one.episodes]
        good = sum(metrics.success for metrics in episodes)
        progress.update(bar, completed=len(episodes), success=f"{good}/{len(episodes)} succeeded")

    return show


def _summary(config: EvalConfig, facts: dict[str, Any], runs: Sequence[BrainRun]) -> EvalResults:
    return summarise(
        facts,
        measured_with(),
        {brain_run.label: brain_run.episodes for brain_run in runs},
        len(config.indices),
        config.reference,
        privileged={brain_run.label for brain_run in runs if brain_run.is_privileged},
        sequential=config.sequential,
    )


def _facts(
    config: EvalConfig, robots: Robots, runs: Sequence[BrainRun], orders: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return what decides the numbers, as plain values; how many run side by side does not."""
    return {
        "robot": describe(robots.config),
        "task": runs[0].loop.task.parameters(),
        "brains": {brain_run.label: brain_run.loop.brain.parameters() for brain_run in runs},
        "baseline": config.reference,
        "seed": config.seed,
        "split": config.split,
        "episodes": config.indices,
        "fps": robots.rates.fps,
        "jerk": jerk_of(robots).what,
        "jerk_unit": jerk_of(robots).unit,
        **({"sequential": True} if config.sequential else {}),
        **({"order": dict(orders)} if orders else {}),
        **({"gate": asdict(config.gate)} if robots.body is None else {}),
    }


def measured_with() -> dict[str, str]:
    """Return the versions that results depend on."""
    return {**versions(), "torch": metadata.version("torch"), "python": platform.python_version()}


def _missed(config: Comparison, results: EvalResults) -> list[str]:
    if config.fail_below is None:
        return []
    wanted = {label for label, brain in config.chosen.items() if brain.get_choice_name(type(brain)) not in YARDSTICKS}
    return [label for label, one in results.brains.items() if label in wanted and one.success.low < config.fail_below]


def _report_input(
    config: EvalConfig, result: EvalResult, runs: Sequence[BrainRun], preview: Preview | None, no_videos: str
) -> ReportInput:
    """Write initial states and videos; return what the report is made of."""
    folder = result.output_dir
    states: dict[str, Any] = {f"state_{brain_run.label}": np.array(brain_run.initial_states) for brain_run in runs}
    states |= {
        f"episode_{brain_run.label}": np.array([m.episode for m in brain_run.episodes], np.int64) for brain_run in runs
    }
    np.savez_compressed(folder / "initial_states.npz", **states)
    videos = _video(config, runs, preview, folder) if preview is not None else []
    return ReportInput(
        config=config,
        results=result.results,
        timing=result.timing,
        trajectories={brain_run.label: brain_run.trajectories for brain_run in runs},
        videos=videos,
        no_videos=no_videos,
        folder=folder,
    )


def _video(config: EvalConfig, runs: Sequence[BrainRun], preview: Preview, folder: Path) -> list[Video]:
    videos = []
    robot: Any = config.robot
    with closing(preview):
        for brain_run in runs:
            for metrics, scene, states in brain_run.videos:
                path = folder / "videos" / f"{brain_run.label}_{metrics.episode:04d}.mp4"
                path.parent.mkdir(exist_ok=True)
                preview.write(scene, states, robot.fps, path)
                videos.append(Video(brain_run.label, metrics, path))
    return videos


def _make_preview(config: EvalConfig, robots: Robots, console: Console) -> tuple[Preview | None, str]:
    """Return what makes videos, or None and why not."""
    if config.videos == 0:
        return None, "videos was 0."
    if robots.world is None:
        return None, "there is no simulator to render."
    try:
        return Preview(make_simulation(config.robot)), ""
    except RenderingError as error:
        if config.videos:
            raise
        console.print(f"No videos: {escape(str(error))}")
        return None, str(error)


def refuse_results(config: Any) -> None:
    """Refuse a folder that holds the results of another evaluation, or of this one if it is complete."""
    folder = Path(config.output_dir or "").expanduser()
    if config.output_dir and (folder / RESULTS_NAME).is_file() and not _is_continued(config, folder):
        raise ConfigError(
            f"The folder {config.output_dir} holds the results of an evaluation ({RESULTS_NAME}). Set another "
            "--output_dir, or remove it."
        )


def _is_continued(config: Comparison, folder: Path) -> bool:
    """Return whether a folder holds partial results of the same evaluation, whose episodes were recorded."""
    if config.record.repo_id is None:
        return False
    partial = read_file(folder / RESULTS_NAME).get("partial") is True
    return partial and (folder / RUN_CONFIG).is_file() and read_file(folder / RUN_CONFIG) == encode(config)
