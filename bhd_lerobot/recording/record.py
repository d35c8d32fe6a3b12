"""`bhd-record`: episodes of a simulated robot, driven by a brain, into a LeRobotDataset."""

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from bhd_lerobot.cluster.loop import ClusterLoop, open_pool
from bhd_lerobot.control.estop import EstopInputs, estop_signal
from bhd_lerobot.control.tolerance import verdict
from bhd_lerobot.datasets.format.features import (
    ACTION,
    EFFORT,
    EXPERT_ACTION,
    LANGUAGE,
    PHYSICS_STATE,
    SUBTASK,
    dataset_features,
)
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.format.summary import DatasetSummary, dataset_info
from bhd_lerobot.datasets.storage.atomic import is_free
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import BhdError, ConfigError, RealtimeError, RenderingError
from bhd_lerobot.hub.push import check_pushable, format_push_report, left_by_interrupt, push_command, push_dataset
from bhd_lerobot.hub.transfer import prompt_interrupt
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.live_view import live_view
from bhd_lerobot.recording.report import RecordResult, print_refusals, print_summary, progress_bars
from bhd_lerobot.registry import make_brain, make_robot, make_simulation, make_task
from bhd_lerobot.robots.host.host import Host, describe
from bhd_lerobot.rollout.episode import EpisodeLoop, track_of
from bhd_lerobot.rollout.marks import KEYS, Marks
from bhd_lerobot.rollout.plots import Trajectory, TrajectoryAlbum
from bhd_lerobot.rollout.preview import Preview
from bhd_lerobot.rollout.provenance import episode_metadata
from bhd_lerobot.rollout.run_folder import run_folder
from bhd_lerobot.rollout.signals import stop_on_signals
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.operator import OperatorTask, judged
from bhd_lerobot.tasks.task import Task, episode_seed, outcomes_of


def language_column(plan: dict[str, Any], subtasks: NDArray, fps: int) -> NDArray:
    """Return LeRobot's column `language_persistent`: the plan, and every subtask from its first frame on.

    Every frame of an episode holds the same rows.

    Args:
        plan: the plan; its `steps` are pairs of a skill and a text.
        subtasks: what the brain was doing in each frame, shape (frames,).
        fps: frames a second [Hz].
    """
    rows: list[dict[str, Any]] = []

    def say(style: str, content: str, frame: int) -> None:
        when = {"timestamp": frame / fps, "camera": None, "tool_calls": None}
        rows.append({"role": "assistant", "content": content, "style": style, **when})

    if plan.get("steps"):
        say("plan", "\n".join(f"{number}. {text}" for number, (_, text) in enumerate(plan["steps"], 1)), 0)
    for frame, text in enumerate(subtasks):
        if frame == 0 or text != subtasks[frame - 1]:
            say("subtask", str(text), frame)
    column = np.empty(len(subtasks), dtype=object)
    column[:] = [rows] * len(subtasks)
    return column


_ATTEMPTS = 3  # that an episode gets to be punctual


def record(config: RecordConfig, console: Console | None = None) -> RecordResult:
    """Record the episodes that a configuration describes; those that were saved before an error are intact."""
    if config.dataset.push_to_hub:
        check_pushable(config.dataset.repo_id)  # before hours of recording, not after
    console = console or Console(stderr=True)
    root = Path(config.dataset.root).expanduser() if config.dataset.root else default_root(config.dataset.repo_id)
    if config.resume and not is_free(root):
        _keep_to(root, config.robot, console)
    is_here = config.engine == "local"  # otherwise one simulation, which only states what is recorded
    n = 1 if config.robot.clock == "realtime" or not is_here else min(config.n_envs, config.dataset.num_episodes)
    simulation = make_robot(config.robot, n, config.threads)
    # Innermost first: what is recorded is finalised, then the signals' handlers come back, then the renderer is freed.
    marks = Marks(n, outcomes_of(config.task.get_choice_name(type(config.task))))
    pressed = EstopInputs(simulation.bridge.estop, marks.on_key)
    with closing(simulation), stop_on_signals() as stop, pressed, ExitStack() as cluster:
        _add_estop_inputs(config, pressed, console)
        task = _judged_task(config, simulation, console)
        brain = make_brain(config.brain)
        # A brain that does not fit the robot fails here, before a dataset exists.
        if is_here:
            loop = EpisodeLoop(simulation, task, brain, config.timing)
        else:
            pool = cluster.enter_context(open_pool(config.ray, console))
            loop = ClusterLoop(
                simulation, task, brain, config.timing, pool=pool, config=config, brain_config=config.brain
            )
        loop.marks = marks
        print_refusals(simulation, console)
        preview = _make_preview(config, simulation, console)
        if simulation.camera_names and is_here:
            simulation.start_rendering()  # a machine without OpenGL fails here, before a dataset exists
        with ExitStack() as opened:
            with run_folder(config, "record") as output_dir:
                # A view that cannot be started fails before a dataset exists.
                loop.observer = opened.enter_context(live_view(config, simulation, console))
                recorder = opened.enter_context(open_recorder(config, root, simulation, task, brain))
            result = RecordResult(root, output_dir, stopped_by=stop)
            if recorder.repair_report:
                console.print(f"Repaired before resuming: {recorder.repair_report}")
            album, first = _run(config, recorder, loop, result, console)
        if loop.fault:
            result.fault = simulation.problem
        if loop.emergency_stop:
            result.estop = ", ".join(pressed.causes) or "from another process"
    if album.added:
        heading = f"{task.name}, {brain.name}: {result.successes} of {result.recorded} episodes succeeded"
        album.draw(output_dir / "trajectories.png", heading)
    if first is not None and preview is not None:
        states = first.columns[PHYSICS_STATE]
        preview.write(first.scene, states, config.dataset.fps, output_dir / "episode.mp4")
        preview.write_strip(first.scene, states, config.dataset.fps, output_dir / "episode.png")
        preview.close()
    print_summary(console, config, result, preview is not None and first is not None)
    if config.dataset.push_to_hub:
        _push(config, result, console)
    return result


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
    with progress_bars(console, "success", "speed") as progress:
        bar = progress.add_task("recording", total=len(specs), success="", speed="")
        started = time.perf_counter()
        for episode in _episodes(loop, specs, result, recorder, console):
            metadata = episode_metadata(episode, split=config.split, task=task.parameters(), brain=brain.parameters())
            if config.dataset.language and brain.has_plan:
                rows = language_column(episode.plan, episode.columns[SUBTASK], config.dataset.fps)
                episode.columns[LANGUAGE] = rows
            save_episode(recorder, episode, metadata)
            result.count(episode, config.dataset.fps)
            result.wall_s = time.perf_counter() - started
            album.add(_trajectory(episode, loop.simulation))
            first = first or episode
            progress.update(
                bar,
                advance=1,
                success=f"{result.successes}/{result.recorded} succeeded",
                speed=f"{result.real_time_factor:.0f}x real time",
            )
    result.episodes = recorder.num_episodes
    recorder.finalize()
    result.wall_s = time.perf_counter() - started if result.recorded else 0.0
    return album, first


def _episodes(
    loop: EpisodeLoop, specs: list[EpisodeSpec], result: RecordResult, recorder: DatasetRecorder, console: Console
) -> Iterator[Episode]:
    """Run episodes; with `timing.reject`, those that were too unpunctual are run again."""

    def stop() -> bool:
        return bool(result.stopped_by)

    if not (loop.simulation.is_live and loop.tolerance.reject):
        yield from loop.run(specs, stop, recorder.begin_episode)
        return
    for spec in specs:
        for attempt in range(1, _ATTEMPTS + 1):
            with closing(loop.run([spec], stop, recorder.begin_episode)) as run_once:
                episode = next(run_once, None)
            if episode is None:
                return
            if loop.emergency_stop or loop.fault:  # it is not run again, however punctual it was
                yield episode
                return
            why = verdict(episode.timing, loop.tolerance)
            if why is None:
                yield episode
                break
            if episode.writer is not None:
                episode.writer.discard()
            console.print(f"Episode {spec.index}, attempt {attempt} of {_ATTEMPTS}, was not saved: {escape(why)}")
        else:
            raise RealtimeError(
                f"Episode {spec.index} was too unpunctual {_ATTEMPTS} times. Those before it are saved. Repair the "
                "cause and go on with --resume=true, or save such episodes too, flagged, with --timing.reject=false."
            )


def _add_estop_inputs(config: RecordConfig, pressed: EstopInputs, console: Console) -> None:
    """Let a signal and, in a terminal, a key press the emergency stop."""
    is_live = config.robot.clock == "realtime"
    number = estop_signal(config.estop_signal)
    pressed.add_signal(number)
    has_key = (is_live if config.estop_key is None else config.estop_key) and pressed.add_key()
    if config.estop_key and not has_key:
        raise ConfigError("estop_key is true, but standard input is no terminal that this program has to itself.")
    if is_live:
        key = "space or e, or " if has_key else ""
        console.print(f"Emergency stop: {key}kill -{number.name.removeprefix('SIG')} {os.getpid()}")
    if has_key:
        console.print(f"Keys: {KEYS}")


def open_recorder(config: RecordConfig, root: Path, simulation: Host, task: Task, brain: Brain) -> DatasetRecorder:
    """Open the dataset that a configuration asks for, or continue with it."""
    nq, nv = (part.shape[1] for part in simulation.physics)
    physics = [f"qpos_{i}" for i in range(nq)] + [f"qvel_{i}" for i in range(nv)]
    features = dataset_features(
        simulation.observation_names,
        simulation.action_names,
        simulation.camera_shapes,
        physics,
        task.environment_names,
        effort_names=simulation.effort_names,
        wrench_names=simulation.wrench_names,
        expert=config.dataset.expert_action,
        subtask=brain.has_plan,
        language=brain.has_plan and config.dataset.language,
    )
    if config.dataset.expert_action:
        _check_expert(brain)
    # What decides the episodes. How many there are, and how many run side by side, does not.
    recording: dict[str, Any] = {
        "robot": describe(simulation.config),
        "task": task.parameters(),
        "brain": brain.parameters(),
        "seed": config.seed,
        "split": config.split,
    }
    goes_on = config.resume and not is_free(root)
    if goes_on and (info := _info(root)) is not None:
        if EFFORT not in info.features:
            features.pop(EFFORT, None)  # the dataset is older than this column
        recording["task"] = _without_new(recording["task"], info.recording.get("task"), type(config.task))
        recording["brain"] = _as_named_then(recording["brain"], info.recording.get("brain"))
    make = DatasetRecorder.resume if goes_on else DatasetRecorder.create
    return make(
        config.dataset.repo_id,
        config.dataset.fps,
        features,
        robot_type=config.robot.type,
        root=root,
        recording=recording,
    )


def _judged_task(config: RecordConfig, robots: Host, console: Console) -> Task:
    task = make_task(config.task, robots.n, config.dataset.fps, robots.body)
    task = judged(task, robots.knows, robots.n, config.dataset.fps)
    if isinstance(task, OperatorTask):
        console.print(
            f"The robot does not measure what {task.name!r} is judged by: say how each episode ends, with the keys s "
            "(success) and f (failure); otherwise it ends in a time-out."
        )
    return task


def _keep_to(root: Path, robot: Any, console: Console) -> None:
    """Continue as a dataset began that is older than the jerk limits."""
    info = _info(root)
    recorded = info.recording.get("robot", {}) if info else {}
    if recorded and robot.jerk_limits and "jerk_limits" not in recorded:
        robot.jerk_limits = False
        console.print("The dataset was recorded without jerk limits: it goes on with robot.jerk_limits=false.")


def _without_new(asked: dict[str, Any], recorded: Any, kind: type) -> dict[str, Any]:
    """Return options without those that a dataset is older than, if they are as they are by default.

    By default an option of a task leaves it as it was before there was that option.
    """
    if not isinstance(recorded, Mapping):
        return asked
    kept = dict(asked)
    for field in fields(kind):
        name = field.name
        made = field.default if field.default_factory is MISSING else field.default_factory()
        default = asdict(made) if is_dataclass(made) and not isinstance(made, type) else made
        if name not in kept:
            continue
        if name not in recorded and kept[name] == default:
            del kept[name]
        elif name in recorded and is_dataclass(made):
            kept[name] = _without_new(kept[name], recorded[name], type(made))
    return kept


def _as_named_then(asked: Any, recorded: Any) -> Any:
    """Return the parameters of a brain with each policy named as in the dataset, if its weights are those.

    A policy is what its weights are: it may have been moved, and older datasets name it as the user did.
    """
    if not (isinstance(asked, Mapping) and isinstance(recorded, Mapping)):
        return asked
    named = {name: _as_named_then(value, recorded.get(name)) for name, value in asked.items()}
    if "path" in recorded and "weights" in asked and asked["weights"] == recorded.get("weights"):
        named["path"] = recorded["path"]
    return named


def _info(root: Path) -> DatasetSummary | None:
    try:
        return dataset_info(root)
    except BhdError:  # what is wrong with it is said when it is resumed
        return None


def _check_expert(brain: Any) -> None:
    """Raise if nobody states what an expert would do."""
    if brain.name == "learned":  # a rule is its own expert
        raise ConfigError(
            f"dataset.expert_action asks for what an expert would do, and brain.type is {brain.name!r}, a policy, and "
            "no expert. Use a rule, or brain.type=dagger with a rule as its expert, such as gap_follower."
        )


_BY_OPTION = (EFFORT, EXPERT_ACTION)
"""Columns that a dataset may do without: it is older, or did not ask for them."""


def save_episode(recorder: DatasetRecorder, episode: Episode, metadata: dict[str, Any]) -> None:
    """Save an episode; when this returns, it survives a kill."""
    writer = episode.writer or recorder.begin_episode()
    try:
        known = recorder.features
        columns = {key: column for key, column in episode.columns.items() if key not in _BY_OPTION or key in known}
        if EXPERT_ACTION in known:
            columns.setdefault(EXPERT_ACTION, columns[ACTION])  # of a rule, which is the expert
        writer.set_columns(columns)
        recorder.save(writer, task=episode.instruction, metadata=metadata)
    except BaseException:
        writer.discard()
        raise


def _trajectory(episode: Episode, simulation: Host) -> Trajectory:
    outcome = episode.outcome
    title = f"{episode.spec.index}: {outcome.event.cause}, score {outcome.score:.2f}"
    track = track_of(simulation, episode.columns)
    return Trajectory(title, episode.scene, track[:, :2], outcome.success, episode.instruction)


def _make_preview(config: RecordConfig, simulation: Host, console: Console) -> Preview | None:
    if config.preview_video is False:
        return None
    if not simulation.is_simulated:
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
