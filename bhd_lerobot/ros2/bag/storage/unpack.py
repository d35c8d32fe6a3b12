"""Taking compressed bags apart, within bounds: a file of some kilobytes can declare, and unpack to, any size."""

import contextlib
import importlib
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import DatasetError

LEAST_BYTES = 256 << 20
"""What any file may unpack to [bytes]."""

MOST_RATIO = 200
"""How many times its size a file may unpack to besides. Recordings of sensors reach 2 to 20."""

MESSAGE_BYTES = 200
"""What a message costs besides its content [bytes]: it is an object in memory, also if it is empty."""

_BLOCK = 1 << 20


class Budget:
    """How much may still be unpacked of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._most = LEAST_BYTES + MOST_RATIO * path.stat().st_size
        self.left = self._most

    def start(self) -> None:
        """Allow all of it again: the file is read from its beginning."""
        self.left = self._most

    def take(self, size: int) -> None:
        """Count what is unpacked, or what is declared before it is."""
        self.left -= size
        if self.left < 0:
            raise DatasetError(
                f"{self.path} has {self.path.stat().st_size} bytes and unpacks to more than {self._most >> 20} MiB, as "
                "no recording of sensors does, so it is not read. If you know where it comes from, take the "
                "compression away first: ros2 bag convert."
            )

    def unpack(self, name: str, data: Any, declared: int | None = None) -> bytes:
        """Return what is compressed.

        Args:
            declared: the size that the file declares [bytes]; one byte more at most is unpacked, and of data that are
                cut off, as much as there is. If None, the data must be whole.
        """
        decompressor = _decompressor(name, self.path)
        content: bytes = decompressor.decompress(data, min(self.left, declared or self.left) + 1)
        self.take(len(content))
        if declared is None and not decompressor.eof:
            raise ValueError("it is cut off")
        return content


def _decompressor(name: str, path: Path) -> Any:
    if name == "zstd":
        return zstd().ZstdDecompressor()
    if name == "lz4":
        return importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    raise DatasetError(f"{path} is compressed with {name!r}, which is not known; valid: zstd, lz4, nothing.")


def zstd() -> Any:
    """Return the zstd module that `rosbags` brings."""
    return importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


@contextlib.contextmanager
def plain_file(path: Path) -> Iterator[Path]:
    """Give a file without the compression around it."""
    if path.suffix != ".zstd":
        yield path
        return
    with temporary_copy(path, path.stem, _unpacked(path)) as target:
        yield target


@contextlib.contextmanager
def temporary_copy(path: Path, name: str, blocks: Iterable[bytes]) -> Iterator[Path]:
    """Give a file in a temporary folder of its own, which only this user can read."""
    with contextlib.ExitStack() as stack:
        with room(path):
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="bhd-bag-"))
            file = stack.enter_context(Path(folder, name).open("wb"))
        for block in blocks:
            with room(path):
                file.write(block)
                file.flush()  # here, where its error is caught
        file.close()
        yield Path(folder, name)


@contextlib.contextmanager
def room(path: Path) -> Iterator[None]:
    """Say, where a copy of a bag does not fit into the folder for temporary files, what helps."""
    try:
        yield
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be unpacked into {tempfile.gettempdir()}: {error.strerror or error}. Free some space "
            "there, or name another folder in the environment variable TMPDIR."
        ) from error


def _unpacked(path: Path) -> Iterator[bytes]:
    budget, is_empty = Budget(path), True
    try:
        with zstd().open(path, "rb") as packed:
            while block := packed.read(_BLOCK):
                budget.take(len(block))
                yield block
                is_empty = False
    except (OSError, EOFError, zstd().ZstdError) as error:
        if is_empty or isinstance(error, OSError):
            raise DatasetError(f"{path} cannot be decompressed: {error}. Restore it from a copy.") from error
