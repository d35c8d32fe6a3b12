"""What `bhd-data push` and `bhd-data pull` share: places, commands to repeat, and an end that comes at once."""

import json
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

from bhd_lerobot.errors import ConfigError

PATIENCE_S = 3.0
"""How long the threads of a transfer may take to end after Ctrl-C [s]; a stalled connection holds them for minutes."""


def command_line(command: str, places: Sequence[object], **options: Any) -> str:
    """Return a command as the user would type it; options that are None, false or empty are left out."""
    words = ["bhd-data", command, *(str(place) for place in places)]
    for name, value in options.items():
        if value is True:
            words.append(f"--{name}")
        elif value not in (None, False, "", []):
            words.append(f"--{name}={','.join(map(str, value)) if isinstance(value, list) else value}")
    return shlex.join(words)


def storage_options(text: str | None) -> dict[str, Any]:
    """Return the options of a file system.

    Raises:
        ConfigError: they are no JSON object.
    """
    if text is None:
        return {}
    try:
        options = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"--storage_options is {text!r}, which is not JSON: {error}.") from error
    if not isinstance(options, dict):
        raise ConfigError(f"--storage_options is {text!r}; give a JSON object, such as '{{\"anon\": true}}'.")
    return options


def split_list(text: str | None) -> list[str]:
    """Return what stands between commas."""
    return [one.strip() for one in (text or "").split(",") if one.strip()]


@contextmanager
def prompt_interrupt(stopped: str) -> Iterator[None]:
    """Let Ctrl-C end the program within `PATIENCE_S`.

    The Hub's client waits for its threads, and these for the network. What a transfer leaves is in order at any moment,
    so that the process may end at any.

    Args:
        stopped: what is left, and how to go on; told if the process ends here. Whoever catches the `KeyboardInterrupt`
            tells it otherwise.
    """
    is_hosted = hasattr(sys, "ps1") or "ipykernel" in sys.modules  # by a shell or a notebook, which goes on
    if is_hosted or threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.getsignal(signal.SIGINT)
    timer: threading.Timer | None = None

    def leave() -> None:
        print(f"\nStopped; {stopped}.", file=sys.stderr, flush=True)
        os._exit(130)

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal timer
        signal.signal(signal.SIGINT, former)
        timer = threading.Timer(PATIENCE_S, leave)
        timer.daemon = True
        timer.start()
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
        if timer is not None:
            timer.cancel()  # all threads have ended


def quiet_bars() -> None:
    """Leave the client's progress bars to terminals."""
    if not sys.stderr.isatty():
        from huggingface_hub.utils import disable_progress_bars

        disable_progress_bars()
