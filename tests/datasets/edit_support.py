"""What is in a dataset, episode by episode, read without the code that edits datasets."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.validate.dataset import Severity, check_dataset
from tests.datasets import support

NUMBERS = ("episode_index", "index", "task_index")


@dataclass
class Episode:
    """An episode without the numbers that depend on where it stands."""

    task: list[str]
    metadata: dict[str, Any]
    columns: dict[str, list[Any]]
    videos: dict[str, list[bytes]]


def record(root: Path, episodes: list[int], *, video: bool = False, **options: Any) -> Path:
    """Record some of the episodes of `support`, in this order, and finalise."""
    with support.create(root, video=video, **options) as recorder:
        for episode in episodes:
            writer = support.fill(recorder.begin_episode(), episode, video=video)
            recorder.save(writer, task=support.task(episode), metadata=support.metadata(episode))
    return root


def images(path: Path) -> list[bytes]:
    """Return every decoded frame of a video."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24").tobytes() for frame in container.decode(video=0)]


def content(root: Path) -> list[Episode]:
    """Return the episodes of a dataset, after checking that its numbers count up."""
    tables = [pq.read_table(path) for path in sorted((root / "meta/episodes").glob("*/*.parquet"))]
    names = [name for name in tables[0].column_names if not name.startswith("stats/")]
    light = pa.concat_tables([table.select(names) for table in tables]).to_pylist()
    frames = pa.concat_tables([pq.read_table(p) for p in sorted((root / "data").glob("*/*.parquet"))])
    tasks = pq.read_table(root / "meta/tasks.parquet").to_pydict()
    sentences = dict(zip(tasks["task_index"], tasks["task"], strict=True))
    assert frames["index"].to_pylist() == list(range(frames.num_rows))
    assert [row["episode_index"] for row in light] == list(range(len(light)))
    found, decoded = [], {path: images(path) for path in (root / "videos").glob("*/*/*.mp4")}
    for row in light:
        part = frames.slice(row["dataset_from_index"], row["length"])
        assert set(part["episode_index"].to_pylist()) == {row["episode_index"]}
        assert {sentences[index] for index in part["task_index"].to_pylist()} == set(row["tasks"])
        videos = {}
        for key in [name.split("/")[1] for name in row if name.startswith("videos/") and name.endswith("file_index")]:
            file = "chunk-{:03d}/file-{:03d}.mp4".format(*(row[f"videos/{key}/{n}_index"] for n in ("chunk", "file")))
            start = round(row[f"videos/{key}/from_timestamp"] * support.FPS)
            videos[key] = decoded[root / "videos" / key / file][start : start + row["length"]]
            assert len(videos[key]) == row["length"]
        columns = {name: part[name].to_pylist() for name in part.column_names if name not in NUMBERS}
        found.append(Episode(row["tasks"], {n: v for n, v in row.items() if n.startswith("bhd/")}, columns, videos))
    return found


def assert_valid(root: Path) -> None:
    """Assert that `bhd-data check` finds no error: counts, files, videos, and statistics that are those of the data."""
    found = check_dataset(root, lambda robot: {})
    assert [str(finding) for finding in found.findings if finding.severity is Severity.ERROR] == []


def stack(root: Path, key: str) -> np.ndarray:
    """Return a column of a whole dataset."""
    tables = [pq.read_table(path, columns=[key]) for path in sorted((root / "data").glob("*/*.parquet"))]
    return np.array(pa.concat_tables(tables)[key].to_pylist())
