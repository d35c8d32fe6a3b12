"""An episode as files of other programs: its numbers as CSV, a camera's video as MP4."""

import io
import tempfile
from fractions import Fraction
from pathlib import Path

import pyarrow as pa
import pyarrow.csv

from bhd_lerobot.apps.view.groups import names_of, numbers
from bhd_lerobot.datasets.format.state import DatasetState
from bhd_lerobot.datasets.format.video_splice import splice


def to_csv(state: DatasetState, table: pa.Table) -> bytes:
    """Return an episode as CSV: a line a frame, a column for each number, named ``feature.name``, and for each text."""
    fps = state.info["fps"]
    columns: dict[str, pa.Array | pa.ChunkedArray] = {
        "frame": pa.array(range(len(table))),
        "time_s": pa.array([frame / fps for frame in range(len(table))]),
    }
    for key in table.column_names:
        values = numbers(table[key], len(table))
        if values is not None:
            names = names_of(state.info["features"][key], values.shape[1])
            for number, name in enumerate(names):
                columns[key if len(names) == 1 else f"{key}.{name}"] = pa.array(values[:, number])
        elif pa.types.is_string(table[key].type) or pa.types.is_large_string(table[key].type):
            columns[key] = table[key]
    written = io.BytesIO()
    pyarrow.csv.write_csv(pa.table(columns), written)
    return written.getvalue()


def to_video(path: Path, span: tuple[float, float], length: int, fps: float) -> bytes:
    """Return an episode's part of a video, from begin to end [s], as MP4, without encoding it again.

    Raises:
        DatasetCorruptError: the video cannot be read, or ends too early.
        UnsupportedDatasetError: the episode does not begin with a key frame.
    """
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "episode.mp4"
        splice([(path, [(round(span[0] * fps), length)])], target, Fraction(fps))
        return target.read_bytes()
