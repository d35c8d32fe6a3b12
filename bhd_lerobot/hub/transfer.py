"""What `bhd-data push` and `bhd-data pull` share: places, commands to repeat, and an end that comes at once."""

import argparse
import contextlib
import json
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from bhd_lerobot.datasets.remote.place import is_url
from bhd_lerobot.errors import ConfigError

if TYPE_CHECKING:
    from bhd_lerobot.datasets.remote.store import Remote

PATIENCE_S = 3.0
"""How long the threads of a transfer may take to end after Ctrl-C [s]; a stalled connection holds them for minutes."""


def again_line(options: argparse.Namespace) -> str:
    """Return the command that was given, to repeat it."""
    return shlex.join(["bhd-data", *options.given])


def refuse_empty(options: argparse.Namespace) -> None:
    """Refuse an option without a value: it is a variable of the shell that was not set, more often than a wish."""
    for name, value in vars(options).items():
        if value == "" or (isinstance(value, list) and "" in value):
            what = f"--{name}" if name not in ("places", "source") else "A name"
            raise ConfigError(f"{what} is empty. Give a value, or leave it out.")


def folder_of(text: str) -> Path:
    """Return the folder that is meant."""
    try:
        folder = Path(text).expanduser()
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            folder.stat()
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        shown = text if len(text) < 200 else f"{text[:100]}... ({len(text)} characters)"
        raise ConfigError(f"{shown!r} cannot be the folder of a dataset: {reason}. Name another one.") from error
    return folder


def warn_of_folder(name: str, root: Path) -> None:
    """Warn that a name is one on the Hub if it could also be a folder here, other than that of the dataset."""
    folder = Path(name).absolute()
    if folder.parent.is_dir() and folder != root.absolute():
        print(f"{name} is taken for a name on the Hub. The folder here would be file://{folder}", file=sys.stderr)


def remote_of(place: str, storage: str | None, **options: Any) -> "Remote":
    """Return a place that a dataset is copied to or from."""
    from bhd_lerobot.datasets.remote.hub import HubDataset
    from bhd_lerobot.datasets.remote.store import StoreDataset

    if not is_url(place):
        if storage is not None:
            raise ConfigError("--storage_options is for URLs, not for the Hub.")
        return HubDataset(place, **options)
    try:
        found = json.loads(storage or "{}")
    except ValueError as error:
        raise ConfigError(f"--storage_options is {storage!r}, which is not JSON: {error}.") from error
    if not isinstance(found, dict):
        raise ConfigError(f"--storage_options is {storage!r}; give a JSON object, such as '{{\"anon\": true}}'.")
    return StoreDataset(place, found)


def split_list(text: str | None) -> list[str]:
    """Return what stands between commas."""
    return [one.strip() for one in (text or "").split(",") if one.strip()]


@contextmanager
def prompt_interrupt(stopped: str) -> Iterator[None]:
    """Let Ctrl-C end the program within `PATIENCE_S`.

    The Hub's client waits for its threads, and these for the network. What a transfer leaves is in order at any moment,
    so that the process may end at any.

    Args:
        stopped: what is left, and how to continue; printed if the process ends here, else by the code that
            catches the `KeyboardInterrupt`.
    """
    is_hosted = hasattr(sys, "ps1") or "ipykernel" in sys.modules  # by a shell or a notebook, which continues
    if is_hosted or threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.getsignal(signal.SIGINT)
    timer: threading.Timer | None = None
    is_caught = False

    def leave() -> None:
        if not is_caught:
            print(f"\nStopped; {stopped}", file=sys.stderr)
        sys.stderr.flush()
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
        is_caught = True
        # A thread that still waits for the network would keep the interpreter from ending.
        if timer is not None and not _working_threads():
            timer.cancel()


def _working_threads() -> list[threading.Thread]:
    """Return the threads that the interpreter waits for at its end."""
    return [one for one in threading.enumerate() if not one.daemon and one is not threading.main_thread()]


def quiet_bars() -> None:
    """Leave the client's progress bars to terminals."""
    if not sys.stderr.isatty():
        from huggingface_hub.utils import disable_progress_bars

        disable_progress_bars()
