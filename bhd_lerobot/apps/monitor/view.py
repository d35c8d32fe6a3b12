"""The display of `bhd-monitor`: from a state to text. Pure: the same state gives the same image.

Everything has its place and a fixed width, so that nothing jumps when numbers change. 80 columns and 24 lines hold all.
"""

from collections.abc import Sequence

from rich.console import Group
from rich.text import Text

from bhd_lerobot.apps.monitor.state import CELLS, DECADES, HEARTBEATS, Count, Dimension, MonitorState, Spread

WIDTH = 80
KEYS = "e or space: emergency stop   q: quit"

_LABEL = 11
_BARS = " ▁▂▃▄▅▆▇█"
_MODES = {
    "HOLD": "black on green",
    "TRACKING": "black on cyan",
    "STOPPING": "black on yellow",
    "ESTOP": "bold white on red",
    "FAULT": "bold white on red",
}
_LATE_S = 0.1  # a process without a sign of life for so long is highlighted
_SILENT_S = 0.5
_UNITS = {"x.vel": "m/s", "y.vel": "m/s", "z.vel": "m/s", "gripper.pos": "m", "gripper.vel": "m/s"}
_UNITS |= {"x.pos": "m", "y.pos": "m", "z.pos": "m"}
_NOTHING = "–"


def render(state: MonitorState, *, height: int | None = None, message: str = "", keys: str = KEYS) -> Group:
    """Return the image of a state.

    Args:
        state: what is shown.
        height: lines that there are; sections are set apart if there is room. All that is needed if None.
        message: shown instead of the keys.
        keys: the last line; there is none if empty.
    """
    sections = [
        ("", [_title(state), _mode(state)]),
        ("rates", _rates(state)),
        ("timing of the episode's ticks", _timing(state)),
        ("queues and processes", [_queues(state), _alive(state)]),
        ("command", [*_command(state), *_goal(state), *_pose(state)]),
        ("interventions", _interventions(state)),
    ]
    lines = [line for _, section in sections for line in section]
    if height is not None and len(lines) + 2 * len(sections) <= height:
        lines = []
        for name, section in sections:
            lines += [Text(), Text(f"── {name} " + "─" * (WIDTH - 4 - len(name)), "dim")] if name else []
            lines += section
        lines.append(Text())
    last = [Text(f" {message or keys}", "bold yellow" if message else "dim")] if message or keys else []
    if height is not None:
        lines = lines[: max(0, height - len(last))]
    lines += last
    for line in lines:
        line.no_wrap, line.overflow = True, "ellipsis"
        line.truncate(WIDTH, overflow="ellipsis")
    return Group(*lines)


def _title(state: MonitorState) -> Text:
    line = Text.assemble((f" {state.id}", "bold"), f"  {state.robot}, {state.clock} clock")
    minutes, seconds = divmod(int(state.uptime), 60)
    hours, minutes = divmod(minutes, 60)
    right = f"up {hours}:{minutes:02d}:{seconds:02d}"
    line.truncate(WIDTH - len(right) - 2, overflow="ellipsis")
    line.pad_right(WIDTH - len(right) - line.cell_len)
    return line.append(right)


def _mode(state: MonitorState) -> Text:
    mode = state.mode or "UNKNOWN"
    line = Text.assemble(" ", (f" {mode:<12} ", _MODES.get(mode, "black on white")), f"  loop {state.phase.lower():<9}")
    time = _NOTHING if state.episode_time is None else f"{state.episode_time:.1f} s"
    line.append(f"episode {state.episode:<4d} {time:>9}  ")
    silent = state.alive.get("cerebellum")
    if state.phase == "RUNNING" and silent is not None and silent > _SILENT_S:
        line.append(f"cerebellum silent {min(silent, 999):3.0f} s", "bold white on red")
    elif state.estop and not state.estop_latched:
        line.append("e-stop not latched yet", "bold white on red")
    elif state.estop_latched:
        line.append("emergency stop latched", "bold red")
    return line


def _rates(state: MonitorState) -> list[Text]:
    def rate(label: str, measured: float | None, wanted: float | None, off: float) -> Text:
        text = Text(f" {label:<{_LABEL}}")
        style = "yellow" if measured is not None and wanted and abs(measured - wanted) > off * wanted else ""
        text.append(f"{_NOTHING if measured is None else f'{measured:.1f}':>7}", style)
        return text.append(f" of {wanted:>4.0f} Hz" if wanted else " Hz        ")

    def count(label: str, number: int, width: int = 12) -> tuple[str, str]:
        return f"   {label:<{width}}{number:>{21 - width}}", "yellow" if number else ""

    control = rate("control", state.control_rate, state.control_hz, 0.01)
    control.append(f"   {'executed':<12}{state.executed:>9}").append(*count("overruns", state.overruns, 14))
    frames = rate("frames", state.frame_rate, state.fps, 0.15)
    frames.append(*count("skipped", state.skipped)).append(*count("recorder drops", state.recorder_drops, 14))
    commands = rate("commands", state.command_rate, None, 0.0).append(*count("world behind", state.catch_up_lost))
    return [control, frames, commands]


def _timing(state: MonitorState) -> list[Text]:
    axis = "".join(f"{mark:<{CELLS}}" for mark in ("1µs", "10µs", ".1ms", "1ms", "10ms", ".1s"))
    head = Text(f" {'':<{_LABEL}}{'p50':>9}{'p99':>9}{'max':>9}    {axis}", "dim")
    return [head, _spread("lateness", state.lateness), _spread("tick takes", state.duration)]


def _spread(label: str, spread: Spread | None) -> Text:
    values = [None] * 3 if spread is None else [spread.p50, spread.p99, spread.max]
    line = Text(f" {label:<{_LABEL}}" + "".join(f"{duration(value):>9}" for value in values) + "    ")
    return line.append(bars((0,) * DECADES * CELLS if spread is None else spread.histogram), "cyan")


def bars(histogram: Sequence[int]) -> str:
    """Return a histogram as a line of bars, whose heights are logarithmic: one tick in a million is visible."""
    most = max(histogram, default=0)
    if most < 1:
        return " " * len(histogram)
    steps = len(_BARS) - 2
    heights = [round(steps * (n.bit_length() - 1) / max(1, most.bit_length() - 1)) for n in histogram]
    return "".join(_BARS[1 + height if n else 0] for n, height in zip(histogram, heights, strict=True))


def _queues(state: MonitorState) -> Text:
    line = Text(f" {'queue':<{_LABEL}}")
    full = state.fifo_fill >= state.fifo_capacity
    line.append(f"{state.fifo_fill:>4}", "bold red" if full else "").append(f" of {state.fifo_capacity:<5}")
    line.append(f"  command age {duration(state.command_age):>8}")
    return line.append(f"   observation age {duration(state.observation_age):>8}")


def _alive(state: MonitorState) -> Text:
    line = Text(f" {'last signs':<{_LABEL}}")
    for name in HEARTBEATS:
        age = state.alive.get(name)
        late = age is not None and age > _LATE_S and state.phase != "STARTING"
        style = "bold red" if late and age is not None and age > _SILENT_S else "yellow" if late else ""
        line.append(f"{name} ").append(f"{duration(age):<8}", style)
    return line


def _command(state: MonitorState) -> list[Text]:
    width = max((len(dimension.name) for dimension in state.dimensions), default=0)
    width = min(max(width, _LABEL), 24)
    head = f" {'':<{width}}{'requested':>11}{'applied':>11}{'measured':>11}"
    return [Text(head, "dim"), *(_dimension(dimension, width) for dimension in state.dimensions)]


def _dimension(dimension: Dimension, width: int) -> Text:
    def number(value: float | None) -> str:
        # What rounds to nothing has no sign.
        return f"{_NOTHING:>11}" if value is None else f"{round(value, 4) + 0.0:>11.4f}"

    limited = dimension.requested is not None and abs(dimension.requested - dimension.applied) > 1e-3
    line = Text(f" {dimension.name[:width]:<{width}}{number(dimension.requested)}")
    line.append(number(dimension.applied), "yellow" if limited else "")
    return line.append(f"{number(dimension.measured)} {unit(dimension.name)}")


def unit(name: str) -> str:
    """Return the unit of a command by its name."""
    return _UNITS.get(name) or ("rad/s" if name.endswith(".vel") else "rad" if name.endswith(".pos") else "")


def _goal(state: MonitorState) -> list[Text]:
    if state.goal is None:
        # An arm keeps the line, so that nothing moves when a goal begins; what drives takes no goals.
        return [] if state.pose else [Text(f" {'goal':<{_LABEL}}{_NOTHING}")]
    goal = state.goal
    done = min(max(goal["progress"], 0.0), 1.0)
    bar = "█" * round(20 * done) + "░" * (20 - round(20 * done))
    line = Text(f" {'goal':<{_LABEL}}{goal['task_id'][:16]:<16} {goal['phase'].lower():<10}")
    return [line.append(bar, "green").append(f" {100 * done:3.0f} %, {max(0.0, goal['remaining_s']):5.1f} s left")]


def _pose(state: MonitorState) -> list[Text]:
    if not state.pose:
        return []
    x, y, yaw = (state.pose[key] for key in ("x", "y", "yaw"))
    return [Text(f" {'odometry':<{_LABEL}}x {x:>8.3f} m   y {y:>8.3f} m   yaw {yaw:>7.3f} rad")]


def _interventions(state: MonitorState) -> list[Text]:
    return [
        _counts("limits", state.limits),
        _counts("watchdogs", {name: counter for name, counter in state.watchdogs.items() if counter.count}),
        _counts("refused", {name: Count(n, None) for name, n in state.refusals.items()}),
    ]


def _counts(label: str, counts: dict[str, Count]) -> Text:
    line = Text(f" {label:<{_LABEL}}")
    raised = {name: counter for name, counter in counts.items() if counter.count}
    if not raised:
        return line.append("none")
    for name, counter in sorted(raised.items(), key=lambda item: -item[1].count):
        now = f" ({counter.per_second:.1f}/s)" if counter.per_second is not None else ""
        line.append(f"{name.lower().replace('_', ' ')} {counter.count}{now}   ", "yellow" if counter.per_second else "")
    return line


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
