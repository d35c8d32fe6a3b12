"""One program at a time on one robot of this machine."""

import fcntl
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any, Self

import draccus

from bhd_lerobot.errors import RealtimeError


class RobotLock:
    """Held while a program uses a robot; the system frees it when the program ends, however it does.

    A robot of which nothing says where it is is not locked.

    Args:
        config: the robot's configuration: type, id and where it is connected say which robot it is.

    Raises:
        RealtimeError: another program uses it.
    """

    def __init__(self, config: Any) -> None:
        self._file = -1
        where = ("id", "ip", "host", "address")
        places = {key: value for key, value in draccus.encode(config).items() if "port" in key or key in where}
        if not any(places.values()):
            return  # nothing says which robot it is
        name = hashlib.sha256(json.dumps([config.type, places], sort_keys=True, default=str).encode()).hexdigest()[:16]
        self._path = Path(tempfile.gettempdir()) / f"bhd-robot-{os.getuid()}-{name}.lock"
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.read(self._file, 32).decode() or "unknown"
            os.close(self._file)
            shown = ", ".join(f"{key} {value}" for key, value in places.items() if value)
            raise RealtimeError(
                f"The robot {config.type} ({shown or 'no id'}) is used by process {owner}. End that one first, or say "
                "which robot this is with --robot.id."
            ) from error
        os.truncate(self._file, 0)
        os.pwrite(self._file, str(os.getpid()).encode(), 0)

    def __enter__(self) -> Self:
        """Return the lock itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Let go of the robot."""
        self.close()

    def close(self) -> None:
        """Let go of the robot. May be called twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
