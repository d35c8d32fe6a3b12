"""All columns of a LeRobot dataset in memory, as tensors, in the order in which LeRobot numbers the samples."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from bhd_lerobot.datasets.format.columns import flat
from bhd_lerobot.datasets.format.expected import wrong_array
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.format.state import corrupt, load_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import complete_interrupted
from bhd_lerobot.datasets.storage.places import wrong_info
from bhd_lerobot.errors import DatasetError, unknown_name

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata

_TEXT = "string"


def open_metadata(root: Path | str) -> "LeRobotDatasetMetadata":
    """Return LeRobot's metadata of a dataset on this machine; nothing is downloaded."""
    root = Path(root)
    complete_interrupted(root)
    if not (root / layout.INFO).is_file():
        found = "has no meta/info.json" if root.is_dir() else "does not exist"
        raise DatasetError(f"{root} is not a LeRobot dataset: it {found}. Record one with bhd-record.")
    load_info(root)  # states what is wrong with it, which LeRobot does not
    from bhd_lerobot.datasets.loader.metadata import Metadata  # seconds to import

    return checked(Metadata(root.name, root=root))


def checked(meta: "LeRobotDatasetMetadata") -> "LeRobotDatasetMetadata":
    """Return LeRobot's metadata if no name in them leads out of the dataset, with all rows by their numbers.

    LeRobot takes row i for instruction i, and for episode i.
    """
    templates = {"data_path": meta.data_path, "video_path": meta.video_path}
    if wrong := wrong_info({"features": meta.features, **templates}):
        raise corrupt(Path(meta.root) / layout.INFO, wrong)
    if meta.tasks is not None:
        meta.tasks = meta.tasks.sort_values("task_index")
        if not np.array_equal(meta.tasks["task_index"], np.arange(len(meta.tasks))):
            raise corrupt(meta.root / layout.TASKS, f"its numbers are not 0 to {len(meta.tasks) - 1}, each once")
    if meta.episodes is not None:
        numbers = np.asarray(meta.episodes["episode_index"])
        order = np.argsort(numbers, kind="stable")
        if not np.array_equal(numbers[order][: meta.total_episodes], np.arange(meta.total_episodes)):
            raise corrupt(meta.root / "meta/episodes", f"it does not describe episodes 0 to {meta.total_episodes - 1}")
        if not np.array_equal(order, np.arange(len(order))):
            meta.episodes = meta.episodes.select(order)
    return meta


class FrameTable:
    """The frames of a dataset, or of some of its episodes, one tensor for every column.

    Rows are in the order of the data files, which is how `LeRobotDataset` numbers its samples. Values have the type
    that LeRobot gives them: all floats float32, all integers int64, bool. Videos are not here.

    Attributes:
        columns: key -> tensor of shape (N, ...); a feature of shape (1,) is a column of shape (N,).
        texts: key -> array of N strings.
        nested: key -> Arrow column of N lists (LeRobot's language columns).
        images: key -> Arrow column of N encoded images (features of dtype "image").
        episodes: indices of the episodes, in the order of their rows.
        starts, lengths: first row and number of rows of each of them, shape (E,), int64.
        first, last: first and last row of the episode that a row belongs to, shape (N,), int64.
    """

    def __init__(self, meta: "LeRobotDatasetMetadata", table: pa.Table, keys: Sequence[str]) -> None:
        """Convert an Arrow table; see `open`."""
        self.meta = meta
        self.keys = list(keys)
        self.columns: dict[str, Tensor] = {}
        self.texts: dict[str, np.ndarray] = {}
        self.nested: dict[str, pa.ChunkedArray] = {}
        self.images: dict[str, pa.ChunkedArray] = {}
        for key in keys:
            feature = meta.features[key]
            if feature["dtype"] == "image":
                self.images[key] = table[key]
            elif feature["dtype"] == "language":
                self.nested[key] = table[key]
            elif feature["dtype"] == _TEXT:
                self.texts[key] = _texts(key, table[key])
            else:
                self.columns[key] = _tensor(key, table[key], tuple(feature["shape"]))
        self._index_episodes()

    @classmethod
    def open(
        cls,
        meta_or_root: "LeRobotDatasetMetadata | Path | str",
        episodes: Sequence[int] | None = None,
        keys: Collection[str] | None = None,
        sources: Mapping[str, str] | None = None,
    ) -> "FrameTable":
        """Read the data files of a dataset on this machine.

        Args:
            keys: features to read besides LeRobot's index columns; None reads all. Videos are skipped.
            sources: features whose values are read from another column of the same shape, by name.
        """
        meta = open_metadata(meta_or_root) if isinstance(meta_or_root, str | Path) else meta_or_root
        wanted = checked_episodes(meta, episodes)
        unknown = [key for key in keys or () if key not in meta.features]
        if unknown:
            raise DatasetError(f"{meta.root}: {unknown_name('feature', unknown[0], meta.features)}")
        stored = [
            key
            for key, feature in meta.features.items()
            if feature["dtype"] != "video" and (keys is None or key in keys or key in DEFAULT_FEATURES)
        ]
        return cls(meta, _read(meta, wanted, stored, sources or {}), stored)

    def __len__(self) -> int:
        return len(self.first)

    @property
    def nbytes(self) -> int:
        """Bytes that the tensors take."""
        return sum(column.nbytes for column in self.columns.values())

    def rows(self, episode: int) -> slice:
        """Return the rows of an episode."""
        if episode not in self._position:
            raise DatasetError(f"{self.meta.root}: episode {episode} is not among {_short(self.episodes)}.")
        start = int(self.starts[self._position[episode]])
        return slice(start, start + int(self.lengths[self._position[episode]]))

    def place(self, row: int) -> str:
        """Return as text which episode and frame a row is."""
        return f"episode {int(self.columns['episode_index'][row])}, frame {int(self.columns['frame_index'][row])}"

    def _index_episodes(self) -> None:
        of_row = self.columns["episode_index"].numpy()
        index = self.columns["index"].numpy()
        starts = np.concatenate([[0], np.flatnonzero(np.diff(of_row)) + 1])
        lengths = np.diff(np.append(starts, len(of_row)))
        self.episodes = [int(episode) for episode in of_row[starts]]
        self._position = {episode: position for position, episode in enumerate(self.episodes)}
        begin = np.asarray(self.meta.episodes["dataset_from_index"], dtype=np.int64)[self.episodes]
        end = np.asarray(self.meta.episodes["dataset_to_index"], dtype=np.int64)[self.episodes]
        offset = np.arange(len(of_row)) - np.repeat(starts, lengths)
        whole = np.array_equal(end - begin, lengths) and np.array_equal(index, np.repeat(begin, lengths) + offset)
        if not whole or len(self._position) != len(self.episodes):
            raise corrupt(self.meta.root / "data", "the frames of the data files do not match meta/episodes")
        self.starts, self.lengths = torch.from_numpy(starts), torch.from_numpy(lengths)
        self.first = torch.repeat_interleave(self.starts, self.lengths)
        self.last = self.first + torch.repeat_interleave(self.lengths, self.lengths) - 1


def checked_episodes(meta: Any, episodes: Sequence[int] | None) -> list[int]:
    """Return the wanted episodes, sorted and each once."""
    total = meta.total_episodes
    if not total or not meta.total_frames or meta.episodes is None:
        raise DatasetError(f"{meta.root} has no episode, so there is nothing to load. Record some with bhd-record.")
    if episodes is None:
        return list(range(total))
    wanted = sorted({int(episode) for episode in episodes})
    if not wanted:
        raise DatasetError(f"No episode of {meta.root} was asked for; it has {total}, from 0 to {total - 1}.")
    wrong = [episode for episode in wanted if not 0 <= episode < total]
    if wrong:
        raise DatasetError(f"There is no episode {wrong[0]} in {meta.root}; it has {total}, from 0 to {total - 1}.")
    return wanted


def _read(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int], features: Sequence[str], sources: Mapping[str, str]
) -> pa.Table:
    keys = list(dict.fromkeys(sources.get(key, key) for key in features))
    chunks, files = meta.episodes["data/chunk_index"], meta.episodes["data/file_index"]
    slots = {(chunks[episode], files[episode]) for episode in episodes}
    paths = sorted(meta.root / meta.data_path.format(chunk_index=chunk, file_index=file) for chunk, file in slots)
    wanted = np.asarray(episodes)
    parts = []
    for path in paths:
        try:
            part = pq.ParquetFile(path, page_checksum_verification=True).read(columns=list(keys))
        except (OSError, pa.ArrowException) as error:
            raise corrupt(path, error) from error
        missing = [key for key in keys if key not in part.column_names]
        if missing:
            raise corrupt(path, f"it has no column {missing[0]!r}, which meta/info.json lists")
        mask = np.isin(part["episode_index"].to_numpy(), wanted)
        parts.append(part if mask.all() else part.filter(pa.array(mask)))
    # Files of several writers may describe the same column with other field names.
    parts = [part.select(list(keys)).replace_schema_metadata(None) for part in parts]
    if any(part.schema != parts[0].schema for part in parts):
        parts = [part.cast(parts[0].schema) for part in parts]
    table = pa.concat_tables(parts)
    found = np.unique(table["episode_index"].to_numpy())
    lost = np.setdiff1d(wanted, found)
    if len(lost):
        raise corrupt(meta.root / "data", f"episode {lost[0]} is in none of its files")
    return pa.table({key: table[sources.get(key, key)] for key in features})


def _tensor(key: str, column: pa.ChunkedArray, shape: tuple[int, ...]) -> Tensor:
    """Return a column as LeRobot's samples have it: through Python's numbers, so float32, int64 or bool."""
    if wrong := next(filter(None, map(wrong_array, column.chunks)), ""):
        raise DatasetError(f"Column {key!r} cannot be learned from: {wrong}.")
    rows, array = len(column), flat(column)
    values = array.to_numpy(zero_copy_only=False)
    kinds: Mapping[str, Any] = {"f": np.float32, "i": np.int64, "u": np.int64, "b": np.bool_}
    if values.dtype.kind not in kinds:
        raise DatasetError(f"Column {key!r} holds {array.type}, which is neither number nor text.")
    row_shape = () if shape == (1,) else shape
    if values.size != rows * int(np.prod(row_shape)):
        raise DatasetError(f"Column {key!r} has {values.size} values in {rows} frames; its shape is {shape}.")
    return torch.from_numpy(np.array(values, dtype=kinds[values.dtype.kind])).reshape(rows, *row_shape)


def _texts(key: str, column: pa.ChunkedArray) -> np.ndarray:
    if column.null_count:
        raise DatasetError(f"Column {key!r} has {column.null_count} missing texts.")
    texts = np.empty(len(column), dtype=object)
    texts[:] = column.to_pylist()
    return texts


def _short(episodes: Sequence[int]) -> str:
    shown = ", ".join(map(str, episodes[:8]))
    return f"{shown}, … ({len(episodes)} episodes)" if len(episodes) > 8 else shown
