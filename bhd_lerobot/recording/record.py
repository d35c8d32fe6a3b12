"""`bhd-record`: episodes of a robot, driven by a brain or a person, into a LeRobotDataset."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, nullcontext
from pathlib import Path
from typing import Any, cast

from rich.console import Console
from rich.markup import escape

from bhd_lerobot.cluster.loop import ClusterLoop, open_pool
from bhd_lerobot.cluster.pool import WorkerPool
from bhd_lerobot.datasets.format.features import (
    LANGUAGE,
    PHYSICS_STATE,
    SUBTASK,
)
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.storage.atomic import is_free
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetMismatchError, RealtimeError, RenderingError, counted
from bhd_lerobot.hub.push import check_pushable, format_push_report, left_by_interrupt, push_command, push_dataset
from bhd_lerobot.hub.transfer import prompt_interrupt
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.realtime.estop import EstopInputs, estop_signal
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.driver import mark_keys, open_driver
from bhd_lerobot.recording.live_view import live_view
from bhd_lerobot.recording.report import RecordResult, print_summary
from bhd_lerobot.recording.reset import ResetPhase
from bhd_lerobot.recording.status import RecordStatus
from bhd_lerobot.recording.takes import Takes
from bhd_lerobot.registry import is_ours, make_robot, make_simulation, make_task
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.robots.viewer.viewer import prepare_view, viewed
from bhd_lerobot.rollout.episode import EpisodeLoop, track_of
from bhd_lerobot.rollout.marks import Marks, key_help
from bhd_lerobot.rollout.plots import Trajectory, TrajectoryAlbum
from bhd_lerobot.rollout.preview import Preview
from bhd_lerobot.rollout.progress import part_done, print_notes, progress_bars
from bhd_lerobot.rollout.provenance import episode_metadata
from bhd_lerobot.rollout.recorder import (
    Recording,
    closing_used,
    language_column,
    open_recorder,
    save_episode,
)
from bhd_lerobot.rollout.run_folder import run_folder
from bhd_lerobot.rollout.signals import stop_on_signals
from bhd_lerobot.rollout.tolerance import verdict
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.operator import OperatorTask, judged
from bhd_lerobot.tasks.task import Task, episode_seed, outcomes_of

_SHOWN_EVERY_S = 0.1
_SHORTEST_S = 0.5  # a take that a person's key ends is at least so long
_ATTEMPTS = 3  # that an episode gets to be punctual


def record(config: RecordConfig, console: Console | None = None) -> RecordResult:
    """Record the episodes that a configuration describes; those that were saved before an error are intact."""
    if config.dataset.push_to_hub:
        check_pushable(config.dataset.repo_id)  # before hours of recording, not after
    prepare_view(config.view)
    console = console or Console(stderr=True)
    root = Path(config.dataset.root).expanduser() if config.dataset.root else default_root(config.dataset.repo_id)
    is_here = config.engine == "local"  # otherwise one simulation, which only states what is recorded
    n = 1 if config.is_live or not is_here else min(config.n_envs, config.dataset.num_episodes)
    marks, is_new = _make_marks(config, n), is_free(root)
    # Innermost first: what is recorded is finalised, then the signals' handlers come back, then the renderer is freed.
    # An emergency stop counts from the first moment on, while there is no robot yet.
    with ExitStack() as outer:
        status = _make_status(config, marks, console) if config.is_live and is_here else None
        if status is not None:
            outer.enter_context(status.shown())
        pressed = outer.enter_context(EstopInputs(on_key=marks.on_key))
        is_main = threading.current_thread() is threading.main_thread()
        if is_main:
            _add_estop_inputs(config, pressed, console)
        robots = _make_robots(config, n, pressed)
        outer.enter_context(closing(robots))
        outer.enter_context(viewed(robots, config.view))
        pressed.attach(robots.estop)
        if not is_main:  # no signal can be handled: an error, of which a robot that cannot be made comes first
            _add_estop_inputs(config, pressed, console)
        stop, cluster = outer.enter_context(stop_on_signals()), outer.enter_context(ExitStack())
        task = _judged_task(config, robots, console)
        brain = cluster.enter_context(open_driver(config, marks))
        pool = None if is_here else cluster.enter_context(open_pool(config.ray, console))
        loop = _make_loop(config, robots, task, brain, pool=pool, pressed=pressed)
        loop.marks, loop.status = marks, status
        print_notes(console, robots, task)
        preview = _make_preview(config, robots, console)
        if robots.camera_shapes and is_here:
            robots.start_rendering()  # a machine without OpenGL fails here, before a dataset exists
        with ExitStack() as opened:
            with run_folder(config, "record") as output_dir:
                # A view that cannot be started fails before a dataset exists.
                loop.observer = opened.enter_context(live_view(config, robots, console))
                made = open_recorder(_recording(config, root), robots, task, brain)
                recorder = _continuable(opened.enter_context(closing_used(made, is_new=is_new)))
            result = RecordResult(root, output_dir, attempts=brain.attempts, stopped_by=stop)
            if recorder.repair_report:
                console.print(f"Repaired before resuming: {recorder.repair_report}")
            album, first = _run(config, recorder, loop, result, console)
        if loop.fault:
            result.fault = loop.problem or robots.problem
        if loop.emergency_stop:
            result.estop = pressed.cause(robots.estop_pressed)
    _draw(config, result, album, first=first, preview=preview, title=f"{task.name}, {brain.name}")
    print_summary(console, config, result, preview is not None and first is not None)
    if config.dataset.push_to_hub:
        _push(config, result, console)
    return result


def _draw(
    config: RecordConfig,
    result: RecordResult,
    album: TrajectoryAlbum,
    *,
    first: Episode | None,
    preview: Preview | None,
    title: str,
) -> None:
    """Draw the trajectories, and the first episode as a video."""
    output_dir = result.output_dir
    if album.added:
        heading = f"{title}: {result.succeeded or counted(result.recorded, 'episode')}"
        album.draw(output_dir / "trajectories.png", heading)
    if first is not None and preview is not None:
        states = first.columns[PHYSICS_STATE]
        preview.write(first.scene, states, config.dataset.fps, output_dir / "episode.mp4")
        preview.write_strip(first.scene, states, config.dataset.fps, output_dir / "episode.png")
        preview.close()


def _make_robots(config: RecordConfig, n: int, pressed: EstopInputs) -> Robots:
    """Return the robots; what LeRobot drives may ask a person how it is to be calibrated, and gets the keys for it."""
    with nullcontext() if is_ours(config.robot.type) else pressed.lend_keys():
        return make_robot(config.robot, n, config.threads, fps=config.dataset.fps, gate=config.gate)


def _make_loop(
    config: RecordConfig, robots: Robots, task: Task, brain: Any, *, pool: WorkerPool | None, pressed: EstopInputs
) -> EpisodeLoop:
    """Return what runs the episodes; a brain that does not fit the robot fails here, before a dataset exists."""
    if pool is None:
        with pressed.lend_keys():  # a leader arm may ask a person, too
            return EpisodeLoop(robots, task, brain, config.timing)
    return ClusterLoop(robots, task, brain, config.timing, pool=pool, config=config, brain_config=config.brain)


def _run(
    config: RecordConfig, recorder: DatasetRecorder, loop: EpisodeLoop, result: RecordResult, console: Console
) -> tuple[TrajectoryAlbum, Episode | None]:
    """Run and save the episodes that the dataset lacks; return their trajectories, and the first of them."""
    task, brain = loop.task, loop.brain
    album = TrajectoryAlbum()
    first: Episode | None = None
    specs = [
        EpisodeSpec(index, episode_seed(config.seed, index, config.split))  # type: ignore[arg-type]
        for index in range(recorder.num_episodes, config.dataset.num_episodes)
    ]
    if not specs:
        console.print(
            f"The dataset has {recorder.num_episodes} episodes already, and {config.dataset.num_episodes} are to be in "
            "it: nothing is recorded. For more, raise --dataset.num_episodes.",
            soft_wrap=True,
        )
    started = time.perf_counter()

    def save(episode: Episode) -> None:
        metadata = episode_metadata(episode, split=config.split, task=task.parameters(), brain=brain.parameters())
        if config.dataset.language and brain.has_plan:
            rows = language_column(episode.plan, episode.columns[SUBTASK], config.dataset.fps)
            episode.columns[LANGUAGE] = rows
        save_episode(recorder, episode, metadata)

    def count(episode: Episode) -> None:
        nonlocal first
        result.count(episode, config.dataset.fps)
        if episode.writer is not None:
            result.dropped.update({key: len(rows) for key, rows in episode.writer.dropped.items()})
        result.wall_s = time.perf_counter() - started
        if (trajectory := _trajectory(episode, loop.robots, result.attempts)) is not None:
            album.add(trajectory)
        first = first or episode

    status = loop.status
    with Takes(save, recorder.drop_last, count) as takes, ExitStack() as shown:
        progress = None
        if isinstance(status, RecordStatus):
            if loop.robots.world is None:
                loop.before_start = ResetPhase(
                    loop.robots, brain, loop.marks, config.dataset.reset_time_s,
                    stop=lambda: bool(result.stopped_by), console=console, status=status, takes=takes,
                )  # fmt: skip
        else:
            progress = shown.enter_context(progress_bars(console, "success", "speed"))
            bar = progress.add_task("recording", total=len(specs), success="", speed="")

        shown_at = 0.0

        def show(now: bool = False) -> None:
            nonlocal shown_at
            if progress is not None and (now or time.perf_counter() - shown_at > _SHOWN_EVERY_S):
                shown_at = time.perf_counter()
                speed = f"{result.real_time_factor:.0f}x real time" if result.recorded else ""
                done = result.recorded + part_done(loop)
                progress.update(bar, completed=done, success=result.succeeded if result.recorded else "", speed=speed)

        for episode in _episodes(loop, specs, result, recorder, show=show, console=console):
            if episode.writer is not None and episode.writer.dropped:
                _print_dropped(episode, len(loop.robots.camera_shapes), console)
            takes.add(episode)
            if loop.before_start is None:
                takes.wait()
            show(now=True)
    result.episodes = recorder.num_episodes
    recorder.finalize()
    result.wall_s = time.perf_counter() - started if result.recorded else 0.0
    return album, first


def _print_dropped(episode: Episode, cameras: int, console: Console) -> None:
    """Print that the encoder did not keep up, with the rate that it keeps."""
    writer = episode.writer
    images = ", ".join(f"{len(rows)} of {episode.frames} of {key}" for key, rows in writer.dropped.items())
    console.print(
        f"The video encoder {writer.video.vcodec} keeps about {writer.images_per_s / cameras:.0f} frames a second of "
        f"{counted(cameras, 'camera')}: it dropped {images}; the image before stands in the place of each. Record "
        "with a lower --dataset.fps, smaller images or fewer cameras.",
        soft_wrap=True,
        highlight=False,
    )


def _make_marks(config: RecordConfig, n: int) -> Marks:
    """Return what takes a person's keys: before the first take they mean nothing."""
    outcomes = outcomes_of(config.task.get_choice_name(type(config.task)))
    hands_over, shortest_s = config.teleop is not None, _SHORTEST_S if config.is_live else 0.0
    marks = Marks(n, outcomes, mark_keys(config), hands_over=hands_over, shortest_s=shortest_s)
    marks.close("the first take has not begun; only the emergency stop counts")
    return marks


def _make_status(config: RecordConfig, marks: Marks, console: Console) -> RecordStatus:
    """Return what a person sees of a recording on the wall clock."""
    brain: Any = config.brain
    name = "a person" if isinstance(brain, TeleopConfig) else brain.get_choice_name(type(brain))
    return RecordStatus(
        console,
        config.dataset.num_episodes,
        config.dataset.fps,
        cast(Any, config.task).duration_s,
        driver=lambda: "a person" if config.teleop is not None and marks.is_driving() else name,
        marks=marks,
        bell=config.bell,
    )


def _episodes(
    loop: EpisodeLoop,
    specs: list[EpisodeSpec],
    result: RecordResult,
    recorder: DatasetRecorder,
    *,
    show: Callable[[], None],
    console: Console,
) -> Iterator[Episode]:
    """Run episodes; with `timing.reject`, those that were too unpunctual are run again. `show` is called each frame."""

    def stop() -> bool:
        show()
        return bool(result.stopped_by)

    if not (loop.robots.clock is not None and loop.tolerance.reject):
        yield from loop.run(specs, stop, recorder.begin_episode)
        return
    waiting = list(reversed(specs))
    while waiting:
        spec = waiting[-1]
        for attempt in range(1, _ATTEMPTS + 1):
            with closing(loop.run([spec], stop, recorder.begin_episode)) as run_once:
                episode = next(run_once, None)
            if episode is None:
                return
            if episode.spec != spec:  # the one before, again, because it was discarded
                waiting.append(episode.spec)
                spec = episode.spec
            if loop.emergency_stop or loop.fault:  # it is not run again, however punctual it was
                yield episode
                return
            why = verdict(episode.timing, loop.tolerance)
            if why is None:
                waiting.pop()
                yield episode
                break
            if episode.writer is not None:
                episode.writer.discard()
            console.print(f"Episode {spec.index}, attempt {attempt} of {_ATTEMPTS}, was not saved: {escape(why)}")
        else:
            raise RealtimeError(
                f"Episode {spec.index} exceeded the timing tolerance {_ATTEMPTS} times. Earlier episodes are saved. "
                "Fix the cause and continue with --resume=true, or also save such episodes, flagged, with "
                "--timing.reject=false."
            )


def _add_estop_inputs(config: RecordConfig, pressed: EstopInputs, console: Console) -> None:
    """Let a signal and, in a terminal, a key press the emergency stop."""
    is_live = config.is_live
    number = estop_signal(config.estop_signal)
    pressed.add_signal(number)
    has_key = (is_live if config.estop_key is None else config.estop_key) and pressed.add_key()
    if config.estop_key and not has_key:
        raise ConfigError("estop_key is true, but standard input is not a terminal for this program alone.")
    if is_live:
        key = "space or e, or " if has_key else ""
        console.print(f"Emergency stop: {key}kill -{number.name.removeprefix('SIG')} {os.getpid()}")
    if has_key:
        console.print(f"Keys: {key_help(mark_keys(config))}")


def _recording(config: RecordConfig, root: Path) -> Recording:
    dataset = config.dataset
    return Recording(
        dataset.repo_id,
        root,
        dataset.fps,
        config.task,
        config.seed,
        config.split,
        resume=config.resume,
        language=dataset.language,
        expert_action=dataset.expert_action,
    )


def _continuable(recorder: DatasetRecorder) -> DatasetRecorder:
    """Return a recorder if the episodes of its dataset are those of their numbers: the missing ones follow them."""
    for episode in dataset_info(recorder.root).episodes if recorder.num_episodes else ():
        if (number := episode.metadata.get("episode")) != episode.index:
            what = "of another program" if number is None else f"number {number} of its recording"
            raise DatasetMismatchError(
                f"{recorder.root} cannot be resumed: its episode {episode.index} is {what}, so the next episodes would "
                "not be the missing ones. Record those into another root, with another seed, and merge the two."
            )
    return recorder


def _judged_task(config: RecordConfig, robots: Robots, console: Console) -> Task:
    task = make_task(config.task, robots.n, config.dataset.fps, robots.body)
    task = judged(task, robots.knows, robots.n, config.dataset.fps)
    if isinstance(task, OperatorTask):
        console.print(
            f"The robot does not measure what {task.name!r} is judged by: mark the end of each episode with a key "
            f"({key_help(mark_keys(config))}); otherwise it ends in a time-out."
        )
    return task


def _trajectory(episode: Episode, robots: Robots, attempts: bool) -> Trajectory | None:
    outcome = episode.outcome
    title = str(episode.spec.index) + f": {outcome.event.cause}, score {outcome.score:.2f}" * attempts
    track = track_of(robots, episode.columns)
    if not len(track):
        return None
    return Trajectory(title, episode.scene, track[:, :2], outcome.success if attempts else None, episode.instruction)


def _make_preview(config: RecordConfig, robots: Robots, console: Console) -> Preview | None:
    if config.preview_video is False:
        return None
    if robots.world is None:
        if config.preview_video:
            raise ConfigError("preview_video is true, but a video is rendered from a simulator, and there is none.")
        return None
    try:
        return Preview(make_simulation(config.robot))
    except RenderingError as error:
        if config.preview_video:
            raise
        console.print(f"No video of an episode: {error}")
        return None


def _push(config: RecordConfig, result: RecordResult, console: Console) -> None:
    dataset = config.dataset
    again = push_command(result.root, dataset.repo_id, private=dataset.private, tags=dataset.tags)
    if result.exit_status:
        message = f"The dataset is not complete, so it was not uploaded. To upload it as it is:\n  {again}"
    else:
        private = True if dataset.private else None  # of a repository that exists, whatever it is
        left = left_by_interrupt(result.root, again)
        try:
            with prompt_interrupt(left):
                report = push_dataset(result.root, dataset.repo_id, private=private, tags=dataset.tags)
                message = format_push_report(report)
        except KeyboardInterrupt:
            console.print(escape(f"Stopped; {left}"), soft_wrap=True, highlight=False)
            raise
    console.print(escape(message), soft_wrap=True, highlight=False)
