"""One program at a time on one robot of this machine."""

import fcntl
import hashlib
import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any, Self

import draccus

from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.options.dotted import flattened

_PLACE = re.compile(r"(^|_)(port|ip|host|address|url)(_|$)")  # options that say where a robot is connected


class RobotLock:
    """Held while a program uses a robot; the system frees it when the program ends, however it does.

    A robot of which nothing says where it is is not locked.

    Args:
        config: the robot's configuration: where it is connected says which robot it is, whatever it is called; where
            only a number says that, or nothing, type and id do, too.

    Raises:
        RealtimeError: another program uses it.
    """

    def __init__(self, config: Any) -> None:
        self._file, self._pid = -1, os.getpid()
        places = {
            key: os.path.realpath(value) if str(value).startswith("/") else value
            for key, value in flattened(draccus.encode(config)).items()
            if value and _PLACE.search(key.rpartition(".")[2]) and not key.startswith("cameras.")
        }
        if not any(isinstance(value, str) for value in places.values()):
            if not (places or config.id):
                return  # nothing says which robot it is
            places |= {"type": config.type, "id": config.id}
        name = hashlib.sha256(json.dumps(places, sort_keys=True, default=str).encode()).hexdigest()[:16]
        self._path = Path(tempfile.gettempdir()) / f"bhd-robot-{os.getuid()}-{name}.lock"
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.read(self._file, 32).decode() or "unknown"
            os.close(self._file)
            shown = ", ".join(f"{key} {value}" for key, value in places.items() if value)
            other = ", or say which robot this is with --robot.id" if "id" in places else ""
            raise RealtimeError(
                f"The robot {config.type} ({shown}) is used by process {owner}. End that one first{other}."
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
            if self._pid == os.getpid():
                fcntl.flock(self._file, fcntl.LOCK_UN)  # which a process has, too, that was forked since
            os.close(self._file)
            self._file = -1
