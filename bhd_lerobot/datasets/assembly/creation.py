"""An empty dataset, which appears on disk complete or not at all."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import building, is_free
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.errors import DatasetError, DatasetExistsError, DatasetLockedError

_RESUME = "Resume it (--resume=true), remove it"  # what can be done if a dataset to be recorded is there


def new_info(fps: int, schema: Schema, robot_type: str) -> dict[str, Any]:
    """Return the content of ``info.json`` before the first episode."""
    return {
        "codebase_version": layout.CODEBASE_VERSION,
        "fps": fps,
        "features": {key: {**feature, "shape": list(feature["shape"])} for key, feature in schema.features.items()},
        "total_episodes": 0,
        "total_frames": 0,
        "total_tasks": 0,
        "chunks_size": layout.CHUNKS_SIZE,
        "data_files_size_in_mb": layout.DATA_FILES_SIZE_IN_MB,
        "video_files_size_in_mb": layout.VIDEO_FILES_SIZE_IN_MB,
        "data_path": layout.DATA_PATH,
        "video_path": layout.VIDEO_PATH if schema.videos else None,
        "robot_type": robot_type,
        "splits": {},
    }


def create_root(root: Path, info: Mapping[str, Any], identity: Mapping[str, Any], disk: Disk) -> RootLock:
    """Create an empty dataset beside its place, rename it to it, and return the lock on it."""

    def fill(building: Path) -> None:
        disk.make_folder(building / "meta")
        disk.write(building / layout.INFO, to_json(info))
        disk.write(building / layout.IDENTITY, to_json(identity))

    return build_root(root, fill, disk)


def build_root(root: Path, fill: Callable[[Path], None], disk: Disk, remedy: str = _RESUME) -> RootLock:
    """Build a dataset beside its place, put it there, and return the lock on it."""

    def refuse() -> None:
        if not is_free(root):
            raise _exists(root, remedy)

    lock: RootLock | None = None
    try:
        with (
            write_errors("create the dataset", root, "Nothing was written there."),
            building(root, disk, refuse) as space,
        ):
            lock = space.lock_new()
            fill(space.folder)
    except BaseException:
        if lock is not None:
            lock.release()
        raise
    return lock


def _exists(root: Path, remedy: str) -> DatasetError:
    """Return what is in the way of a new dataset; for a recorder also that another one is at work there."""
    if not root.is_dir():
        return DatasetExistsError(f"{root} is not a folder, but a file or a broken link. Choose another root.")
    if remedy == _RESUME:
        try:
            RootLock(root, is_choice=True, is_shared=True).release()
        except DatasetLockedError as error:
            return error
        except OSError:  # the folder may not be read
            pass
    return DatasetExistsError(f"{root} exists already. {remedy}, or choose another root.")
