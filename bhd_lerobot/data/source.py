"""Where a dataset comes from: from this machine if it is there, else from the Hub, as LeRobot does it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bhd_lerobot.data import layout
from bhd_lerobot.errors import BhdError, DatasetError

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def local_metadata(
    repo_id: str,
    root: Path | str | None = None,
    revision: str | None = None,
    episodes: Sequence[int] | None = None,
) -> "LeRobotDatasetMetadata":
    """Return the metadata of a dataset all of whose wanted files are on this machine, downloading what is not.

    Args:
        repo_id: name of the dataset.
        root: its folder; None looks where LeRobot keeps datasets.
        revision: version on the Hub, if it has to be downloaded.
        episodes: the episodes whose files are wanted; None wants all.

    Raises:
        DatasetError: it is not on this machine, and downloading it failed.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.constants import HF_LEROBOT_HOME

    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    try:
        meta = LeRobotDatasetMetadata(repo_id, root=root, revision=revision)
        if _missing(meta, episodes):
            meta = LeRobotDataset(repo_id, root=root, revision=revision, episodes=_listed(episodes)).meta
    except BhdError:
        raise
    except Exception as error:  # of the Hub's client, of the network, of LeRobot: all mean that it is not there
        if (folder / layout.INFO).is_file():
            found = "cannot be read"
        elif folder.is_dir():
            found = "has no meta/info.json"
        else:
            found = "does not exist"
        reason = " ".join(str(error).split())
        raise DatasetError(
            f"There is no complete dataset {repo_id!r}: {folder} {found}, and it could not be fetched from the Hub "
            f"({type(error).__name__}: {reason[:300]}). Check dataset.root and dataset.repo_id, or record it first."
        ) from error
    return meta


def _missing(meta: "LeRobotDatasetMetadata", episodes: Sequence[int] | None) -> list[Path]:
    """Return the files of some episodes that are not there; none if an episode does not exist, which others report."""
    total = meta.total_episodes
    wanted = range(total) if episodes is None else sorted(set(episodes))
    if meta.episodes is None or any(not 0 <= episode < total for episode in wanted):
        return []
    patterns = {"data": meta.data_path}
    for key in meta.video_keys:
        patterns[f"videos/{key}"] = (meta.video_path or layout.VIDEO_PATH).replace("{video_key}", key)
    paths = set()
    for kind, pattern in patterns.items():
        chunks, files = meta.episodes[f"{kind}/chunk_index"], meta.episodes[f"{kind}/file_index"]
        paths |= {pattern.format(chunk_index=chunks[e], file_index=files[e]) for e in wanted}
    return sorted(meta.root / path for path in paths if not (meta.root / path).is_file())


def _listed(episodes: Sequence[int] | None) -> list[int] | None:
    return None if episodes is None else [int(episode) for episode in episodes]
