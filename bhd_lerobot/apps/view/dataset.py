"""A dataset behind the page: read once, and again when its files have changed."""

import hashlib
import json
import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from bhd_lerobot.apps.view.download import to_csv, to_video
from bhd_lerobot.apps.view.episode import packed_episode
from bhd_lerobot.apps.view.marking import mark_episode
from bhd_lerobot.datasets.edit.mark import possible_outcomes
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import episode_frames, row_of
from bhd_lerobot.datasets.format.episode_table import PREFIX
from bhd_lerobot.datasets.format.state import DatasetState, Row, corrupt, load_state, slot_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.datasets.storage.places import check_inside
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.tasks.task import OUTCOMES

_CACHED_BYTES = 128 * 2**20  # of packed episodes: some hundred of an arm, enough to go back and forth
# What LeRobot counts with; the page knows it without the column.
_COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True)
class _Content:
    """What was read, the stamp of the files that it was read from, and what the page knows of all episodes."""

    state: DatasetState
    stamp: str
    summary: dict[str, Any]


class ViewedDataset:
    """The dataset behind the page. Every method may be called from any thread.

    Raises:
        DatasetError: there is no dataset, it is being written, or a file is missing or cannot be read.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._lock = threading.Lock()
        self._packed: OrderedDict[int, bytes] = OrderedDict()  # of the content
        self._content = self._read()

    def _read(self) -> _Content:
        info = self.root / layout.INFO
        if info.is_file():
            RootLock(self.root, is_shared=True).release()
        stamp = stamp_of(self.root)
        try:
            state = load_state(self.root, videos=False)  # a missing video is reported in its place on the page
            if not state.info["fps"] > 0:
                raise corrupt(info, f"its fps is {state.info['fps']!r}")
            return _Content(state, stamp, _summary(state, stamp))
        except (AttributeError, KeyError, TypeError) as error:  # JSON, but of another shape
            raise corrupt(info, f"it does not describe a dataset ({type(error).__name__}: {error})") from error

    @property
    def stamp(self) -> str:
        """The stamp of the files that were read; another one than `stamp_of` gives once they have changed."""
        return self._content.stamp

    @property
    def state(self) -> DatasetState:
        """What was read."""
        return self._content.state

    def reload(self) -> None:
        """Read the dataset again if its files have changed; if that fails, what was read before stays."""
        with self._lock:
            if stamp_of(self.root) != self._content.stamp:
                self._content = self._read()
                self._packed.clear()

    def _unchanged(self, stamp: str | None) -> DatasetState:
        """Return what was read if it is what is on disk, and what a page shows that was sent with this stamp.

        Several pages may show the dataset, of which one has loaded it again and the others have not. To be called while
        the lock is held.
        """
        content = self._content
        if stamp_of(self.root) != content.stamp or stamp not in (None, content.stamp):
            raise DatasetError(
                f"{self.root} has changed on disk since it was read, so an episode may have another number now. "
                "Load it again."
            )
        return content.state

    def summary(self) -> dict[str, Any]:
        """Return what the page knows of all episodes, column by column."""
        return self._content.summary

    def packed(self, index: int, stamp: str | None = None) -> bytes:
        """Return an episode as `packing` makes bytes of it; raise a `DatasetError` if it cannot be read as it was."""
        with self._lock:  # one reader at a time: two processors are not made faster by ten
            state = self._unchanged(stamp)
            if index in self._packed:
                self._packed.move_to_end(index)
                return self._packed[index]
            row = row_of(state, index)
            packed = packed_episode(state, row, _table(state, row))
            self._packed[index] = packed
            while sum(map(len, self._packed.values())) > _CACHED_BYTES and len(self._packed) > 1:
                self._packed.popitem(last=False)
            return packed

    def mark(self, index: int, wanted: Any, stamp: str | None = None) -> None:
        """Mark an episode, and read the dataset again; see `mark_episode`."""
        with self._lock:
            self._unchanged(stamp)
            mark_episode(self.root, index, wanted)
            self._content = self._read()
            self._packed.clear()

    def video(self, key: str, slot: layout.Slot) -> Path | None:
        """Return the file of a camera's video, or None if there is no such camera or file.

        Raises:
            DatasetError: a link leads out of the dataset. It is checked each time: links can be made meanwhile.
        """
        if key not in self.state.video_keys:
            return None
        path = check_inside(self.root, self.root / layout.video_file(key, slot))
        return path if path.is_file() else None

    def download(self, index: int, key: str | None, stamp: str | None = None) -> bytes | None:
        """Return an episode's numbers as CSV, or a camera's video of it as MP4; None if there is no such video."""
        with self._lock:
            state = self._unchanged(stamp)
            row = row_of(state, index)
            if key is None:
                return to_csv(state, _table(state, row))
            path = self.video(key, slot_of(row, f"videos/{key}")) if key in state.video_keys else None
            if path is None:
                return None
            span = row[f"videos/{key}/from_timestamp"], row[f"videos/{key}/to_timestamp"]
            return to_video(path, span, row["length"], state.info["fps"])

    def image(self, index: int, key: str, frame: int, stamp: str | None = None) -> bytes | None:
        """Return the image of a camera whose images lie in the data files, or None if there is no such image."""
        with self._lock:
            state = self._unchanged(stamp)
            feature, row = state.info["features"].get(key), row_of(state, index)
            if feature is None or feature["dtype"] != "image" or not 0 <= frame < row["length"]:
                return None
            stored = episode_frames(state, row, [key])[key][frame].as_py() or {}
        if stored.get("bytes"):
            return bytes(stored["bytes"])
        if not stored.get("path"):
            return None
        beside = check_inside(self.root, self.root / stored["path"])
        return beside.read_bytes() if beside.is_file() else None


def stamp_of(root: Path) -> str:
    """Return what changes with every episode that is recorded, marked or removed; empty if there is no dataset.

    Every writer replaces ``info.json`` last, or a file of ``meta/episodes``; both count.
    """
    digest = hashlib.blake2b(digest_size=12)
    found = False
    for path in [root / layout.INFO, *sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet"))]:
        try:
            about = path.stat()
        except OSError:
            continue
        found = True
        digest.update(f"{path.name} {about.st_mtime_ns} {about.st_size} {about.st_ino}\n".encode())
    return digest.hexdigest() if found else ""


def _summary(state: DatasetState, stamp: str) -> dict[str, Any]:
    tasks: dict[str, int] = {}
    columns: dict[str, list[Any]] = {
        "frames": [row["length"] for row in state.rows],
        "task": [tasks.setdefault(_instruction(row), len(tasks)) for row in state.rows],
        "outcome": [_outcome(row) for row in state.rows],
        "score": [row.get(f"{PREFIX}score") for row in state.rows],
        "late": [_late_frames(row) for row in state.rows],
        "interventions": [_listed(row.get(f"{PREFIX}interventions")) for row in state.rows],
    }
    root = state.root.resolve()
    return {
        "name": root.parent.name if root.name == "dataset" else root.name,
        "root": str(state.root),
        "stamp": stamp,
        "robot": state.info.get("robot_type"),
        "fps": state.info["fps"],
        "frames": state.num_frames,
        "cameras": [_camera(key, feature) for key, feature in state.info["features"].items() if _is_video(feature)],
        "unfinished": (state.root / layout.STAGING).exists(),
        "tasks": list(tasks),
        "outcomes": _possible(state),
        "takes_interventions": keys.EVENT in state.info["features"],
        "episodes": columns,
    }


def _possible(state: DatasetState) -> list[str]:
    """Return the outcomes that some episode can be marked with, in their usual order."""
    possible = {name for row in state.rows for name in possible_outcomes(state, row)}
    return [name for name in OUTCOMES if name in possible]


def _table(state: DatasetState, row: Row) -> pa.Table:
    """Return an episode's columns that are neither images nor counters."""
    features = state.info["features"]
    shown = [key for key, one in features.items() if key not in _COUNTERS and one["dtype"] not in ("image", "video")]
    return episode_frames(state, row, shown).select(shown)


def _instruction(row: Row) -> str:
    return ", ".join(row.get("tasks") or [])


def _outcome(row: Row) -> str:
    """Return how an episode ended; empty if it is not recorded."""
    if row.get(f"{PREFIX}outcome"):
        return str(row[f"{PREFIX}outcome"])
    success = row.get(f"{PREFIX}success")
    return "" if success is None else "success" if success else "failure"


def _late_frames(row: Row) -> int | None:
    try:
        return int(json.loads(row[f"{PREFIX}timing"])["late_frames"])
    except (KeyError, TypeError, ValueError):
        return None


def _listed(text: Any) -> int:
    try:
        return len(json.loads(text))
    except (TypeError, ValueError):
        return 0


def _is_video(feature: dict[str, Any]) -> bool:
    return feature["dtype"] in ("video", "image")


def _camera(key: str, feature: dict[str, Any]) -> dict[str, Any]:
    about = feature.get("info") or feature.get("video_info") or {}
    return {
        "key": key,
        "label": key.removeprefix("observation.images.").removeprefix("observation."),
        "kind": feature["dtype"],
        "codec": about.get("video.codec"),
        "shape": list(feature["shape"]),
    }
