"""What is in the frames of an episode that is made of a robot's bag: every column but the images."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.importer.resample import NANO, Times, newest, newest_before
from bhd_lerobot.ros2.bag.importer.tracks import Array, Track
from bhd_lerobot.ros2.messages.table import ODOMETRY, TWIST
from bhd_lerobot.tasks.task import Event

MOST_UNEXPLAINED = 0.1
"""Share of the frames in which a robot may move without a command: beyond it, what drove it is another one."""
_MOVES = 0.01
"""[m/s, rad/s] A robot that is slower stands."""


def frame_columns(
    options: ImportOptions, tracks: Sequence[Track], times: Times, ages: Times
) -> dict[str, NDArray[Any]]:
    """Return the columns of an episode.

    Args:
        ages: of the oldest of each frame's newest readings [ns], shape (n,).
    """
    n = len(times)
    commands, command_age = _commands(options, tracks, times)
    in_force = command_age >= 0
    limits = np.inf if options.max_speed is None else np.array(options.max_speed)
    applied = np.clip(commands, -limits, limits)
    over = (applied != commands).any(axis=1)
    done = np.arange(n) == n - 1
    ended = Event.NOTHING if options.outcome is None else Event[options.outcome.upper()]
    vectors = {
        keys.OBSERVATION_STATE: _state(options, tracks, times),
        keys.ACTION: commands,
        keys.APPLIED_ACTION: applied,
    }
    return {
        **{key: values.astype(np.float32) for key, values in vectors.items()},
        keys.TIME: (times - times[0]) / NANO,
        keys.AGE: (ages / NANO).astype(np.float32),
        keys.COMMAND_AGE: (np.where(in_force, command_age, 0) / NANO).astype(np.float32),
        keys.LATENESS: np.zeros(n, np.float32),
        keys.OVERRUNS: np.zeros(n, np.int64),
        keys.SKIPPED: np.zeros(n, np.int64),
        keys.INFERENCE_TIME: np.zeros(n, np.float32),
        keys.LATE: ages > round(options.max_age_s * NANO),
        keys.LIMITS: np.where(over, int(Limit.VELOCITY), 0),
        keys.WATCHDOG: np.where(in_force, 0, int(Watchdog.COMMAND_AGE)),
        keys.MODE: np.where(in_force, int(Mode.TRACKING), int(Mode.HOLD)),
        keys.REWARD: np.zeros(n, np.float32),
        keys.SUCCESS: done & (ended == Event.SUCCESS),
        keys.DONE: done,
        keys.EVENT: np.where(done, int(ended), 0),
    }


def command_note(options: ImportOptions, columns: Mapping[str, NDArray[Any]]) -> str | None:
    """Return how many frames have no command, or one that the robot does not obey; None if all is well."""
    n, silent = len(columns[keys.MODE]), columns[keys.MODE] == int(Mode.HOLD)
    for_ever = np.isinf(options.command_timeout_s)
    if not silent.any():
        judged = for_ever and options.timeouts and TWIST[0] in options.observation_names
        return _standing_note(options, columns) if judged else None
    lacking = "come before the first command" if for_ever else (
        f"have no command that is younger than {options.command_timeout_s:g} s"
    )  # fmt: skip
    moving = int((silent & _moves(options.observation_names, columns[keys.OBSERVATION_STATE])).sum())
    drove = f", though the robot moved in {moving} of them" if moving else ""
    if moving and not for_ever:
        drove += ": --command_timeout=inf is for robots that continue with the last command"
    return f"{int(silent.sum())} of {n} frames of the episode {lacking}; their action is 0{drove}"


def _standing_note(options: ImportOptions, columns: Mapping[str, NDArray[Any]]) -> str | None:
    driven = _moves(options.action_names, columns[keys.ACTION])
    against = int((driven & ~_moves(options.observation_names, columns[keys.OBSERVATION_STATE])).sum())
    if against <= MOST_UNEXPLAINED * len(driven):
        return None
    return (
        f"in {against} of {len(driven)} frames of the episode the robot stands though its last command is to drive. If "
        "it stops by itself when no command comes, give that time: --command_timeout=S"
    )


def unexplained_frames(
    options: ImportOptions, tracks: Sequence[Track], times: Times, timeout_s: float
) -> tuple[int, int]:
    """Return in how many frames the robot moves without a command, and in how many it stands against one."""
    commands, age = _commands(replace(options, command_timeout_s=timeout_s), tracks, times)
    observed = _vector(options.observation_names, tracks, times)
    moves, driven = _moves(options.observation_names, observed), _moves(options.action_names, commands)
    return int((moves & (age < 0)).sum()), int((~moves & driven).sum())


def _moves(names: tuple[str, ...], values: NDArray[Any]) -> NDArray[np.bool_]:
    return (np.abs(values[:, [names.index(name) for name in TWIST if name in names]]) > _MOVES).any(axis=1)


def unanswered(options: ImportOptions, tracks: Sequence[Track], times: Times) -> int:
    """Return how many frames at the beginning end before the first command of a position.

    Speeds are 0 without a command; a position that nothing commands is not.
    """
    ends = _ends(times, options.fps)
    waits = [track for track in tracks if track.is_action and not all(name.endswith(".vel") for name in track.names)]
    return max((int((newest_before(track.times, ends) < 0).sum()) for track in waits), default=0)


def _ends(times: Times, fps: int) -> Times:
    """Return when frames end [ns]: each with the beginning of the next, shape (n,)."""
    return np.append(times[1:], times[-1] + round(NANO / fps))


def _commands(options: ImportOptions, tracks: Sequence[Track], times: Times) -> tuple[Array, Times]:
    """Return the command in force at the end of each frame, shape (n, d), and its age then [ns]; 0 and -1 if none.

    An action is the command over the frame that an observation begins. What answers the observation comes after
    it: the command in force when the observation was taken is the answer to the one before.
    """
    ends = _ends(times, options.fps)
    age = np.zeros_like(ends)
    columns: dict[str, Array] = {}
    for track in tracks:
        if not track.is_action:
            continue
        place = newest_before(track.times, ends)
        since = np.where(place < 0, -1, ends - track.times[place]) if len(track.times) else np.full(len(ends), -1)
        if np.isfinite(options.command_timeout_s):
            since = np.where(since > round(options.command_timeout_s * NANO), -1, since)
        rows = track.values[place] if len(track.times) else np.zeros((len(ends), len(track.names)))
        columns |= dict(zip(track.names, np.where(since[:, None] >= 0, rows, 0.0).T, strict=True))
        age = np.where((age < 0) | (since < 0), -1, np.maximum(age, since))
    return np.stack([columns[name] for name in options.action_names], axis=1), age


def _state(options: ImportOptions, tracks: Sequence[Track], times: Times) -> Array:
    state = _vector(options.observation_names, tracks, times)
    names = list(options.observation_names)
    if options.pose:
        pose = [names.index(name) for name in ODOMETRY]
        state[:, pose] = _since_start(state[:, pose])
        return state
    for angle, turn in {name: turn for track in tracks for name, turn in track.source.angles.items()}.items():
        yaw = state[:, names.index(angle)]  # unwrapped over a bag, which may hold several episodes
        yaw -= turn * np.round(yaw[0] / turn)
    return state


def _vector(names: tuple[str, ...], tracks: Sequence[Track], at: Times) -> Array:
    """Return what the newest messages of the sensors at some times say, shape (n, len(names))."""
    columns: dict[str, Array] = {}
    for track in tracks:
        if track.source.feature == keys.OBSERVATION_STATE:
            columns |= dict(zip(track.names, track.values[newest(track.times, at)].T, strict=True))
    return np.stack([columns[name] for name in names], axis=1)


def _since_start(pose: Array) -> Array:
    """Return poses x, y, yaw in the frame of the first one, shape (n, 3)."""
    x, y, yaw = (pose - pose[0]).T
    cos, sin = np.cos(pose[0, 2]), np.sin(pose[0, 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, yaw], axis=1)
