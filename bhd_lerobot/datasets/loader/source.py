"""Where a dataset comes from: from this machine if it is there, else from the Hub, as LeRobot does it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bhd_lerobot.datasets.remote.errors import explain
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import complete_interrupted
from bhd_lerobot.datasets.storage.pointers import check_fetched
from bhd_lerobot.errors import BhdError, ConfigError, DatasetError

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata


def local_metadata(
    repo_id: str,
    root: Path | str | None = None,
    revision: str | None = None,
    episodes: Sequence[int] | None = None,
    select: "Callable[[LeRobotDatasetMetadata], Sequence[int]] | None" = None,
) -> "LeRobotDatasetMetadata":
    """Return the metadata of a dataset all of whose wanted files are on this machine, downloading what is not.

    Args:
        root: its folder; None looks where LeRobot keeps datasets.
        select: chooses the episodes by the metadata, for example those of an outcome; only their files are downloaded.
    """
    from lerobot.utils.constants import HF_LEROBOT_HOME

    from bhd_lerobot.datasets.loader.metadata import Metadata
    from bhd_lerobot.datasets.loader.table import checked
    from bhd_lerobot.stock import LeRobotDataset

    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if revision is not None and (folder / layout.INFO).is_file() and not (folder / ".cache/huggingface").is_dir():
        raise ConfigError(
            f"Revision {revision!r} of {repo_id} is asked for, but {folder} holds a dataset of unknown revision, which "
            "LeRobot would use in any case. Leave the revision out, or name another root."
        )
    complete_interrupted(folder)
    try:
        meta = checked(Metadata(repo_id, root=root, revision=revision))
        wanted = episodes if select is None else select(meta)
        if _missing(meta, wanted):
            meta = checked(LeRobotDataset(repo_id, root=root, revision=revision, episodes=_listed(wanted)).meta)
    except BhdError:
        raise
    except Exception as error:  # of the Hub's client, of the network, of LeRobot: all mean that it is not there
        check_fetched(folder)
        if (folder / layout.INFO).is_file():
            found = "cannot be read"
        elif folder.is_dir():
            found = "has no meta/info.json"
        else:
            found = "does not exist"
        raise DatasetError(
            f"There is no complete dataset {repo_id!r}: {folder} {found}, and it could not be fetched from the Hub: "
            f"{explain(error, repo_id, revision)} Check dataset.root and dataset.repo_id, or record it first."
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
