"""The videos of a corrupted dataset: which frames of which video show which episode."""

import contextlib
import itertools
import os
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bhd_lerobot.datasets.format import video
from bhd_lerobot.datasets.format.expected import wrong_part
from bhd_lerobot.datasets.format.state import Row, slot_columns, slot_of
from bhd_lerobot.datasets.format.video_splice import Span, splice
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.datasets.validate.findings import Findings
from bhd_lerobot.errors import UnsupportedDatasetError


def cut_out(
    path: Path, target: Path, spans: Sequence[Span], frames: tuple[int, str], fps: Fraction
) -> list[int] | None:
    """Write spans of a video into another one, which holds nothing else if each begins with a key frame.

    Args:
        frames: how many of its frames can be read, and what is wrong with the next, if anything.

    Returns:
        Where each span begins in the new video; None if nothing was written, because the video can stay as it is.
    """
    count, problem = frames
    ends = list(itertools.accumulate(length for _, length in spans))
    begins = [0, *ends[:-1]]
    is_all = [start for start, _ in spans] == begins and ends[-1] == count
    if is_all and not problem:
        return None
    with contextlib.suppress(UnsupportedDatasetError):
        splice([(path, spans)], target, fps)
        return begins
    if not problem:
        return None
    splice([(path, [(0, max(start + length for start, length in spans))])], target, fps)
    return [start for start, _ in spans]


def encode(folder: Path, target: Path, length: int, fps: Fraction, feature: dict[str, Any]) -> None:
    """Write the images of an episode as a video, with the settings of the others."""
    from PIL import Image

    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder prints errors only
    with Image.open(folder / "frame-000000.png") as image:
        width, height = image.size  # a feature's shape may begin with the channels
    encoder = video.CameraEncoder(target, round(fps), (height, width), _settings(feature))
    try:
        for frame in range(length):
            with Image.open(folder / f"frame-{frame:06d}.png") as image:
                encoder.add(np.asarray(image.convert("RGB")))
        encoder.finish()
    except BaseException:
        encoder.cancel()
        raise


def _settings(feature: dict[str, Any]) -> video.VideoSettings:
    """Return the settings that the other videos were encoded with, as far as this machine has their encoder."""
    info = feature.get("info") or {}
    encoder = {"av1": "libsvtav1", "hevc": "hevc", "h264": "h264"}.get(str(info.get("video.codec")), "h264")
    settings = video.VideoSettings(
        vcodec=encoder, g=info.get("video.g", 2), crf=info.get("video.crf", 23), preset=info.get("video.preset")
    )
    try:
        settings.check()
    except Exception:
        return video.VideoSettings()
    return settings


_FRAMES = "images/{key}/episode-{episode:06d}"  # where LeRobot keeps the frames of a video that is not encoded yet


@dataclass(frozen=True)
class Part:
    """Frames of a video, or of a folder with an image for each frame."""

    path: Path
    start: int
    length: int


@dataclass
class FoundEpisode:
    """An episode whose frames were found.

    Attributes:
        videos: for each camera what shows it.
        has_row: whether a readable row of ``meta/episodes`` is about it.
    """

    number: int
    table: pa.Table
    videos: dict[str, Part] = field(default_factory=dict)
    has_row: bool = False


class Videos:
    """Videos and loose frames below a root.

    Where a row of ``meta/episodes`` is left, it states where the episode is. Episodes without one come after those with
    one, in videos of their own; these hold whole episodes in the order of their numbers, one after the other, so their
    lengths say where each is. Where that does not come out even, no episode gets a video that may be another's.
    """

    def __init__(self, root: Path, info: dict[str, Any], rows: Mapping[int, Row]) -> None:
        self._root, self._fps, self._rows = root, Fraction(info["fps"]), rows
        self._features, self._chunks = info["features"], info.get("chunks_size") or layout.CHUNKS_SIZE
        self._keys = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
        self._frames: dict[Path, tuple[int, str]] = {}
        self._whole_copies: dict[Path, Path] = {}

    def assign(self, found: Sequence[FoundEpisode], findings: Findings, *, is_torn: bool) -> list[FoundEpisode]:
        """Find the video of every episode, and return the episodes whose videos are complete."""
        for episode in found:
            episode.has_row = self._rows.get(episode.number, {}).get("length") == episode.table.num_rows
        found, certain = self._without_repeated(found, findings)
        with_row = [episode for episode in found if episode.has_row]
        without_row = [episode for episode in found if not episode.has_row]
        for key in self._keys:
            for episode in with_row:
                row = self._rows[episode.number]
                if wrong_part(row, key):
                    continue  # a camera that these rows do not have
                path = self._root / layout.video_file(key, slot_of(row, f"videos/{key}"))
                start = round(row[f"videos/{key}/from_timestamp"] * self._fps)
                if start + episode.table.num_rows <= self._whole(path, findings)[0]:
                    episode.videos[key] = Part(self._whole_copies.get(path, path), start, episode.table.num_rows)
            self._assign(key, without_row, findings, certain=certain, is_torn=is_torn)
        recovered = []
        for episode in found:
            missing = [key for key in self._keys if key not in episode.videos]
            if missing:
                findings.error("video", f"episode {episode.number}", f"no whole video of {', '.join(missing)}")
            else:
                recovered.append(episode)
        return recovered

    def _without_repeated(self, found: Sequence[FoundEpisode], findings: Findings) -> tuple[list[FoundEpisode], int]:
        """Return each episode once, and how many of those without a row have videos at known places.

        An episode whose save failed and that was recorded again is stored twice under one number. The last one counts.
        No file reports whether a video shows the first one, too.
        """
        last = {episode.number: episode for episode in found}
        once = [episode for episode in found if last[episode.number] is episode]
        expected = max(self._rows, default=-1) + 1
        repeated = {episode.number for episode in found if last[episode.number] is not episode}
        for number in sorted(repeated):
            findings.error("counts", f"episode {number}", "a first attempt, which was recorded again")
        certain = 0
        for episode in (episode for episode in once if not episode.has_row):
            if episode.number != expected + certain or episode.number in repeated:
                break
            certain += 1
        return once, certain

    def _assign(
        self, key: str, without_row: Sequence[FoundEpisode], findings: Findings, *, certain: int, is_torn: bool
    ) -> None:
        waiting = list(without_row[:certain])
        for path in self._following(key, findings) if waiting else []:
            frames, problem = self._whole(path, findings)
            taken: list[FoundEpisode] = []
            start = 0
            while waiting and start + waiting[0].table.num_rows <= frames:
                episode = waiting.pop(0)
                episode.videos[key] = Part(self._whole_copies.get(path, path), start, episode.table.num_rows)
                taken.append(episode)
                start += episode.table.num_rows
            if start < frames and not problem and not (is_torn or len(without_row) > certain):
                what = f"its {frames} frames are not those of whole episodes, so their episodes are unknown"
                findings.error("video", path.relative_to(self._root).as_posix(), what)
                for episode in taken:
                    del episode.videos[key]
                break
            if problem and waiting:
                break  # what videos after a torn one show is not certain
        for episode in without_row:
            if key not in episode.videos:
                self._find_unjoined(key, episode, is_last=episode is without_row[-1])

    def _following(self, key: str, findings: Findings) -> Iterator[Path]:
        """Yield the videos after those of the readable rows, as long as their numbers have no gap."""
        slots = [slot_of(row, f"videos/{key}") for row in self._rows.values() if not wrong_part(row, key)]
        slot: layout.Slot | None = max(slots, default=None)
        seen = {self._root / layout.video_file(key, place) for place in slots}
        while True:
            slot = layout.next_slot(slot, self._chunks)
            path = self._root / layout.video_file(key, slot)
            if not path.exists():
                break
            seen.add(path)
            yield path
        others = sorted(set((self._root / "videos" / key).glob("chunk-*/file-*.mp4")) - seen)
        if others:
            names = ", ".join(path.relative_to(self._root).as_posix() for path in others[:3])
            findings.error("video", names, "an earlier video is missing, so their episodes are unknown")

    def _find_unjoined(self, key: str, episode: FoundEpisode, *, is_last: bool) -> None:
        """Find a video that was not joined yet, or images that were not encoded yet."""
        names = [f"tmp*/{key}_{episode.number:03d}.mp4", *([f"tmp*/{key}_streaming.mp4"] if is_last else [])]
        length = episode.table.num_rows
        for path in (path for name in names for path in sorted(self._root.glob(name))):
            if whole_frames(path) == (length, ""):
                self._frames[path] = (length, "")
                episode.videos[key] = Part(path, 0, length)
                return
        folder = self._root / _FRAMES.format(key=key, episode=episode.number)
        if _are_whole(folder, length):
            episode.videos[key] = Part(folder, 0, length)

    def _whole(self, path: Path, findings: Findings) -> tuple[int, str]:
        if path not in self._frames:
            found = whole_frames(path)
            if found[1] and (copy := _being_moved(path)) is not None:
                self._whole_copies[path] = copy
                found = self._frames[copy] = whole_frames(copy)
            self._frames[path] = found
            if found[1]:
                name = path.relative_to(self._root).as_posix()
                findings.error("video", name, f"everything from frame {found[0]} on: {found[1]}")
        return self._frames[path]

    def write(
        self, recovered: Sequence[FoundEpisode], rows: Sequence[Row], info: dict[str, Any], new: Path, disk: Disk
    ) -> None:
        """Write the videos of the recovered dataset, and into `rows` where each episode is in them.

        A video of which all is needed stays as it is; of another the frames of these episodes are kept.
        """
        for key in self._keys:
            slot: layout.Slot | None = None
            for path in dict.fromkeys(episode.videos[key].path for episode in recovered):
                members = [
                    (episode, row)
                    for episode, row in zip(recovered, rows, strict=True)
                    if episode.videos[key].path == path
                ]
                slot = layout.next_slot(slot, info["chunks_size"])
                target = new / layout.video_file(key, slot)
                disk.make_folder(target.parent)
                spans = [(episode.videos[key].start, episode.videos[key].length) for episode, _ in members]
                if path.is_dir():
                    encode(path, target, spans[0][1], self._fps, self._features[key])
                    starts = [0]
                elif (cut := cut_out(path, target, spans, self._frames[path], self._fps)) is not None:
                    starts = cut
                else:
                    disk.copy(path, target)
                    starts = [start for start, _ in spans]
                for (episode, row), start in zip(members, starts, strict=True):
                    row.update(slot_columns(f"videos/{key}", slot))
                    row[f"videos/{key}/from_timestamp"] = float(start / self._fps)
                    row[f"videos/{key}/to_timestamp"] = float((start + episode.table.num_rows) / self._fps)
            if "info" not in info["features"][key] and slot is not None:
                first = new / layout.video_file(key, (0, 0))
                info["features"][key]["info"] = video.video_info(first, video.VideoSettings())


def _being_moved(path: Path) -> Path | None:
    """Return the video that `path` is the beginning of.

    LeRobot joins videos in the folder for temporary files and moves the result. On another file system that is a copy,
    and a kill leaves the beginning of it, with the whole beside.
    """
    begin = path.read_bytes() if path.is_file() else b""
    for other in sorted(Path(tempfile.gettempdir()).glob("*.mp4")) if begin else []:
        if not _is_own(other):  # that folder is everybody's
            continue
        with contextlib.suppress(OSError), open(other, "rb") as file:
            if other.stat().st_size > len(begin) and file.read(len(begin)) == begin and not whole_frames(other)[1]:
                return other
    return None


def _is_own(path: Path) -> bool:
    """Return whether a path is a plain file of this user, and no link, pipe or file of another user."""
    try:
        about = path.lstat()
    except OSError:
        return False
    return stat.S_ISREG(about.st_mode) and about.st_uid == os.getuid()


def whole_frames(path: Path) -> tuple[int, str]:
    """Return how many frames from the first on can be decoded, and what is wrong with the next one, if anything."""
    import av

    frames = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            for packet in container.demux(stream):
                if packet.is_corrupt:
                    return frames, "the video is cut off"
                for frame in packet.decode():
                    if getattr(frame, "is_corrupt", False):
                        return frames, "the video is damaged"
                    frames += 1
            if stream.frames and frames < stream.frames:
                return frames, f"the video is cut off; it had {stream.frames} frames"
    except (av.error.FFmpegError, IndexError) as error:
        return frames, " ".join(str(error).split())
    return frames, ""


def _are_whole(folder: Path, length: int) -> bool:
    """Return whether a folder has a readable image for each of `length` frames."""
    from PIL import Image

    for frame in range(length):
        try:
            with Image.open(folder / f"frame-{frame:06d}.png") as image:
                image.load()
        except (OSError, SyntaxError):
            return False
    return True
