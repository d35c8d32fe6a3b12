"""The environment with the real ROS 2 client library, and processes in it to test against.

It is made once per version of the files that describe it, in .ros/ of this checkout. It is never the tests'
own: every start of Python in it sets LD_LIBRARY_PATH and executes itself again. ``BHD_ROS=jazzy`` takes the one of
another distribution.
"""

import contextlib
import fcntl
import functools
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import pytest

from tests.requirements import not_tested
from tests.waiting import until

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
CACHE = ROOT / ".ros"
DISTRIBUTION = os.environ.get("BHD_ROS", "kilted")
MESSAGES = {
    "bhd_interfaces": ROOT / "bhd_lerobot/ros2/messages",
    "tf2_msgs": HERE / "messages/tf2_msgs",
    "ur_dashboard_msgs": HERE / "messages/ur_dashboard_msgs",
}
BUNDLES = ("/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt", "/etc/ssl/cert.pem")


class UnavailableError(Exception):
    """ROS 2 or the type support of a message package cannot be had on this machine; says why."""


@dataclass(frozen=True)
class RosEnvironment:
    """A Python with rclpy, and the folder of our message packages where they could be compiled."""

    python: Path
    messages: Path | None
    why_no_messages: str = ""

    def variables(self, domain: int) -> dict[str, str]:
        """Return a process's environment variables: those of this one without ROS's and Python's, and its domain."""
        foreign = ("ROS_", "RMW_", "RCUTILS_", "AMENT_", "FASTDDS_", "FASTRTPS_", "CYCLONEDDS_", "_ROS_", "PYTHON")
        kept = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(foreign) and name not in ("LD_LIBRARY_PATH", "VIRTUAL_ENV")
        }
        own = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}
        if self.messages is not None:
            own |= {"PYTHONPATH": str(self.messages), "LD_LIBRARY_PATH": str(self.messages / "lib")}
        return kept | own


@functools.cache
def _environment() -> RosEnvironment | UnavailableError:
    """Make or find an environment; what went wrong is kept, so that it is tried once in a process."""
    requirements = HERE / f"requirements-{DISTRIBUTION}.txt"
    builder = HERE / "build_messages.py"
    try:
        home = _made(DISTRIBUTION, [requirements], lambda folder: _install(requirements, folder))
    except UnavailableError as error:
        return error
    python = home / "bin/python"
    sources = [path for package in MESSAGES.values() for path in sorted(package.rglob("*.msg"))]
    command = [python, builder, *(f"{name}={folder}" for name, folder in MESSAGES.items())]
    try:
        messages = _made(
            f"{DISTRIBUTION}-messages",
            [requirements, builder, *sources],
            lambda folder: _run([*command[:2], folder, *command[2:]], RosEnvironment(python, None).variables(0)),
        )
    except UnavailableError as error:
        return RosEnvironment(python, None, str(error))
    return RosEnvironment(python, messages)


def _made(name: str, sources: list[Path], make: Callable[[Path], None]) -> Path:
    """Return the folder of a name that was made from these sources, making it first where there is none.

    It appears complete or not at all; who asks meanwhile, waits. Those of older sources are removed.
    """
    key = hashlib.sha256(f"{sys.version_info[:2]}".encode() + b"".join(path.read_bytes() for path in sources))
    folder = CACHE / f"{name}-{key.hexdigest()[:12]}"
    CACHE.mkdir(exist_ok=True)
    with (CACHE / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            for old in CACHE.glob(f"{name}-{'[0-9a-f]' * 12}*"):
                shutil.rmtree(old)
            unfinished = folder.with_suffix(".new")
            make(unfinished)
            unfinished.rename(folder)
    return folder


def _install(requirements: Path, folder: Path) -> None:
    variables = dict(os.environ)
    if any(Path(bundle).exists() for bundle in BUNDLES):  # see scripts/bootstrap.sh
        variables = {"UV_SYSTEM_CERTS": "true", "UV_NATIVE_TLS": "true"} | variables
    uv = _run([ROOT / "scripts/bootstrap.sh", "--print-uv"], variables).strip()
    _run([uv, "venv", "--quiet", "--no-project", "--python", sys.executable, folder], variables)
    pip = [uv, "pip", "install", "--quiet", "--python", folder / "bin/python", "--requirements", requirements]
    _run(pip, variables)


def _run(command: list[str | Path], variables: dict[str, str]) -> str:
    done = subprocess.run(
        [str(part) for part in command],
        env=variables,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise UnavailableError(f"{' '.join(map(str, command[:3]))} ended with {done.returncode}: {done.stderr[-1500:]}")
    return done.stdout


def environment(*, messages: bool = False) -> RosEnvironment:
    """Return the environment; where there is none, skip the test, or fail it in CI.

    With `messages`, the type support of our own messages must be there, too.
    """
    found = _environment()
    reason = ""
    if isinstance(found, UnavailableError):
        reason = f"no ROS 2 {DISTRIBUTION} could be installed into {CACHE.name}: {found}"
    elif messages and found.messages is None:
        reason = f"no type support of bhd_interfaces for ROS 2 {DISTRIBUTION}: {found.why_no_messages}"
    if reason:
        not_tested(f"our side of ROS 2 against its own client library; {reason}")
    assert isinstance(found, RosEnvironment)
    return found


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """Reserve a ROS domain that no other test on this machine uses; above 101 the ports are other programs'."""
    for domain in range(1, 102):
        with socket.socket(socket.AF_UNIX) as name:  # a name is of the machine, wherever its temporary files are
            try:
                name.bind(f"\0bhd-ros-domain-{domain}")
            except OSError:
                continue
            yield domain
            return
    pytest.fail("all ROS domains from 1 to 101 are in use")


class Peer:
    """A script of peers/ in an environment with rclpy, running from `with` to its end.

    It prints one JSON object a line, the first of them {"event": "ready"}; `lines` holds those that have come.
    """

    def __init__(self, script: str, *options: object, domain: int) -> None:
        self.name = script
        self.options = [str(option) for option in options]
        self.domain = domain
        self.environment = environment()
        self.lines: list[dict[str, Any]] = []
        self.process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self._errors = tempfile.TemporaryFile("w+")
        self._logs = tempfile.TemporaryDirectory(prefix="bhd-ros-log-")
        own = {"BHD_PARENT": str(os.getpid()), "ROS_LOG_DIR": self._logs.name}
        self.process = subprocess.Popen(
            [self.environment.python, HERE / "peers" / self.name, *self.options],
            env=self.environment.variables(self.domain) | own,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        assert self.process.stdout is not None
        self._reader = threading.Thread(target=self._read, args=(self.process.stdout,), daemon=True)
        self._reader.start()
        return self

    def _read(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                self.lines.append(json.loads(line))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.stop()
        if error is not None:
            error.add_note(f"{self.name} {' '.join(self.options)} printed at last {self.lines[-3:]}, {self.errors()}")
        self._errors.close()
        self._logs.cleanup()

    def errors(self) -> str:
        """Return the end of what the process wrote to its standard error."""
        self._errors.seek(0)
        return self._errors.read()[-3000:]

    def wait(self, condition: Callable[[dict[str, Any]], Any] = bool, what: str = "") -> dict[str, Any]:
        """Wait for a line for which a condition holds, by default any, and return it."""

        def line_or_end() -> dict[str, Any] | None:
            ended = not self._reader.is_alive()
            for line in self.lines:
                if condition(line):
                    return line
            assert not ended, f"{self.name} ended with {self._process().wait()}: {self.errors()}"
            return None

        line: dict[str, Any] = until(line_or_end, f"{self.name} prints {what or 'a line'}")
        return line

    def wait_event(self, event: str) -> dict[str, Any]:
        """Wait for a line with this event, and return it."""
        return self.wait(lambda line: line.get("event") == event, event)

    def events(self, event: str) -> list[dict[str, Any]]:
        """Return the lines with this event so far."""
        return [line for line in self.lines if line.get("event") == event]

    def signal(self, number: int) -> None:
        """Send the process a signal."""
        self._process().send_signal(number)

    def stop(self, seconds: float = 20) -> int:
        """End the process by SIGINT, by SIGKILL where that does not end it, and return its exit status."""
        process = self._process()
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
        self._reader.join()
        return process.wait()

    def _process(self) -> subprocess.Popen[str]:
        assert self.process is not None, "`with Peer(…)` starts it"
        return self.process
