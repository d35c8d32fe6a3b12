"""`bhd-monitor`: watch a robot that runs on the wall clock, from another terminal, and stop it."""

import argparse
import json
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live

from bhd_lerobot.apps.monitor.state import MonitorState, Sampler
from bhd_lerobot.apps.monitor.view import KEYS, WIDTH, one_line, render
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.options.declared import Positive, check_option
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.realtime.estop import KEYS as ESTOP_KEYS
from bhd_lerobot.realtime.keys import KeySource, key_source
from bhd_lerobot.realtime.shared_memory import names

PORT = 8767
"""Of the page, by default."""
_REFRESH_S = 0.125
_SNAPSHOT_S = 0.5  # that a single snapshot measures rates over
_LINE_S = 1.0  # between two lines where there is no terminal


def running(wanted: str | None = None) -> list[LiveBlock]:
    """Return the robots that run, to be closed by the caller; raise if the one that is wanted cannot be read."""
    found = []
    for name in names():
        try:
            block = LiveBlock.watch(name)
        except RealtimeError:  # gone in the meantime, or of another version
            if name == wanted:
                raise
            continue
        if "made_ns" in block.about and "commands" in block.about:
            found.append(block)
        else:
            block.close()
    return found


def find(name: str | None) -> LiveBlock:
    """Return the block of the robot with this id, or of the only one that runs if None; or raise a `RealtimeError`."""
    blocks = running(name)
    chosen = [block for block in blocks if name in (None, block.name)]
    for block in blocks:
        if len(chosen) != 1 or block is not chosen[0]:
            block.close()
    if len(chosen) == 1:
        return chosen[0]
    listed = ", ".join(f"{block.name} ({block.about['robot']})" for block in blocks) or "none"
    if not blocks:
        what = "No robot runs on the wall clock" if name is None else f"No running robot is called {name!r}"
        raise RealtimeError(f"{what}. Running: none. Start one with --robot.clock=realtime and --robot.id=NAME.")
    if name is None:
        raise RealtimeError(f"Several robots run: {listed}. Choose one: bhd-monitor ID.")
    raise RealtimeError(f"No running robot is called {name!r}. Running: {listed}.")


class Keys:
    """Keys of a terminal, on a thread of their own: a stop does not wait for an image that is being drawn.

    `quit` is set when the user wants to leave; `pressed` counts the emergency stops.
    """

    def __init__(self, estop: Callable[[], None], source: KeySource | None) -> None:
        self.quit = threading.Event()
        self.pressed = 0
        self._estop = estop
        self._source = source

    @property
    def there(self) -> bool:
        """Whether there is a terminal to press keys in."""
        return self._source is not None

    def _on_keys(self, keys: bytes) -> None:
        if any(key in keys for key in ESTOP_KEYS):
            self._estop()
            self.pressed += 1
        if not keys or any(key in b"qQ\x04" for key in keys):
            self.quit.set()

    def __enter__(self) -> Self:
        """Take the terminal."""
        if self._source is not None:
            self._source.subscribe(self._on_keys)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the terminal back."""
        if self._source is not None:
            self._source.unsubscribe(self._on_keys)


def watch(
    sampler: Sampler, show: Callable[[MonitorState], None], keys: Keys, period_s: float, end: float
) -> str | None:
    """Show states until the user leaves, the time [s] is up, or the robot ends; return as text how it did."""
    while True:
        ended = sampler.end()
        show(sampler.sample())
        if ended is not None:
            return ended
        left = end - time.monotonic()
        if left <= 0 or keys.quit.wait(min(period_s, left)):
            return None


def _live(block: LiveBlock, sampler: Sampler, console: Console, end: float, address: str) -> str | None:
    with Keys(block.set_estop, key_source()) as keys:
        offered = KEYS if keys.there else "No keys: standard input is no terminal. Ctrl-C: quit"
        offered += f"   3-D: {address}" if address else ""
        with Live(console=console, screen=True, auto_refresh=False) as live:

            def show(state: MonitorState) -> None:
                message = "EMERGENCY STOP was set here   q: quit" if keys.pressed and state.estop else ""
                live.update(render(state, height=console.height, message=message, keys=offered), refresh=True)

            return watch(sampler, show, keys, _REFRESH_S, end)


def _print(block: LiveBlock, sampler: Sampler, options: argparse.Namespace, console: Console) -> str | None:
    once = options.once or (options.json and options.seconds is None)
    if once and sampler.end() is None:
        sampler.sample()
        time.sleep(_SNAPSHOT_S)
        state = sampler.sample()
        if options.json:
            print(json.dumps(state.as_dict(), indent=1, ensure_ascii=False))
        else:
            console.print(render(state, keys=""))
        return None

    def show(state: MonitorState) -> None:
        print(json.dumps(state.as_dict(), ensure_ascii=False) if options.json else one_line(state), flush=True)

    with Keys(block.set_estop, None) as keys:
        return watch(sampler, show, keys, _LINE_S, _end(options.seconds))


def _end(seconds: float | None) -> float:
    return time.monotonic() + seconds if seconds is not None else math.inf


@contextmanager
def _page(block: LiveBlock, options: argparse.Namespace) -> Iterator[str]:
    from bhd_lerobot.apps.monitor.page import served  # with kinematics and a web server
    from bhd_lerobot.apps.view.server import open_browser

    with served(block, options.port) as address:
        print(f"{block.name} in 3-D: {address}", file=sys.stderr, flush=True)
        if not options.no_browser:
            open_browser(address)
        yield address


def monitor(options: argparse.Namespace) -> int:
    """Watch a robot as the options ask; return the exit status."""
    console = Console(highlight=False)
    check_option("--seconds", options.seconds, Positive)
    if options.in_3d and (options.once or (options.json and options.seconds is None)):
        raise ConfigError("--3d serves a page for as long as the robot is watched; leave --once and --json out.")
    with ExitStack() as opened:
        block = find(options.id)
        opened.callback(block.close)
        address = opened.enter_context(_page(block, options)) if options.in_3d else ""
        sampler = Sampler(block)
        if console.is_terminal and not (options.once or options.json):
            ended = _live(block, sampler, console, _end(options.seconds), address)
        else:
            console = console if console.is_terminal else Console(highlight=False, width=WIDTH)
            ended = _print(block, sampler, options, console)
    if ended is None:
        return 0
    print(f"The robot {block.name!r} {'has ended.' if ended == 'ended' else f'{ended}.'}", file=sys.stderr)
    return 0 if ended == "ended" else 1
