"""Video encoders in a process of their own: whoever records never waits for one, and shares no interpreter lock.

Images go through shared memory, requests and answers through a pipe. The process ends with the one that started it,
whatever ends that one.
"""

import contextlib
import mmap
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

import numpy as np

from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.errors import FrameError
from bhd_lerobot.programs import start_program

_SLOTS_BYTES = 64 << 20  # shared memory: 70 images of 640 x 480
_WAITING_BYTES = 1 << 30  # images that may wait here for room there; beyond that they are dropped


class EncoderProcess:
    """Starts the process, and hands out encoders that work in it."""

    def __init__(self) -> None:
        self._memory_file = os.memfd_create("bhd-images")
        os.ftruncate(self._memory_file, _SLOTS_BYTES)
        self._memory = mmap.mmap(self._memory_file, _SLOTS_BYTES)
        self._pipe, theirs = Pipe()
        descriptors = theirs.fileno(), self._memory_file
        self._process = start_program(__name__, *descriptors, descriptors=descriptors)
        theirs.close()
        self._encoders: dict[int, RemoteEncoder] = {}
        self._made = 0
        self._wanted: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._room = threading.Condition()
        self._waiting = self._used = 0  # bytes of images that wait here, and in shared memory
        self._next = 0  # where the next image goes in shared memory
        self._spans: queue.SimpleQueue[int] = queue.SimpleQueue()  # bytes of the images on their way, in order
        self._taken, self._began_s = 0, 0.0  # images encoded since the process had nothing to do, and since when
        self.problem = ""
        self._is_closed = False
        self._threads = [
            threading.Thread(target=run, name=f"bhd-images-{name}", daemon=True)
            for name, run in (("out", self._feed), ("in", self._listen))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def encoder(self, path: Path, fps: int, size: tuple[int, int], settings: VideoSettings) -> "RemoteEncoder":
        """Return an encoder of one camera and one episode; the arguments are those of `CameraEncoder`."""
        self._made += 1
        encoder = RemoteEncoder(self, self._made, path, size)
        self._encoders[self._made] = encoder
        if self.problem:  # nobody would answer
            encoder.answered("failed", None, self.problem)
        self.put(("open", self._made, str(path), fps, size, asdict(settings)))
        return encoder

    @property
    def images_per_s(self) -> float:
        """Images of all cameras that are encoded in a second, since there was last nothing to do [Hz]."""
        return self._taken / max(time.monotonic() - self._began_s, 1e-9)

    def put(self, message: tuple[Any, ...]) -> None:
        """Queue a message."""
        self._wanted.put(message)

    def put_image(self, number: int, image: np.ndarray, *, is_needed: bool) -> bool:
        """Queue an image of an encoder; return whether there was room for it, which nobody waits for.

        Args:
            number: of the encoder.
            image: shape (H, W, 3).
            is_needed: whether it is queued in any case.
        """
        with self._room:
            if self._waiting + image.nbytes > _WAITING_BYTES and not is_needed:
                return False
            if not (self._waiting or self._used):
                self._taken, self._began_s = 0, time.monotonic()
            self._waiting += image.nbytes
        self._wanted.put(("image", number, image))
        return True

    def _feed(self) -> None:
        while (message := self._wanted.get()) is not None:
            kind, number, *rest = message
            if kind == "image":
                image = rest[0]
                is_wanted = number in self._encoders and not self._encoders[number].is_cancelled
                if is_wanted:
                    start = self._place(image.nbytes)
                    self._memory[start : start + image.nbytes] = image.tobytes()
                    rest = [start, image.shape]
                with self._room:
                    self._waiting -= image.nbytes
                if not is_wanted:
                    continue
            with contextlib.suppress(OSError):  # the process has ended, which the other thread notices
                self._pipe.send((kind, number, *rest))
        with contextlib.suppress(OSError):
            self._pipe.send(("end", 0))

    def _place(self, size: int) -> int:
        """Return where an image goes in shared memory, as soon as there is room for it."""
        with self._room:
            tail = _SLOTS_BYTES - self._next
            skipped = tail if tail < size else 0  # an image lies in one piece
            while self._used + skipped + size > _SLOTS_BYTES and not self.problem:
                self._room.wait(0.1)
            self._used += skipped + size
            start = 0 if skipped else self._next
            self._next = start + size
            self._spans.put(skipped + size)
        return start

    def _listen(self) -> None:
        try:
            while True:
                kind, number, *rest = self._pipe.recv()
                if kind == "taken":
                    with self._room:
                        self._taken += 1
                        self._used -= self._spans.get()
                        self._room.notify_all()
                elif (encoder := self._encoders.get(number)) is not None:
                    encoder.answered(kind, *rest)
        except (EOFError, OSError):
            with self._room:
                self.problem = "the encoders' process has ended"
                self._room.notify_all()
            for encoder in list(self._encoders.values()):
                encoder.answered("failed", None, self.problem)

    def forget(self, number: int) -> None:
        """Forget an encoder that is done."""
        self._encoders.pop(number, None)

    def close(self) -> None:
        """End the process. May be called twice."""
        if self._is_closed:
            return
        self._is_closed = True
        self._wanted.put(None)
        self._threads[0].join()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        self._process.kill()
        self._process.wait()
        self._threads[1].join()
        self._pipe.close()
        with contextlib.suppress(OSError):
            os.close(self._memory_file)


class RemoteEncoder:
    """Encodes the images of one camera and one episode into one file; in the place of a `CameraEncoder`.

    Nobody waits for it: an image for which there is no room is dropped, and the one before stands in its place.
    """

    def __init__(self, process: EncoderProcess, number: int, path: Path, size: tuple[int, int]) -> None:
        self.path = path
        self.frames = 0
        self.dropped: list[int] = []
        self.is_cancelled = False
        self._process, self._number, self._size = process, number, size
        self._done = threading.Event()
        self._histograms: np.ndarray | None = None
        self._error: tuple[int | None, str] | None = None

    def add(self, image: np.ndarray) -> None:
        """Queue a copy of one image of shape (H, W, 3), uint8."""
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != (*self._size, 3):
            got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise FrameError(f"An image of camera {self.path.stem!r} must be uint8 {(*self._size, 3)}; got {got}.")
        self._raise_error()
        if not self._process.put_image(self._number, np.array(image, order="C"), is_needed=not self.frames):
            self._process.put(("repeat", self._number))
            self.dropped.append(self.frames)
        self.frames += 1

    @property
    def images_per_s(self) -> float:
        """Images of all cameras that the process encodes in a second [Hz]."""
        return self._process.images_per_s

    def finish(self) -> np.ndarray:
        """Encode what is queued, close the file and return the histograms, shape (T, 3, 256)."""
        self._process.put(("finish", self._number))
        self._done.wait()
        self._process.forget(self._number)
        self._raise_error()
        if self._histograms is None:
            raise AssertionError("An encoder that is done without an error has histograms.")
        if len(self._histograms) != self.frames:
            raise OSError(f"{len(self._histograms)} of {self.frames} images were encoded")
        return self._histograms

    def cancel(self) -> None:
        """Stop without caring for the file; also after an error, also twice."""
        self.is_cancelled = True
        if not self._done.is_set():
            self._process.put(("cancel", self._number))
            self._done.wait()
        self._process.forget(self._number)

    def answered(self, kind: str, *rest: Any) -> None:
        """Take what the process says: ``done`` with the histograms, ``failed`` with number and text, ``cancelled``."""
        if kind == "done":
            self._histograms = rest[0]
        elif kind == "failed":
            self._error = rest[0], rest[1]
        self._done.set()

    def _raise_error(self) -> None:
        if self._error is not None:
            number, text = self._error
            raise OSError(number, text, str(self.path))


# --- in the process ---------------------------------------------------------------------------------------------------


class Server:
    """Does what the pipe says until it ends."""

    def __init__(self, pipe: Connection, memory: mmap.mmap) -> None:
        self._pipe, self._memory = pipe, memory
        self._encoders: dict[int, CameraEncoder] = {}
        self._failed: set[int] = set()

    def serve(self) -> None:
        """Take messages until ``end``, or until the other side is gone."""
        calls: dict[str, Callable[..., None]] = {
            "open": self._open,
            "image": self._image,
            "repeat": self._repeat,
            "finish": self._finish,
            "cancel": self._cancel,
        }
        with contextlib.suppress(EOFError):
            while (message := self._pipe.recv())[0] != "end":
                kind, number, *rest = message
                try:
                    calls[kind](number, *rest)
                except Exception as error:  # raised again in the process that records
                    if number not in self._failed:
                        self._failed.add(number)
                        self._pipe.send(("failed", number, getattr(error, "errno", None), str(error)))
        for encoder in self._encoders.values():
            encoder.cancel()

    def _open(self, number: int, path: str, fps: int, size: tuple[int, int], settings: dict[str, Any]) -> None:
        self._encoders[number] = CameraEncoder(Path(path), fps, size, VideoSettings(**settings))

    def _image(self, number: int, start: int, shape: tuple[int, ...]) -> None:
        image = np.frombuffer(self._memory, np.uint8, int(np.prod(shape)), start).reshape(shape)
        try:
            if number not in self._failed:
                self._encoders[number].add(image)
        finally:
            self._pipe.send(("taken", number))

    def _repeat(self, number: int) -> None:
        if number not in self._failed:
            self._encoders[number].repeat()

    def _finish(self, number: int) -> None:
        if number not in self._failed:
            self._pipe.send(("done", number, self._encoders.pop(number).finish()))

    def _cancel(self, number: int) -> None:
        if number in self._encoders:
            self._encoders.pop(number).cancel()
        self._pipe.send(("cancelled", number))


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        Server(Connection(int(sys.argv[1])), mmap.mmap(int(sys.argv[2]), _SLOTS_BYTES)).serve()
