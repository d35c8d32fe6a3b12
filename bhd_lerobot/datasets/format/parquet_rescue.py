"""Read a Parquet file whose writer was killed before it wrote the footer.

A Parquet file is a sequence of row groups and a footer with the place of each column of each row group. No reader opens
a file without its footer, though its row groups are complete. Each page begins with a header with its size and number
of values. So, given the columns, the row groups can be found and a footer can be written.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.thrift_compact import Field, Reader, Struct, encode, integer

MAGIC = b"PAR1"

# Numbers of fields in Parquet's structs.
_PAGE_TYPE, _PAGE_UNCOMPRESSED, _PAGE_COMPRESSED, _PAGE_DATA, _PAGE_DATA_V2 = 1, 2, 3, 5, 8
_FOOTER_ROWS, _FOOTER_GROUPS = 3, 4
_GROUP_COLUMNS, _GROUP_BYTES, _GROUP_ROWS, _GROUP_OFFSET, _GROUP_COMPRESSED = 1, 2, 3, 5, 6
_COLUMN_OFFSET, _COLUMN_META = 2, 3
_META_VALUES, _META_UNCOMPRESSED, _META_COMPRESSED, _META_DATA, _META_DICTIONARY = 5, 6, 7, 9, 11
_META_KEPT = (1, 2, 3, 4)  # type, encodings, path, codec
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2 = 0, 2, 3


@dataclass(frozen=True)
class Rescued:
    """What could be read.

    Attributes:
        problem: why there is no more; empty if the file is whole.
        lost_bytes: bytes that belong to no row group that can be read.
        is_cut: whether there is no footer, so that bytes at the end may belong to no row group.
    """

    groups: list[pa.Table]
    problem: str = ""
    lost_bytes: int = 0
    is_cut: bool = False


@dataclass
class _Chunk:
    """The pages of one column in one row group."""

    start: int
    end: int = 0
    dictionary: int | None = None
    data: int | None = None
    values: int = 0
    uncompressed: int = 0


@dataclass
class _Page:
    start: int
    end: int
    kind: int
    values: int
    uncompressed: int


def is_parquet(path: Path) -> bool:
    """Return whether a file begins like a Parquet file; false if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def is_cut_off(path: Path) -> bool:
    """Return whether a Parquet file has no footer, as after a kill of its writer."""
    try:
        with open(path, "rb") as file:
            begin = file.read(len(MAGIC))
            file.seek(max(0, path.stat().st_size - len(MAGIC)))
            return begin == MAGIC and file.read() != MAGIC
    except OSError:
        return False


def rescue(path: Path, schema: pa.Schema, shapes: Mapping[str, Sequence[int]] | None = None) -> Rescued:
    """Return the row groups of a file, with its footer or without; damaged ones are left out.

    Args:
        schema: its columns, in order; used only if there is no footer.
        shapes: the shape of a row's value in columns of nested lists, whose type does not define it.
    """
    try:
        whole = pq.ParquetFile(path, page_checksum_verification=True)
        return _read(whole)
    except (OSError, pa.ArrowException) as error:
        problem = " ".join(str(error).split())
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        return Rescued([], "it does not begin like a Parquet file", len(data))
    footer, factors = _template(schema, shapes or {})
    groups = _walk(memoryview(data), factors)
    if not groups:
        return Rescued([], f"it has no footer and no whole row group ({problem[:120]})", len(data) - len(MAGIC), True)
    whole_bytes = data[: groups[-1][-1].end] + _footer(footer, groups, factors)
    rest = len(data) - groups[-1][-1].end
    try:
        found = _read(pq.ParquetFile(pa.BufferReader(whole_bytes), page_checksum_verification=True))
    except (OSError, pa.ArrowException, ValueError) as error:
        return Rescued([], f"it has no footer ({' '.join(str(error).split())[:120]})", len(data) - len(MAGIC), True)
    problem = "it has no footer" + (f", and {found.problem}" if found.problem else "")
    return Rescued(found.groups, problem, found.lost_bytes + rest, True)


def _read(file: pq.ParquetFile) -> Rescued:
    tables: list[pa.Table] = []
    problems: list[str] = []
    lost = 0
    for group in range(file.num_row_groups):
        try:
            tables.append(file.read_row_group(group, use_threads=False))
        except (OSError, pa.ArrowException, ValueError) as error:
            # The headers are right, and what is between them is not.
            problems.append(f"row group {group} cannot be read ({' '.join(str(error).split())[:120]})")
            described = file.metadata.row_group(group)
            lost += sum(described.column(place).total_compressed_size for place in range(described.num_columns))
    return Rescued(tables, "; ".join(problems[:3]), lost)


def _template(schema: pa.Schema, shapes: Mapping[str, Sequence[int]]) -> tuple[Struct, list[int]]:
    """Return the footer of a file with these columns and one row, and how many values a row has in each leaf column."""
    arrays = [pa.array([_example(column.type, column.name, shapes)], type=_storage(column.type)) for column in schema]
    sink = pa.BufferOutputStream()
    # As LeRobot writes; the codec and the encodings go into the footer.
    pq.write_table(pa.Table.from_arrays(arrays, names=schema.names), sink, compression="snappy", use_dictionary=True)
    data = sink.getvalue().to_pybytes()
    length = int.from_bytes(data[-8:-4], "little")
    footer = Reader(data, len(data) - 8 - length).struct()
    columns = footer[_FOOTER_GROUPS].value[0][_GROUP_COLUMNS].value
    return footer, [column[_COLUMN_META].value[_META_VALUES].value for column in columns]


def _storage(kind: pa.DataType) -> pa.DataType:
    return kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind


def _example(kind: pa.DataType, name: str, shapes: Mapping[str, Sequence[int]]) -> object:
    """Return a value of a column, with as many elements as every row has."""
    kind = _storage(kind)
    if pa.types.is_fixed_size_list(kind):
        return [_example(kind.value_type, name, shapes)] * kind.list_size
    if pa.types.is_struct(kind):
        return {kind.field(i).name: _example(kind.field(i).type, name, shapes) for i in range(kind.num_fields)}
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        if name not in shapes:
            raise ValueError(f"rows of {name!r} ({kind}) may have any length, so the ends of its pages are unknown")
        size, *rest = shapes[name]
        return [_example(kind.value_type, name, {name: rest} if rest else {})] * size
    if pa.types.is_binary(kind):
        return b""
    if pa.types.is_string(kind):
        return ""
    return False if pa.types.is_boolean(kind) else 0


def _walk(data: memoryview, factors: Sequence[int]) -> list[list[_Chunk]]:
    groups: list[list[_Chunk]] = []
    position = len(MAGIC)
    while (chunks := _group(data, position, factors)) is not None:
        groups.append(chunks)
        position = chunks[-1].end
    return groups


def _group(data: memoryview, position: int, factors: Sequence[int]) -> list[_Chunk] | None:
    """Return the columns of the row group at `position`; None if there is no whole one."""
    rows, first = 0, position
    while (page := _page(data, first)) is not None:
        # The number of rows of the group follows only from its pages, and a column may have several. Try the first page
        # of the first column, then two, until all columns fit.
        if page.kind == _DICTIONARY_PAGE and rows:
            return None
        if page.kind != _DICTIONARY_PAGE:
            rows += page.values
            if rows % factors[0] == 0 and (chunks := _columns(data, position, factors, rows // factors[0])) is not None:
                return chunks
        first = page.end
    return None


def _columns(data: memoryview, position: int, factors: Sequence[int], rows: int) -> list[_Chunk] | None:
    chunks: list[_Chunk] = []
    for factor in factors:
        chunk = _Chunk(position)
        while chunk.values < rows * factor:
            page = _page(data, position)
            if page is None:
                return None
            if page.kind == _DICTIONARY_PAGE:
                if chunk.dictionary is not None or chunk.data is not None:
                    return None
                chunk.dictionary = page.start
            else:
                chunk.data = page.start if chunk.data is None else chunk.data
                chunk.values += page.values
            chunk.uncompressed += page.uncompressed
            position = page.end
        if chunk.values != rows * factor or chunk.data is None:
            return None
        chunk.end = position
        chunks.append(chunk)
    return chunks


def _page(data: memoryview, position: int) -> _Page | None:
    """Return the page at `position`; None if there is no whole one."""
    reader = Reader(data, position)
    try:
        header = reader.struct()
        kind = header[_PAGE_TYPE].value
        sizes = header[_PAGE_UNCOMPRESSED].value, header[_PAGE_COMPRESSED].value
        if kind == _DICTIONARY_PAGE:
            values = 0
        else:
            values = header[_PAGE_DATA if kind == _DATA_PAGE else _PAGE_DATA_V2].value[1].value
    except (ValueError, KeyError, AttributeError, TypeError):
        return None
    end = reader.position + sizes[1] if isinstance(sizes[1], int) else -1
    if kind not in (_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2) or end <= reader.position or end > len(data):
        return None
    if not isinstance(values, int) or not isinstance(sizes[0], int) or (values <= 0 and kind != _DICTIONARY_PAGE):
        return None
    return _Page(position, end, kind, values, reader.position - position + sizes[0])


def _footer(template: Struct, groups: Sequence[Sequence[_Chunk]], factors: Sequence[int]) -> bytes:
    columns = template[_FOOTER_GROUPS].value[0][_GROUP_COLUMNS].value
    described, total = [], 0
    for chunks in groups:
        rows = chunks[0].values // factors[0]
        total += rows
        own: Struct = {
            _GROUP_COLUMNS: Field(9, [_column(old, chunk) for old, chunk in zip(columns, chunks, strict=True)], 12),
            _GROUP_BYTES: integer(sum(chunk.uncompressed for chunk in chunks)),
            _GROUP_ROWS: integer(rows),
            _GROUP_OFFSET: integer(chunks[0].start),
            _GROUP_COMPRESSED: integer(chunks[-1].end - chunks[0].start),
        }
        described.append(own)
    body = encode({**template, _FOOTER_ROWS: integer(total), _FOOTER_GROUPS: Field(9, described, 12)})
    return body + len(body).to_bytes(4, "little") + MAGIC


def _column(old: Struct, chunk: _Chunk) -> Struct:
    meta = {number: value for number, value in old[_COLUMN_META].value.items() if number in _META_KEPT}
    meta[_META_VALUES] = integer(chunk.values)
    meta[_META_UNCOMPRESSED] = integer(chunk.uncompressed)
    meta[_META_COMPRESSED] = integer(chunk.end - chunk.start)
    meta[_META_DATA] = integer(chunk.data or 0)
    if chunk.dictionary is not None:
        meta[_META_DICTIONARY] = integer(chunk.dictionary)
    return {_COLUMN_OFFSET: integer(0), _COLUMN_META: Field(12, meta)}
