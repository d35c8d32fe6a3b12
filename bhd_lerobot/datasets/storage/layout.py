"""Where the files of a dataset lie: LeRobot's v3.0 layout and our own names."""

from pathlib import Path

CODEBASE_VERSION = "v3.0"

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
IDENTITY = "meta/bhd.json"
"""The identity of the recording; it exists only in datasets of this package."""

UNREPORTED = "meta/bhd_unreported.json"
"""The last edit, until its report has been printed."""

SUBSET = "meta/bhd_subset.json"
"""The episodes of a dataset that were pulled, if files of others are missing. It is never uploaded."""

STAGING = ".bhd"
"""Folder inside the root that holds everything unfinished. It is absent from a finalised dataset."""

CHUNK_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{CHUNK_FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{CHUNK_FILE}.mp4"
EPISODES_PATH = f"meta/episodes/{CHUNK_FILE}.parquet"

CHUNKS_SIZE = 1000
DATA_FILES_SIZE_IN_MB = 100
VIDEO_FILES_SIZE_IN_MB = 200

Slot = tuple[int, int]
"""(chunk index, file index): how LeRobot numbers the files of one kind."""


def next_slot(slot: Slot | None, chunks_size: int) -> Slot:
    """Return the slot after `slot`, or the first one if `slot` is None.

    A chunk has at most 1000 files, whatever `chunks_size` says: LeRobot sorts their names, and file-1000 comes before
    file-999.
    """
    if slot is None:
        return 0, 0
    chunk, file = slot
    return (chunk, file + 1) if file + 1 < min(chunks_size, CHUNKS_SIZE) else (chunk + 1, 0)


def data_file(slot: Slot) -> str:
    """Return the path of a data file, relative to the root."""
    return DATA_PATH.format(chunk_index=slot[0], file_index=slot[1])


def episodes_file(slot: Slot) -> str:
    """Return the path of an episode-metadata file, relative to the root."""
    return EPISODES_PATH.format(chunk_index=slot[0], file_index=slot[1])


def video_file(key: str, slot: Slot) -> str:
    """Return the path of a video file of camera feature `key`, relative to the root."""
    return VIDEO_PATH.format(video_key=key, chunk_index=slot[0], file_index=slot[1])


def slot_in(path: Path) -> Slot:
    """Return the numbers in the name of a file of this layout."""
    slot = int(path.parent.name.removeprefix("chunk-")), int(path.stem.removeprefix("file-"))
    if CHUNK_FILE.format(chunk_index=slot[0], file_index=slot[1]) != f"{path.parent.name}/{path.stem}":
        raise ValueError(f"{path.parent.name}/{path.stem} is not the name of a chunk and a file")
    return slot


CHUNKS = "chunk-*/file-*"
"""Pattern of the names of data, video and episode-metadata files, without suffix."""


def recorded_files(root: Path) -> set[str]:
    """Return every data, video and episode-metadata file below `root`, as relative POSIX paths.

    Only names that fit the layout are returned, so other files beside them are never touched.
    """
    patterns = (f"data/{CHUNKS}.parquet", f"meta/episodes/{CHUNKS}.parquet", f"videos/*/{CHUNKS}.mp4")
    return {path.relative_to(root).as_posix() for pattern in patterns for path in root.glob(pattern)}


def aside_of(root: Path) -> Path:
    """Return a new place beside `root` for its damaged files."""
    number = 1
    while (aside := root.with_name(f"{root.name}.damaged-{number}")).exists():
        number += 1
    return aside
