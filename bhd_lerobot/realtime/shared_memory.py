"""A named block of memory that several processes share and that does not outlive them.

It is a file in the memory file system. Every process that uses it holds a shared lock on it, which the kernel releases
however the process ends: a block that no process holds is garbage, and `sweep` removes it. Nothing else is needed to
clean up after SIGKILL, and no process number is ever trusted.

Every user can write to the folder. A file's name has a random part, so that no other file can take it; only this
user can open it; and what is not a plain file of this user is neither read nor removed, whatever it is called.
"""

import contextlib
import errno
import fcntl
import json
import mmap
import os
import platform
import random
import re
import secrets
import stat
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from bhd_lerobot.control.kernels import fence
from bhd_lerobot.errors import ConfigError, RealtimeError

FOLDER = Path("/dev/shm")
PREFIX = "bhd-"
_FILE = re.compile(rf"{PREFIX}(?P<name>[\w.-]{{1,100}})\.[0-9a-f]{{16}}")
_TRIES = 8  # to make a block of a name that another process is seen to hold
_MAGIC = b"bhd-blk1"
_ALIGNMENT = 64  # a cache line: no two sections share one
_CHECK_S = 0.002  # it takes much less to find out whether a process holds a block
_HEADER = 4096  # bytes for the description; it grows in pages
_MACHINES = ("x86_64", "amd64", "aarch64", "arm64")  # an aligned store of 64 bits is seen whole


def check_platform(machine: str | None = None, system: str | None = None) -> None:
    """Raise if processes cannot share memory here as this package does."""
    machine, system = machine or platform.machine(), system or platform.system()
    if system != "Linux":
        raise RealtimeError(f"clock = 'realtime' needs Linux; this is {system}. Use clock = 'lockstep'.")
    if machine.lower() not in _MACHINES:
        raise RealtimeError(
            f"clock = 'realtime' needs a 64-bit x86 or ARM processor ({', '.join(_MACHINES)}); this is {machine}. Use "
            "clock = 'lockstep'."
        )


class SharedBlock:
    """One block: sections of bytes, and a description of them as JSON.

    Attributes:
        name: its name, unique among the blocks of this user.
        about: the description that its maker gave.

    Use `create` or `attach`, and `close` when done.
    """

    def __init__(self, path: Path, descriptor: int, memory: mmap.mmap, sections: dict[str, tuple[int, int]]) -> None:
        self.name, self._path = _name(path), path
        self.about: dict[str, Any] = {}
        self._descriptor, self._memory, self._sections = descriptor, memory, sections
        self._pid = os.getpid()
        self._views: list[memoryview] = []

    @classmethod
    def create(cls, name: str, sections: Mapping[str, int], about: Mapping[str, Any]) -> Self:
        """Make a block, all zeros.

        Args:
            name: letters, digits, ``_``, ``-`` and ``.``.
            sections: their sizes [bytes] by name.
            about: what an attaching process is to know, as JSON.

        Raises:
            RealtimeError: a live block has this name, or there is no room for it.
        """
        check_platform()
        if not re.fullmatch(r"[\w.-]{1,100}", name):
            raise ConfigError(f"A shared block cannot be called {name!r}; use letters, digits, '_', '-' and '.'.")
        sweep()
        places, end = {}, 0
        for section, size in sections.items():
            places[section] = (end, size)
            end += -(-size // _ALIGNMENT) * _ALIGNMENT
        text = json.dumps({"sections": places, "about": about}).encode()
        header = -(-(16 + len(text)) // _HEADER) * _HEADER
        path, descriptor = cls._make_file(name)
        try:
            # Not truncate: pages that do not exist would be found out by a bus error later.
            os.posix_fallocate(descriptor, 0, header + max(end, 1))
            memory = _map(path)
        except OSError as error:
            os.unlink(path)
            os.close(descriptor)
            raise RealtimeError(
                f"No room for {end / 1e6:.1f} MB of shared memory in {FOLDER}: {error.strerror}. Free some, or give "
                "the container more (--shm-size=256m)."
            ) from error
        memory[8:16] = len(text).to_bytes(8, "little")
        memory[16 : 16 + len(text)] = text
        fence()
        memory[0:8] = _MAGIC  # last: from here on it can be attached to
        return cls._opened(path, descriptor, memory)

    @classmethod
    def attach(cls, name: str) -> Self:
        """Open a block of another process.

        Raises:
            RealtimeError: there is none; the message lists those that there are.
        """
        path, descriptor = _find(name)
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        try:
            memory = _map(path)
            valid = memory[0:8] == _MAGIC
        except (OSError, ValueError):  # gone in the meantime, or empty
            valid = False
        if not valid:
            os.close(descriptor)
            raise RealtimeError(f"{path} is not a block of this version of bhd_lerobot.")
        return cls._opened(path, descriptor, memory)

    @classmethod
    def watch(cls, name: str) -> Self:
        """Open a block of another process to read it: its memory cannot be written, and it does not count as held.

        So a watching process keeps no name taken, and the block's end does not wait for it.

        Raises:
            RealtimeError: there is none; the message lists those that there are.
        """
        path, descriptor = _find(name)
        try:
            memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size, access=mmap.ACCESS_READ)
            valid = memory[0:8] == _MAGIC
        except (OSError, ValueError):
            valid = False
        if not valid or _is_free(descriptor):
            os.close(descriptor)
            raise _not_found(name, "it is no block of this version" if not valid else "no process holds it any more")
        return cls._opened(path, descriptor, memory)

    @property
    def is_held(self) -> bool:
        """Whether a process holds the block that this one watches; for the result of `watch` only."""
        return self._descriptor >= 0 and not _is_free(self._descriptor)

    def write(self, section: str, offset: int, data: bytes) -> None:
        """Write into a block that is watched. Past its memory, which cannot be written: so only on purpose.

        Args:
            section: where.
            offset: from the section's beginning [bytes].
            data: what.
        """
        start, size = self._sections[section]
        if not 0 <= offset <= size - len(data):
            raise ConfigError(f"Bytes {offset} to {offset + len(data)} are not in section {section!r} of {size} bytes.")
        os.pwrite(self._descriptor, data, start + offset)

    @classmethod
    def _opened(cls, path: Path, descriptor: int, memory: mmap.mmap) -> Self:
        length = int.from_bytes(memory[8:16], "little")
        start = -(-(16 + length) // _HEADER) * _HEADER
        try:
            described = json.loads(memory[16 : 16 + length])
            sections = {name: (start + offset, size) for name, (offset, size) in described["sections"].items()}
            block = cls(path, descriptor, memory, sections)
            block.about = described["about"]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            os.close(descriptor)
            raise RealtimeError(f"{path} is damaged: another process has overwritten what describes it.") from error
        return block

    @staticmethod
    def _make_file(name: str) -> tuple[Path, int]:
        for _ in range(_TRIES):
            path = FOLDER / f"{PREFIX}{name}.{secrets.token_hex(8)}"
            try:
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            except OSError as error:
                raise RealtimeError(f"Shared memory cannot be made in {FOLDER}: {error.strerror}.") from error
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            others = any(not free and other != path and _name(other) == name for other, free in _blocks())
            # A sweep between the two calls may have removed it.
            if path.exists() and not others:
                return path, descriptor
            path.unlink(missing_ok=True)
            os.close(descriptor)
            # Another process may just be checking whether the other block is held, or making one of this name, too.
            time.sleep(random.uniform(1, 3) * _CHECK_S)
        raise RealtimeError(f"A robot called {name!r} is running already.")

    def section(self, name: str) -> memoryview:
        """Return a section's memory; it is valid until `close`."""
        start, size = self._sections[name]
        view = memoryview(self._memory)[start : start + size]
        self._views.append(view)
        return view

    def close(self) -> None:
        """Leave the block; the last process that does so removes it. May be called twice."""
        if self._descriptor < 0:
            return
        if self._pid == os.getpid():
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)  # which a process has, too, that was forked since
        os.close(self._descriptor)
        self._descriptor = -1
        # Arrays over the memory may still be around; it is unmapped with the last of them.
        for view in self._views:
            with contextlib.suppress(BufferError):
                view.release()
        with contextlib.suppress(BufferError):
            self._memory.close()
        sweep()
        if self._path.exists():
            # Either others hold it, or another process is just checking whether it is held.
            time.sleep(_CHECK_S)
            sweep()


def _find(name: str) -> tuple[Path, int]:
    """Return the file of this user's block of a name, and a descriptor of it."""
    # A killed run may have left another one, and one that is being made is given up if this one is held.
    found = [(free, not _is_made(path), path) for path, free in _blocks() if _name(path) == name]
    for _, _, path in sorted(found):
        if (descriptor := _open(path)) is not None:
            return path, descriptor
    raise _not_found(name, "no process of yours has made such a block")


def _open(path: Path) -> int | None:
    """Return a descriptor of a block; None if it is gone, or no plain file that this user alone can open."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    about = os.fstat(descriptor)
    if stat.S_ISREG(about.st_mode) and about.st_uid == os.geteuid() and not stat.S_IMODE(about.st_mode) & 0o077:
        return descriptor
    os.close(descriptor)
    return None


def _is_made(path: Path) -> bool:
    descriptor = _open(path)
    if descriptor is None:
        return False
    try:
        return os.pread(descriptor, len(_MAGIC), 0) == _MAGIC
    finally:
        os.close(descriptor)


def _name(path: Path) -> str:
    """Return the name of the block in a file; version 0.1 called files by it alone."""
    found = _FILE.fullmatch(path.name)
    return found["name"] if found else path.name.removeprefix(PREFIX)


def _not_found(name: str, why: str) -> RealtimeError:
    return RealtimeError(f"No running robot is called {name!r} ({why}). Running: {', '.join(names()) or 'none'}.")


def _is_free(descriptor: int) -> bool:
    """Return whether no process holds a block; the descriptor itself must not."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return True


def _map(path: Path) -> mmap.mmap:
    # By a descriptor of its own: the mapping keeps a copy of it, and would keep the lock of the other.
    descriptor = _open(path)
    if descriptor is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    try:
        return mmap.mmap(descriptor, os.fstat(descriptor).st_size)
    finally:
        os.close(descriptor)


def names() -> list[str]:
    """Return the names of this user's blocks that a process holds."""
    return sorted({_name(path) for path, free in _blocks() if not free})


def sweep() -> list[str]:
    """Remove this user's blocks that no process holds any more; return their names."""
    return sorted(_name(path) for path, free in _blocks(remove=True) if free)


def _blocks(*, remove: bool = False) -> Iterator[tuple[Path, bool]]:
    """Yield the file of each block of this user, and whether no process holds it."""
    for path in sorted(FOLDER.glob(f"{PREFIX}*")) if FOLDER.is_dir() else []:
        # Other programs have files with such names, too; version 0.1's have no part that cannot be guessed.
        if not _FILE.fullmatch(path.name) and not _is_made(path):
            continue
        descriptor = _open(path)
        if descriptor is None:
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if remove:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(path)
            yield path, True
        except BlockingIOError:
            yield path, False
        finally:
            os.close(descriptor)
