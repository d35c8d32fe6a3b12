"""Files without a footer: what is found is what was written, and of a torn file the whole row groups only."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.datasets.format.parquet_rescue import rescue
from bhd_lerobot.datasets.format.thrift_compact import Field, Reader, encode
from tests.cases import each_case

SCHEMA = pa.schema(
    [
        pa.field("state", pa.list_(pa.float32(), 3)),
        pa.field("flag", pa.bool_()),
        pa.field("text", pa.string()),
        pa.field("image", pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])),
        pa.field("matrix", pa.list_(pa.list_(pa.float64(), 2), 2)),
        pa.field("index", pa.int64()),
    ]
)


def table(rows: int, seed: int, image: int = 20) -> pa.Table:
    rng = np.random.default_rng(seed)
    return pa.table(
        {
            "state": pa.array(rng.normal(size=(rows, 3)).astype(np.float32).tolist(), SCHEMA.field("state").type),
            "flag": rng.random(rows) < 0.5,
            "text": pa.array([f"{seed}/{i % 3}" for i in range(rows)]),
            "image": pa.array(
                [{"bytes": rng.bytes(image), "path": f"{i}.png"} for i in range(rows)], SCHEMA.field("image").type
            ),
            "matrix": pa.array(rng.normal(size=(rows, 2, 2)).tolist(), SCHEMA.field("matrix").type),
            "index": np.arange(rows) + 1000 * seed,
        },
        schema=SCHEMA,
    )


def write(path: Path, tables: list[pa.Table], **options: Any) -> list[int]:
    """Write tables as LeRobot does; return where each row group ends in the file, which then loses its footer."""
    ends = []
    with pq.ParquetWriter(path, SCHEMA, compression="snappy", use_dictionary=True, **options) as writer:
        for one in tables:
            writer.write_table(one)
            ends.append(path.stat().st_size)
    with open(path, "r+b") as file:
        file.truncate(ends[-1])
    return ends


@each_case(
    ("rows", "image", "options"),
    [
        ([1], 20, {}),
        ([5, 1, 300, 7], 20, {}),
        ([400, 900], 4000, {}),  # images fill several pages, and no dictionary
        ([3000, 2], 20, {"data_page_size": 1000}),  # several pages in every column
        ([50, 60], 20, {"data_page_version": "2.0"}),
        ([500, 500], 20, {"dictionary_pagesize_limit": 500}),  # columns that give their dictionary up
    ],
)
def test_without_the_footer_everything_is_found(tmp_path: Path, rows: list[int], image: int, options: dict) -> None:
    tables = [table(count, seed, image) for seed, count in enumerate(rows)]
    write(tmp_path / "f.parquet", tables, **options)
    with pytest.raises(pa.ArrowInvalid):
        pq.read_table(tmp_path / "f.parquet")
    found = rescue(tmp_path / "f.parquet", SCHEMA)
    assert [group.to_pydict() for group in found.groups] == [one.to_pydict() for one in tables]
    assert (found.problem, found.lost_bytes) == ("it has no footer", 0)


@pytest.mark.law
def test_only_whole_row_groups_of_a_truncated_file_are_found(tmp_path: Path) -> None:
    tables = [table(5 + seed, seed) for seed in range(4)]
    ends = write(tmp_path / "f.parquet", tables)
    data = (tmp_path / "f.parquet").read_bytes()
    expected = [one.to_pydict() for one in tables]
    rng = random.Random(3)
    for size in [0, 3, 4, 5, *ends, *(end - 1 for end in ends), *rng.sample(range(len(data)), 60)]:
        (tmp_path / "torn.parquet").write_bytes(data[:size])
        found = rescue(tmp_path / "torn.parquet", SCHEMA)
        whole = sum(end <= size for end in ends)
        assert [group.to_pydict() for group in found.groups] == expected[:whole], size
        assert found.lost_bytes == size - (ends[whole - 1] if whole else 4 if size >= 4 else 0), size


def test_damage_never_raises(tmp_path: Path) -> None:
    write(tmp_path / "f.parquet", [table(30, seed) for seed in range(3)])
    data = (tmp_path / "f.parquet").read_bytes()
    rng = random.Random(5)
    for _ in range(60):
        damaged = bytearray(data)
        for _ in range(rng.choice([1, 1, 5])):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        (tmp_path / "damaged.parquet").write_bytes(bytes(damaged))
        found = rescue(tmp_path / "damaged.parquet", SCHEMA)
        assert len(found.groups) <= 3
        assert all(group.schema.equals(SCHEMA) for group in found.groups)


def test_a_file_of_another_format_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "f.parquet").write_bytes(b"hello")
    found = rescue(tmp_path / "f.parquet", SCHEMA)
    assert found.groups == []
    assert "does not begin like a Parquet file" in found.problem
    assert found.lost_bytes == 5


def test_rows_of_any_length_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "f.parquet", [table(3, 0)])
    with pytest.raises(ValueError, match="may have any length"):
        rescue(tmp_path / "f.parquet", pa.schema([pa.field("words", pa.list_(pa.string()))]))


VALUES = st.one_of(
    st.integers(-(2**63), 2**63 - 1).map(lambda value: Field(6, value)),
    st.binary(max_size=40).map(lambda value: Field(8, value)),
    st.booleans().map(lambda value: Field(1 if value else 2, value)),
    st.floats(allow_nan=False).map(lambda value: Field(7, value)),
    st.lists(st.integers(-(2**31), 2**31 - 1), max_size=20).map(lambda value: Field(9, value, 5)),
    st.lists(st.binary(max_size=5), max_size=20).map(lambda value: Field(9, value, 8)),
)
STRUCTS = st.recursive(
    st.dictionaries(st.integers(1, 400), VALUES, max_size=5),
    lambda inner: st.dictionaries(st.integers(1, 400), inner.map(lambda value: Field(12, value)), max_size=3),
    max_leaves=6,
)


@given(STRUCTS)
def test_encoded_structs_are_decoded_to_the_same(struct: dict[int, Field]) -> None:
    data = encode(struct)
    reader = Reader(data + b"rest")
    assert reader.struct() == struct
    assert reader.position == len(data)
    for size in range(len(data)):
        with pytest.raises(ValueError, match=r"ends within|longer than the data"):
            Reader(data[:size]).struct()
