"""Camera frames of a dataset, decoded once and kept in memory as 8-bit images."""

import contextlib
import io
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.format.state import corrupt
from bhd_lerobot.datasets.loader.table import FrameTable
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.places import check_inside
from bhd_lerobot.errors import DatasetError, MemoryBudgetError, UnsupportedDatasetError

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata

GIB = 2**30
_MEMORY = Path("/proc/meminfo")
_CGROUP, _OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def image_shape(meta: "LeRobotDatasetMetadata", key: str) -> tuple[int, int, int]:
    """Return (channels, height, width) of a camera feature, in whatever order the dataset names them."""
    shape, names = tuple(meta.features[key]["shape"]), meta.features[key].get("names")
    if names and names[0] in ("channel", "channels"):
        channels, height, width = shape
    else:
        height, width, channels = shape
    return channels, height, width


def needed_bytes(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int], cameras: Sequence[str], keys: Collection[str] | None = None
) -> tuple[int, int]:
    """Return the bytes that decoded cameras and the columns of some episodes take; all columns if `keys` is None."""
    frames = int(np.asarray(meta.episodes["length"], dtype=np.int64)[list(episodes)].sum())
    sizes = {"float": 4, "int": 8, "uint": 8, "bool": 1}
    column = 0
    for key, feature in meta.features.items():
        if keys is None or key in keys or key in DEFAULT_FEATURES:
            kind = str(feature["dtype"]).rstrip("0123456789")
            column += sizes.get(kind, 0) * int(np.prod(feature["shape"]))
    return frames * sum(int(np.prod(image_shape(meta, key))) for key in cameras), frames * column


def available_memory() -> int:
    """Return the bytes that this process can still get, from the system and from its control group and those above."""
    free = [os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    if _MEMORY.is_file():
        for line in _MEMORY.read_text(encoding="utf-8").splitlines():
            if line.startswith("MemAvailable:"):
                free = [int(line.split()[1]) * 1024]
    lines = _OWN_CGROUP.read_text(encoding="utf-8").splitlines() if _OWN_CGROUP.is_file() else []
    own = "".join(line[3:] for line in lines if line.startswith("0::")).strip("/")
    group = _CGROUP / own  # a container sees its own as the topmost; that of a batch job is below
    for one in (group, *group.parents):
        with contextlib.suppress(OSError, ValueError):  # another system, or no limit
            limit = int((one / "memory.max").read_text())
            used = int((one / "memory.current").read_text())
            kinds = (line.split() for line in (one / "memory.stat").read_text().splitlines())
            # Files that were read are given up for whatever needs memory, as the system itself counts it.
            cached = sum(int(size) for kind, size in kinds if kind in ("active_file", "inactive_file"))
            free.append(limit - used + cached)
    return max(min(free), 0)


def check_memory(
    meta: "LeRobotDatasetMetadata",
    episodes: Sequence[int],
    cameras: Sequence[str],
    budget_gib: float,
    keys: Collection[str] | None = None,
) -> None:
    """Check that columns and decoded images fit, before anything is read."""
    if not budget_gib > 0:
        raise DatasetError(f"The budget of the loader must be positive; got {budget_gib} GiB.")
    depth = [key for key in cameras if key in meta.depth_keys]
    if depth:
        raise UnsupportedDatasetError(f"Camera {depth[0]!r} of {meta.root} measures depth, which is not kept in memory")
    images, columns = needed_bytes(meta, episodes, cameras, keys)
    needed, free = images + columns, available_memory()
    what = (
        f"{len(episodes)} episodes of {meta.root} take {needed / GIB:.3g} GiB in memory ({columns / GIB:.3g} columns, "
        f"{images / GIB:.3g} decoded images of {', '.join(cameras) or 'no camera'})"
    )
    if needed > budget_gib * GIB:
        raise MemoryBudgetError(
            f"{what}, more than the budget of {budget_gib:g} GiB. Raise the budget, or select fewer episodes or cameras"
        )
    if needed > free:
        raise MemoryBudgetError(
            f"{what}, and {free / GIB:.3g} GiB are free. Select fewer episodes or cameras, or end other programs"
        )


@dataclass(frozen=True)
class _Job:
    """Frames of one file: their times in it [s], ascending, and the rows that they belong to."""

    path: Path
    key: str
    times: np.ndarray
    rows: np.ndarray


class FrameCache:
    """The images of some cameras, one for each row of a table.

    Attributes:
        keys: the cameras, videos first, in the order of the features.
        images: key -> shape (N, C, H, W), uint8.
    """

    def __init__(self, table: FrameTable, cameras: Sequence[str], tolerance_s: float, backend: str = "pyav") -> None:
        """Decode the images of the rows; a frame may miss its time by `tolerance_s` [s]."""
        self._table, self._tolerance, self._backend = table, tolerance_s, backend
        self._stored = [key for key in cameras if key in table.images]
        self.keys = [*(key for key in cameras if key not in table.images), *self._stored]
        self.images: dict[str, Tensor] = {}
        try:
            for key in self.keys:
                self.images[key] = torch.empty((len(table), *image_shape(table.meta, key)), dtype=torch.uint8)
            self._decode_all()
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, MemoryError) or "allocate" in str(error):
                raise MemoryBudgetError(f"Memory ran out while the images of {table.meta.root} were decoded") from error
            raise

    @property
    def nbytes(self) -> int:
        """Bytes that the images take."""
        return sum(images.nbytes for images in self.images.values())

    def gather(self, key: str, rows: NDArray, return_uint8: bool) -> Tensor:
        """Return the images of some rows as LeRobot has them.

        Args:
            key: the camera.
            rows: shape (B,), or (B, n) if the camera has a window in time.
            return_uint8: leave videos as they are stored.

        Returns:
            Shape (B, C, H, W), or (B, n, C, H, W); of a video also (B, C, H, W) if n is 1. In [0, 1] if float32.
        """
        images = self.images[key].numpy()
        is_stored = key in self._stored
        found = images.take(rows if is_stored or rows.ndim == 1 or rows.shape[1] > 1 else rows[:, 0], axis=0)
        if is_stored or not return_uint8:
            found = np.divide(found, np.float32(255), dtype=np.float32)
        return torch.from_numpy(found)

    def _decode_all(self) -> None:
        jobs = list(self._jobs())
        workers = max(1, min(len(jobs), os.cpu_count() or 1))
        threads = max(1, (os.cpu_count() or 1) // workers)
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(lambda job: self._decode(job, threads), jobs))
        for key in self._stored:
            self._decode_stored(key)

    def _jobs(self) -> Iterator[_Job]:
        table, meta = self._table, self._table.meta
        times = table.columns["timestamp"].numpy().astype(np.float64)
        for key in self.keys:
            if key in self._stored:
                continue
            columns = {name: meta.episodes[f"videos/{key}/{name}"] for name in _VIDEO_COLUMNS}
            files: dict[tuple[int, int], list[int]] = {}
            for episode in table.episodes:
                files.setdefault((columns["chunk_index"][episode], columns["file_index"][episode]), []).append(episode)
            for (chunk, file), episodes in files.items():
                rows = np.concatenate([np.arange(s.start, s.stop) for s in map(table.rows, episodes)])
                begins = [columns["from_timestamp"][episode] for episode in episodes]
                lengths = [s.stop - s.start for s in map(table.rows, episodes)]
                shifted = np.repeat(np.asarray(begins, dtype=np.float64), lengths) + times[rows]
                order = np.argsort(shifted, kind="stable")
                name = (meta.video_path or layout.VIDEO_PATH).format(video_key=key, chunk_index=chunk, file_index=file)
                yield _Job(meta.root / name, key, shifted[order], rows[order])

    def _decode(self, job: _Job, threads: int) -> None:
        import av

        try:
            if self._backend in ("pyav", "video_reader"):
                self._decode_pyav(job, threads)
            else:
                self._decode_lerobot(job)
        except (av.error.FFmpegError, OSError, IndexError) as error:
            raise corrupt(job.path, error) from error

    def _decode_pyav(self, job: _Job, threads: int) -> None:
        import av
        from av.video.reformatter import VideoReformatter

        images, channels = self.images[job.key], self.images[job.key].shape[1:]
        reformatter = VideoReformatter()  # one for all frames: making its tables costs more than converting
        with av.open(str(job.path)) as container:
            stream: Any = container.streams.video[0]
            stream.thread_type, stream.codec_context.thread_count = "AUTO", threads
            container.seek(round(job.times[0] / stream.time_base) - 1, backward=True, any_frame=False, stream=stream)
            # A frame is the right one if the next one is not nearer, so one is held back.
            done, held, held_time = 0, None, -np.inf
            for frame in _with_end(container.decode(stream)):
                time = np.inf if frame is None else float(frame.pts * stream.time_base)
                while done < len(job.times) and _gap(job.times[done], held_time) <= _gap(job.times[done], time):
                    if held is None or not _gap(job.times[done], held_time) < self._tolerance:
                        raise self._lost(job, done)
                    pixels = reformatter.reformat(held, format="rgb24").to_ndarray()
                    if (pixels.shape[2], *pixels.shape[:2]) != tuple(channels):
                        raise corrupt(job.path, f"its images are {pixels.shape}, info.json says {tuple(channels)}")
                    images[int(job.rows[done])] = torch.from_numpy(pixels).permute(2, 0, 1)
                    done += 1
                if done == len(job.times):
                    break
                held, held_time = frame, time

    def _lost(self, job: _Job, done: int) -> DatasetError:
        place = self._table.place(int(job.rows[done]))
        return DatasetError(
            f"{job.path} has no image of {job.key!r} for {place}: none within {self._tolerance:g} s of "
            f"{job.times[done]:.6f} s. The video and the data do not belong together; run bhd-data repair."
        )

    def _decode_lerobot(self, job: _Job) -> None:
        from bhd_lerobot.stock import FrameTimestampError, decode_video_frames

        for begin in range(0, len(job.times), 64):
            part = slice(begin, begin + 64)
            times = job.times[part].tolist()
            try:
                frames = decode_video_frames(job.path, times, self._tolerance, self._backend, return_uint8=True)
            except FrameTimestampError as error:
                raise self._lost(job, begin) from error
            except (ImportError, RuntimeError, ValueError) as error:
                reason = str(error).strip().split("\n")[0]
                raise DatasetError(
                    f"The video decoder {self._backend!r} does not work here: {reason} Set the video backend to 'pyav'."
                ) from error
            self.images[job.key][torch.from_numpy(job.rows[part])] = frames

    def _decode_stored(self, key: str) -> None:
        from PIL import Image

        column, images, root = self._table.images[key], self.images[key], Path(self._table.meta.root)

        def decode(row: int, value: Mapping[str, Any]) -> None:
            # The file of an image that is not in the table lies beside it.
            source = io.BytesIO(value["bytes"]) if value["bytes"] else check_inside(root, root / value["path"])
            pixels = np.asarray(Image.open(source))
            if pixels.dtype != np.uint8:
                raise UnsupportedDatasetError(f"The images of {key!r} are {pixels.dtype}, which is not kept in memory")
            pixels = pixels[..., None] if pixels.ndim == 2 else pixels
            images[row] = torch.from_numpy(np.array(pixels)).permute(2, 0, 1)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(decode, range(len(column)), (value.as_py() for value in column)))


_VIDEO_COLUMNS = ("chunk_index", "file_index", "from_timestamp")


def _gap(wanted: float, found: float) -> float:
    """Return how far two times are apart, as LeRobot compares them: in single precision."""
    return float(abs(np.float32(wanted) - np.float32(found)))


def _with_end(frames: Iterator[Any]) -> Iterator[Any]:
    for frame in frames:
        if frame.pts is not None:
            yield frame
    yield None
