"""The display of `bhd-monitor`: from a state to a table of 80 columns, as many lines as there are. Pure."""

from collections.abc import Iterator

from rich.console import Group
from rich.table import Column, Table
from rich.text import Text

from bhd_lerobot.apps.monitor.state import HEARTBEATS, Count, MonitorState, Spread

WIDTH = 80
KEYS = "e or space: emergency stop   q: quit"

_MODES = {
    "HOLD": "black on green",
    "TRACKING": "black on cyan",
    "STOPPING": "black on yellow",
    "ESTOP": "bold white on red",
    "FAULT": "bold white on red",
}
_LATE_S, _SILENT_S = 0.1, 0.5  # a process without a sign of life for so long is highlighted
_NOTHING = "–"


def render(state: MonitorState, *, height: int | None = None, message: str = "", keys: str = KEYS) -> Group:
    """Return the image of a state in at most `height` lines, the last of which is the message or the keys."""
    last = [Text((message or keys)[:WIDTH], "bold yellow" if message else "dim")] if message or keys else []
    rows = list(_rows(state))
    width = min(24, max(len(label) for label, _ in rows))
    columns = [Column(no_wrap=True, width=one) for one in (width, WIDTH - 1 - width)]
    table = Table.grid(*columns, padding=(0, 1))
    for label, text in rows if height is None else rows[: max(0, height - len(last))]:
        table.add_row(Text(label, "dim"), text)
    return Group(table, *last)


def _rows(state: MonitorState) -> Iterator[tuple[str, Text]]:
    minutes, seconds = divmod(int(state.uptime), 60)
    about = f"  {state.robot}, up {minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
    yield "robot", Text(state.id, "bold", end="").append(about, "not bold")
    yield "mode", _mode(state)
    yield "control", _rate(state.control_rate, state.control_hz, 0.01, executed=state.executed, overruns=state.overruns)
    yield "frames", _rate(state.frame_rate, state.fps, 0.15, skipped=state.skipped, drops=state.recorder_drops)
    yield "commands", _rate(state.command_rate, 0, 0.0, **{"world behind": state.catch_up_lost})
    yield "lateness", _spread(state.lateness)
    yield "tick takes", _spread(state.duration)
    waiting = f"{state.fifo_fill} of {state.fifo_capacity}"
    queue = Text(waiting, "bold red" if state.fifo_fill >= state.fifo_capacity else "")
    ages = f"   command age {duration(state.command_age)}   observation age {duration(state.observation_age)}"
    yield "queue", queue.append(ages, "not bold default")
    yield "last signs", _alive(state)
    yield "", Text(f"{'requested':>11}{'applied':>11}{'measured':>11}", "dim")
    for one in state.dimensions:
        limited = one.requested is not None and abs(one.requested - one.applied) > 1e-3
        row = Text(_number(one.requested)).append(_number(one.applied), "yellow" if limited else "")
        yield one.name, row.append(f"{_number(one.measured)} {unit(one.name)}")
    if state.goal is not None:
        done = 100 * min(max(state.goal["progress"], 0.0), 1.0)
        left = f"{done:3.0f} %, {max(0.0, state.goal['remaining_s']):5.1f} s left"
        yield "goal", Text(f"{state.goal['task_id'][:16]} {state.goal['phase'].lower()} {left}")
    if state.pose:
        x, y, yaw = (state.pose[key] for key in ("x", "y", "yaw"))
        yield "odometry", Text(f"x {x:.3f} m   y {y:.3f} m   yaw {yaw:.3f} rad")
    yield "limits", _counts(state.limits)
    yield "watchdogs", _counts(state.watchdogs)
    yield "refused", _counts({name: Count(n, None) for name, n in state.refusals.items()})


def _mode(state: MonitorState) -> Text:
    mode = state.mode or "UNKNOWN"
    time = _NOTHING if state.episode_time is None else f"{state.episode_time:.1f} s"
    line = Text.assemble((f" {mode} ", _MODES.get(mode, "black on white")))
    line.append(f" {state.phase.lower()}, episode {state.episode}, {time} ")
    silent = state.alive.get("cerebellum")
    if state.phase == "RUNNING" and silent is not None and silent > _SILENT_S:
        line.append(f"cerebellum silent {min(silent, 999):.0f} s", "bold white on red")
    elif state.estop and not state.estop_latched:
        line.append("e-stop not latched yet", "bold white on red")
    elif state.estop_latched:
        line.append("emergency stop latched", "bold red")
    return line


def _rate(measured: float | None, wanted: int, off: float, **counts: int) -> Text:
    is_off = measured is not None and wanted and abs(measured - wanted) > off * wanted
    line = Text.assemble((f"{_NOTHING if measured is None else f'{measured:.1f}':>7}", "yellow" if is_off else ""))
    line.append(f" of {wanted} Hz" if wanted else " Hz")
    for name, count in counts.items():
        line.append(f"   {name} {count}", "yellow" if count and name != "executed" else "")
    return line


def _spread(spread: Spread | None) -> Text:
    values = (None, None, None) if spread is None else (spread.p50, spread.p99, spread.max)
    return Text(
        "   ".join(f"{name} {duration(one):>7}" for name, one in zip(("p50", "p99", "max"), values, strict=True))
    )


def _alive(state: MonitorState) -> Text:
    line = Text()
    for name in HEARTBEATS:
        age = state.alive.get(name)
        late = age is not None and age > _LATE_S and state.phase != "STARTING"
        style = "bold red" if late and age is not None and age > _SILENT_S else "yellow" if late else ""
        line.append(f"{name} ").append(f"{duration(age)}  ", style)
    return line


def _number(value: float | None) -> str:
    # What rounds to nothing has no sign.
    return f"{_NOTHING:>11}" if value is None else f"{round(value, 4) + 0.0:>11.4f}"


def unit(name: str) -> str:
    """Return the unit of a command by its name."""
    part, _, kind = name.rpartition(".")
    length = "m" if part in ("x", "y", "z", "gripper") else "rad"
    return {"pos": length, "vel": f"{length}/s"}.get(kind, "")


def _counts(counts: dict[str, Count]) -> Text:
    line = Text()
    for name, one in sorted(counts.items(), key=lambda item: -item[1].count):
        if one.count:
            now = f" ({one.per_second:.1f}/s)" if one.per_second is not None else ""
            line.append(f"{name.lower().replace('_', ' ')} {one.count}{now}   ", "yellow" if one.per_second else "")
    return line or Text("none")


def duration(seconds: float | None) -> str:
    """Return a time with three digits and its unit, at most 7 characters."""
    if seconds is None:
        return _NOTHING
    for factor, name in ((1e6, "µs"), (1e3, "ms"), (1.0, "s")):
        value = seconds * factor
        if value < 999.5 or name == "s":
            digits = 0 if value >= 99.95 or name == "µs" else 1 if value >= 9.995 else 2
            return f"{value:.{digits}f} {name}"
    return _NOTHING


def one_line(state: MonitorState) -> str:
    """Return the most important as one line, for a log."""
    late = state.lateness
    parts = [
        f"{state.id} {state.mode or 'UNKNOWN'} {state.phase.lower()}",
        f"control {_NOTHING if state.control_rate is None else f'{state.control_rate:.1f}'} of {state.control_hz} Hz",
        f"lateness p99 {duration(late.p99 if late else None)} max {duration(late.max if late else None)}",
        f"skipped {state.skipped}, overruns {state.overruns}, drops {state.recorder_drops}",
        f"limits {sum(counter.count for counter in state.limits.values())}, refused {sum(state.refusals.values())}",
    ]
    return "; ".join(parts)
