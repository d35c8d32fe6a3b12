"""Video of one camera: encoded in a thread while the episode runs, and joined later without encoding again."""

import contextlib
import os
import queue
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.storage.pointers import not_fetched
from bhd_lerobot.errors import ConfigError, DatasetCorruptError, FrameError, unknown_name


@dataclass(frozen=True)
class VideoSettings:
    """How images become video. The first seven fields mean what they mean in LeRobot's `RGBEncoderConfig`.

    Attributes:
        vcodec: encoder name. H.264 encodes fastest on a CPU and decodes everywhere.
        pix_fmt: pixel format of the stream.
        g: distance of key frames [frames]. Small values make random access fast and files larger.
        crf: quality, lower is better and larger.
        preset: speed of the encoder; its values depend on the codec.
        fast_decode: ease decoding at the price of size (0 is off).
        extra_options: further options of the encoder; they never override a field.
        encoder_threads: threads per camera and open episode. One is best when many simulations record at once.
        queue_size: images that may wait for the encoder before `add_image` blocks.
    """

    vcodec: str = "h264"
    pix_fmt: str = "yuv420p"
    g: int | None = 2
    crf: float | None = 23
    preset: int | str | None = "veryfast"
    fast_decode: int = 0
    extra_options: Mapping[str, Any] = field(default_factory=dict)
    encoder_threads: int = 1
    queue_size: int = 16

    def check(self) -> None:
        """Check that this machine can encode so."""
        import av  # here and below: a dataset without cameras does not need ffmpeg at all

        if self.vcodec not in av.codecs_available or not _is_encoder(self.vcodec):
            usable = [name for name in ("h264", "hevc", "libsvtav1", "libaom-av1") if _is_encoder(name)]
            raise ConfigError(unknown_name("video encoder", self.vcodec, usable))
        for name in ("encoder_threads", "queue_size"):
            if getattr(self, name) < 1:
                raise ConfigError(f"video.{name} must be at least 1; got {getattr(self, name)}.")

    def codec_options(self) -> dict[str, str]:
        """Return the options for ffmpeg."""
        options: dict[str, Any] = {"g": self.g, "crf": self.crf, "preset": self.preset}
        if self.vcodec == "libsvtav1":
            options["svtav1-params"] = f"fast-decode={self.fast_decode}:lp={self.encoder_threads}"
        else:
            options["threads"] = self.encoder_threads
            if self.fast_decode:
                options["tune"] = "fastdecode"
            # Without B-frames every file starts at time 0 in decoding order too, and files join exactly.
            options["bf"] = 0
            if self.vcodec in ("h264", "libx264"):
                # With AVX-512, x264's macroblock tree reads past the end of a row that is no multiple of 8 blocks wide:
                # of encoders side by side, one in 15 made another stream of the same images of 64 x 48 pixels. With key
                # frames as close as ours it has nothing to do.
                options["mbtree"] = 0
        options = {**self.extra_options, **{key: value for key, value in options.items() if value is not None}}
        return {key: str(value) for key, value in options.items()}

    def recorded(self) -> dict[str, Any]:
        """Return the fields that shape the stream; a dataset can only be resumed with the same ones."""
        fields = asdict(self)
        del fields["encoder_threads"], fields["queue_size"]
        return {**fields, "extra_options": dict(self.extra_options)}


@contextlib.contextmanager
def _same_scheduler() -> Iterator[None]:
    """Take back real-time priority that an encoder gives itself while it is opened.

    SVT-AV1 raises its threads, and the one that opens it, to `SCHED_FIFO` 99 where the process may (as root): above
    the cerebellum, whose processor it would then take.
    """
    if sys.platform != "linux":
        yield
        return

    def schedulers() -> dict[int, int]:
        found = {}
        for thread in map(int, os.listdir("/proc/self/task")):
            with contextlib.suppress(ProcessLookupError):
                found[thread] = os.sched_getscheduler(thread)
        return found

    before = schedulers()
    yield
    for thread, scheduler in schedulers().items():
        if scheduler & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR) and scheduler != before.get(thread):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def _is_encoder(name: str) -> bool:
    import av

    try:
        return bool(av.codec.Codec(name, "w").is_encoder)
    except (av.error.FFmpegError, ValueError):
        return False


_AGAIN = np.zeros(0, np.uint8)  # in a queue: the image before, once more


class CameraEncoder:
    """Encodes the images of one camera and one episode into one file.

    `add` blocks while the queue is full; no image is ever dropped.
    """

    def __init__(self, path: Path, fps: int, size: tuple[int, int], settings: VideoSettings) -> None:
        """Start the thread; `size` is (height, width) in pixels."""
        self.path = path
        self.frames = 0
        self._fps, self._size, self._settings = fps, size, settings
        self._queue: queue.Queue[np.ndarray | None] = queue.Queue(settings.queue_size)
        self._cancelled = threading.Event()
        self._error: Exception | None = None
        self._histograms: list[np.ndarray] = []
        self._thread = threading.Thread(target=self._run, name=f"encode {path.name}", daemon=True)
        self._thread.start()

    def add(self, image: np.ndarray) -> None:
        """Queue a copy of one image of shape (H, W, 3), uint8."""
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != (*self._size, 3):
            got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise FrameError(f"An image of camera {self.path.stem!r} must be uint8 {(*self._size, 3)}; got {got}.")
        self._put(np.array(image, order="C"))
        self.frames += 1

    def repeat(self) -> None:
        """Queue the last image once more; it takes a part of the time that a new one takes."""
        self._put(_AGAIN)
        self.frames += 1

    def finish(self) -> np.ndarray:
        """Encode what is queued, close the file and return the histograms, shape (T, 3, 256)."""
        self._put(None)
        self._thread.join()
        self._raise_error()
        if count_frames(self.path) != self.frames:
            raise OSError(f"the encoder wrote another number of frames than the {self.frames} it was given")
        return np.stack(self._histograms)

    def cancel(self) -> None:
        """Stop without caring for the file; also after an error, also twice."""
        self._cancelled.set()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        self._thread.join()

    def _put(self, item: np.ndarray | None) -> None:
        while True:
            self._raise_error()
            try:
                # The time-out only serves to notice an encoder that died while the queue was full.
                self._queue.put(item, timeout=0.1)
            except queue.Full:
                continue
            return

    def _raise_error(self) -> None:
        if self._error is not None:
            raise OSError(getattr(self._error, "errno", None), str(self._error), str(self.path)) from self._error

    def _run(self) -> None:
        try:
            self._encode()
        except Exception as error:  # raised again in the thread that records
            self._error = error

    def _encode(self) -> None:
        import av

        with av.open(str(self.path), "w", format="mp4") as container:
            stream: Any = container.add_stream(self._settings.vcodec, self._fps, options=self._settings.codec_options())
            stream.height, stream.width = self._size
            stream.pix_fmt = self._settings.pix_fmt
            step = Fraction(1, self._fps)
            stream.time_base = step
            with _same_scheduler():
                stream.codec_context.open()
            frame: Any = None
            while (image := self._queue.get()) is not None and not self._cancelled.is_set():
                if image is not _AGAIN:
                    frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=self._settings.pix_fmt)
                    histogram = statistics.image_histogram(image)
                frame.pts = len(self._histograms)
                frame.time_base = step  # not the stream's, which the container changes on the way
                container.mux(stream.encode(frame))
                self._histograms.append(histogram)
            container.mux(stream.encode())


class EncodedVideo:
    """Images of one camera and one episode that were encoded elsewhere; in the place of a `CameraEncoder`.

    Args:
        histograms: of its images, shape (T, 3, 256).
    """

    def __init__(self, path: Path, histograms: np.ndarray) -> None:
        self.path, self.frames = path, len(histograms)
        self._histograms = histograms

    def finish(self) -> np.ndarray:
        """Check the file and return the histograms."""
        if count_frames(self.path) != self.frames:
            raise OSError(f"{self.path.name} holds another number of frames than the {self.frames} that belong to it")
        return self._histograms

    def cancel(self) -> None:
        """There is nothing to stop."""


def count_frames(path: Path) -> int:
    """Return how many frames a video file holds, by reading all of it but decoding nothing."""
    return len(frame_times(path))


def frame_times(path: Path) -> NDArray[np.float64]:
    """Return when each frame of a video file is shown [s], ascending; decodes nothing."""
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            shown = [packet.pts for packet in container.demux(stream) if packet.size > 0]
            base = float(stream.time_base or 1)
    except (av.error.FFmpegError, IndexError) as error:
        raise OSError(getattr(error, "errno", None), str(error), str(path)) from error
    return np.sort(np.array([np.nan if pts is None else pts * base for pts in shown]))


def stream_signature(path: Path) -> tuple[Any, ...]:
    """Return what two files must share to be joined: codec, its header, size and time base."""
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            codec = stream.codec_context
            signature = (codec.name, bytes(codec.extradata or b""), stream.height, stream.width, stream.time_base)
    except (av.error.FFmpegError, IndexError, OSError) as error:
        raise not_fetched(path.parent, [path]) or DatasetCorruptError(
            f"{path} is not a readable video ({error}). Restore this file from a copy; nothing was changed."
        ) from error
    return signature


def video_info(path: Path, settings: VideoSettings) -> dict[str, Any]:
    """Return the entry that LeRobot keeps about a video feature in ``info.json``."""
    import av

    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        info: dict[str, Any] = {
            "video.height": stream.height,
            "video.width": stream.width,
            "video.codec": stream.codec.canonical_name,
            "video.pix_fmt": stream.pix_fmt,
            "video.fps": int(stream.base_rate or 0),
            "video.channels": len(av.VideoFormat(stream.pix_fmt).components),
            "has_audio": False,
        }
    recorded = settings.recorded()
    info |= {f"video.{key}": recorded[key] for key in ("g", "crf", "preset", "fast_decode")}
    return {
        **info,
        "video.video_backend": "pyav",
        "video.extra_options": recorded["extra_options"],
        "is_depth_map": False,
    }
