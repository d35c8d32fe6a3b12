"""The films of a wreck: which frames of which film show which episode."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bhd_lerobot.data import layout, video
from bhd_lerobot.data.disk import Disk
from bhd_lerobot.data.state import Row, slot_columns
from bhd_lerobot.data.video_splice import splice

if TYPE_CHECKING:
    from bhd_lerobot.data.salvage import Found

_FRAMES = "images/{key}/episode-{episode:06d}"  # where LeRobot keeps the frames of a film that is not encoded yet


@dataclass(frozen=True)
class Part:
    """Frames of a film.

    Attributes:
        path: the film, or a folder with a picture for each frame.
        start: number of the first frame in it.
        length: how many.
    """

    path: Path
    start: int
    length: int


class Films:
    """Films and loose frames below a root."""

    def __init__(self, root: Path, info: dict[str, Any]) -> None:
        """Look for cameras in ``info.json``."""
        self._root, self._fps = root, int(info["fps"])
        self._features = info["features"]
        self._keys = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
        self._sizes: dict[Path, int] = {}  # frames of the films that are whole

    def assign(self, found: Sequence["Found"], lost: list[str]) -> list["Found"]:
        """Find the film of every episode, and return the episodes that have all of theirs.

        Args:
            found: episodes whose frames are whole, in order.
            lost: lines about what is lost are added here.
        """
        for key in self._keys:
            self._assign(key, found, lost)
        kept = []
        for one in found:
            missing = [key for key in self._keys if key not in one.films]
            if missing:
                lost.append(f"episode {one.number}: no whole film of {', '.join(missing)}")
            else:
                kept.append(one)
        return kept

    def _assign(self, key: str, found: Sequence["Found"], lost: list[str]) -> None:
        waiting = list(found)
        for path in sorted((self._root / "videos" / key).glob("chunk-*/file-*.mp4")):
            frames, problem = whole_frames(path)
            name = path.relative_to(self._root).as_posix()
            if problem:
                lost.append(f"{name}: everything from frame {frames} on: {problem}")
            start = 0
            # A film holds whole episodes, in the order of their numbers, one after the other.
            while waiting and start + waiting[0].table.num_rows <= frames:
                one = waiting.pop(0)
                one.films[key] = Part(path, start, one.table.num_rows)
                start += one.table.num_rows
            if not problem:
                self._sizes[path] = frames
            if start < frames and not problem:
                lost.append(f"{name}: {frames - start} frames at its end that belong to no whole episode")
            if problem and waiting:
                break  # what films after a torn one show is not certain
        for one in waiting:
            folder = self._root / _FRAMES.format(key=key, episode=one.number)
            if _are_whole(folder, one.table.num_rows):
                one.films[key] = Part(folder, 0, one.table.num_rows)

    def write(self, kept: Sequence["Found"], rows: Sequence[Row], info: dict[str, Any], new: Path, disk: Disk) -> None:
        """Write the films of the recovered dataset, and into `rows` where each episode is in them."""
        for key in self._keys:
            slot: layout.Slot | None = None
            for path in dict.fromkeys(one.films[key].path for one in kept):
                members = [(one, row) for one, row in zip(kept, rows, strict=True) if one.films[key].path == path]
                slot = layout.next_slot(slot, info["chunks_size"])
                target = new / layout.video_file(key, slot)
                disk.make_folder(target.parent)
                spans = [(one.films[key].start, one.films[key].length) for one, _ in members]
                if path.is_dir():
                    _encode(path, target, spans[0][1], self._fps, self._features[key])
                    starts = [0]
                elif sum(length for _, length in spans) == self._sizes.get(path):
                    disk.link(path, target)
                    starts = [start for start, _ in spans]
                else:
                    disk.write(target, b"")
                    splice([(path, spans)], target, self._fps)
                    starts = np.concatenate([[0], np.cumsum([n for _, n in spans])[:-1]]).astype(int).tolist()
                for (one, row), start in zip(members, starts, strict=True):
                    row.update(slot_columns(f"videos/{key}", slot))
                    row[f"videos/{key}/from_timestamp"] = start / self._fps
                    row[f"videos/{key}/to_timestamp"] = (start + one.table.num_rows) / self._fps
            if "info" not in info["features"][key] and slot is not None:
                first = new / layout.video_file(key, (0, 0))
                info["features"][key]["info"] = video.video_info(first, video.VideoSettings())


def whole_frames(path: Path) -> tuple[int, str]:
    """Return how many frames from the first on can be decoded, and what is wrong with the next one, if anything."""
    import av

    frames = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            for packet in container.demux(stream):
                if packet.is_corrupt:
                    return frames, "the film is cut off"
                for frame in packet.decode():
                    if getattr(frame, "is_corrupt", False):
                        return frames, "the film is damaged"
                    frames += 1
            if stream.frames and frames < stream.frames:
                return frames, f"the film is cut off; it had {stream.frames} frames"
    except (av.error.FFmpegError, IndexError) as error:
        return frames, " ".join(str(error).split())
    return frames, ""


def _are_whole(folder: Path, length: int) -> bool:
    """Tell whether a folder has a readable picture for each of `length` frames."""
    from PIL import Image

    for frame in range(length):
        try:
            with Image.open(folder / f"frame-{frame:06d}.png") as picture:
                picture.load()
        except (OSError, SyntaxError):
            return False
    return True


def _encode(folder: Path, target: Path, length: int, fps: int, feature: dict[str, Any]) -> None:
    from PIL import Image

    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder tells its life otherwise; 1 leaves errors
    height, width = feature["shape"][:2]
    encoder = video.CameraEncoder(target, fps, (height, width), _settings(feature))
    try:
        for frame in range(length):
            with Image.open(folder / f"frame-{frame:06d}.png") as picture:
                encoder.add(np.asarray(picture.convert("RGB")))
        encoder.finish()
    except BaseException:
        encoder.cancel()
        raise


def _settings(feature: dict[str, Any]) -> video.VideoSettings:
    """Return the settings that the other films were encoded with, as far as this machine has their encoder."""
    told = feature.get("info") or {}
    encoder = {"av1": "libsvtav1", "hevc": "hevc", "h264": "h264"}.get(str(told.get("video.codec")), "h264")
    settings = video.VideoSettings(
        vcodec=encoder, g=told.get("video.g", 2), crf=told.get("video.crf", 23), preset=told.get("video.preset")
    )
    try:
        settings.check()
    except Exception:
        return video.VideoSettings()
    return settings
