"""Sends the recorded actions of an episode to a robot, and reports how its observations differ from the recording."""

import os
from contextlib import ExitStack, closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, DatasetError, RealtimeError
from bhd_lerobot.options.units import other_units
from bhd_lerobot.realtime.estop import EstopInputs, estop_signal
from bhd_lerobot.registry import is_ours, make_robot
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.host.host import describe
from bhd_lerobot.rollout.progress import print_notes
from bhd_lerobot.rollout.signals import stop_on_signals


def replay_on_robot(root: Path, episode: int, robot: Any, gate: GateConfig, console: Console) -> float:
    """Replay an episode of a dataset; return the largest difference of a value from the recorded one, in its own unit.

    Raises:
        DatasetError: the dataset's actions are not those of the robot, by their names.
        ConfigError: the gate lets the robot jump to where the episode began, or an option of the robot says that its
            numbers mean something else than in the recording.
        RealtimeError: the robot was stopped, also by Ctrl-C, SIGTERM or SIGHUP.
    """
    if not is_ours(robot.type) and gate.max_change is None:
        raise ConfigError(
            "gate.max_change is not set: the robot would jump from where it is to where the episode began. Set it to "
            "the largest change of a position in a frame, --gate.max_change=5 for example, in the action's unit."
        )
    if is_ours(robot.type) and robot.clock != "realtime":
        raise ConfigError("robot is given, and robot.clock is 'lockstep'; leave robot out to replay in simulation.")
    summary, columns = dataset_info(root), read_episode(root, episode)
    for name, then, now in other_units(summary.recording.get("robot", {}), describe(robot)):
        raise ConfigError(
            f"{root} was recorded with robot.{name} = {then}, and it is {now}: its numbers mean something else to this "
            f"robot. Set --robot.{name}={then}."
        )
    names = keys.names_of(summary.features[keys.ACTION])
    if not names:
        raise DatasetError(
            f"The actions of {root} are not named one by one, so it is not known which of the robot's they are for. "
            f"Add the names to {layout.INFO}: features, action, names."
        )
    recorded = dict(zip(names, np.asarray(columns[keys.ACTION], np.float64).T, strict=True))
    observed: Any = {}
    if keys.OBSERVATION_STATE in columns:
        values = np.asarray(columns[keys.OBSERVATION_STATE], np.float64)
        observed = dict(zip(keys.names_of(summary.features[keys.OBSERVATION_STATE]), values.T, strict=False))
    with stop_on_signals() as stop, EstopInputs() as pressed, ExitStack() as opened:
        pressed.add_signal(estop_signal("SIGUSR1"))  # it counts from the first moment on, while there is no robot yet
        key = "space or e, or " if pressed.add_key() else ""
        with nullcontext() if is_ours(robot.type) else pressed.lend_keys():  # it may ask how it is to be calibrated
            robots: Any = opened.enter_context(closing(make_robot(robot, fps=summary.fps, gate=gate)))
        pressed.attach(robots.estop)
        if set(names) != set(robots.action_names):
            own = ", ".join(robots.action_names)
            raise DatasetError(f"The actions of {root} are {', '.join(names)}; those of {robot.type} are {own}.")
        actions = np.stack([recorded[name] for name in robots.action_names], axis=1)
        if not is_ours(robot.type) and (free := robots.gate.free_to_jump()):
            raise ConfigError(
                f"gate.max_change does not limit {', '.join(free)}: there the robot would jump from where it is to "
                "where the episode began. Set one number for all positions, or one for each."
            )
        print_notes(console, robots)
        console.print(f"Emergency stop: {key}kill -USR1 {os.getpid()}")
        only = np.zeros(1, np.intp)
        robots.reset(only, [None], [0])
        seen = []
        for action in actions:
            seen.append(robots.observe().state[0])
            report = robots.step(None if stop else action[None])
            mode = Mode(int(report.mode[0]))
            if mode in (Mode.ESTOP, Mode.FAULT) or stop:
                why = robots.problem or ", ".join(pressed.causes) or stop.name or mode.name
                stopped = RealtimeError(f"The robot was stopped after {len(seen)} of {len(actions)} frames: {why}.")
                stopped.exit_status = stop.exit_status or stopped.exit_status
                raise stopped
        robots.stop(only)
    seen_by_name = dict(zip(robots.observation_names, np.array(seen).T, strict=True))
    both = {name: (seen_by_name[name], values) for name, values in observed.items() if name in seen_by_name}
    return _print_differences(both, console)


def _print_differences(pairs: dict[str, Any], console: Console) -> float:
    if not pairs:
        console.print("The recording has no observation of a name that the robot observes: nothing is compared.")
        return 0.0
    table = Table(title="Difference from the recording", title_justify="left")
    for heading in ("observed", "mean", "largest", "at the end"):
        table.add_column(heading, justify="left" if heading == "observed" else "right")
    difference = {name: np.abs(seen - recorded) for name, (seen, recorded) in pairs.items()}
    for name, column in difference.items():
        table.add_row(name, *(f"{value:.4g}" for value in (column.mean(), column.max(), column[-1])))
    console.print(table)
    return float(max(column.max() for column in difference.values()))
