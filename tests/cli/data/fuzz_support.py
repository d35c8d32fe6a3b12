"""Damage for datasets: values of other kinds in JSON and Parquet, and files that are no files any more."""

import contextlib
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 7, 2**31, 2**63 - 1, 2**63, 2**70, 10**400, 0.5, -0.5, math.nan, math.inf,
    -math.inf, 1e308, 5e-324, "", "x", "10", "v2.1", "v3.0", "nan", "\ud800", "[red]", "a/b", "../x", "é" * 500, "\n",
    [], {}, [1], [[]], [None], ["x"], [[1], [2, 3]], {"a": 1}, {"": {}}, [1e400, -3],
    {"dtype": "video", "shape": [4, 4, 3]},
)  # fmt: skip
NAMES = ("", "x", "action", "observation.state", "index", "fps", "episode_index", "a/b")


def damage(root: Path, rng: np.random.Generator) -> str:
    """Damage a file of a dataset; return what was done, in words."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    meta = [path for path in files if path.suffix in (".json", ".jsonl")]
    if rng.random() < 0.6:
        files = meta if rng.random() < 0.5 else [path for path in files if path.suffix == ".parquet"]
    info = root / "meta/info.json"
    path = info if rng.random() < 0.25 and info in files else files[rng.integers(len(files))]
    ways: list[Callable[[Path, np.random.Generator], str]] = [damage_bytes]
    if path in meta:
        ways += [damage_json] * 5
    elif path.suffix == ".parquet":
        ways += [damage_parquet] * 5
    name = path.relative_to(root).as_posix()
    try:
        return f"{name}: {ways[rng.integers(len(ways))](path, rng)}"
    except (OSError, ValueError, LookupError, RecursionError, pa.ArrowException):  # it was damaged before
        return f"{name}: {damage_bytes(path, rng)}"


def damage_bytes(path: Path, rng: np.random.Generator) -> str:
    """Make something else of a file."""
    content = path.read_bytes()
    where = int(rng.integers(len(content) + 1))
    wholes = {
        "empty": b"", "cut": content[:where], "seven zeros": content[:where] + bytes(7) + content[where:],
        "bit": content[: max(where - 1, 0)] + bytes([rng.integers(256)]) + content[where:],
        "no utf-8": b"\xff\xfe" + content, "bom": b"\xef\xbb\xbf" + content, "nested": b"[" * 100_000,
        "nested object": b'{"a":' * 50_000 + b"1" + b"}" * 50_000, "huge": b"1" * 5_000, "huge inside":
        b'{"fps": ' + b"9" * 5_000 + b"}", "number": b"1e999", "null": b"null", "par1": b"PAR1PAR1", "half pair":
        b'{"features": {"\\ud800": {"dtype": "float32", "shape": [1]}}}', "repeated": content + content,
    }  # fmt: skip
    way = [*wholes, "gone", "folder", "loop", "broken link"][rng.integers(len(wholes) + 4)]
    path.unlink()
    if way in wholes:
        path.write_bytes(wholes[way])
    elif way == "folder":
        path.mkdir()
    elif way == "loop":
        path.symlink_to(path)
    elif way == "broken link":
        path.symlink_to(path.with_name("nothing"))
    return way


def damage_json(path: Path, rng: np.random.Generator) -> str:
    """Put another value somewhere into a JSON file, or leave one out; of JSON lines, into one line."""
    lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    which = int(rng.integers(len(lines)))
    told = json.loads(lines[which])
    holder, key = {"whole": told}, "whole"
    while rng.random() < 0.75 and isinstance(holder[key], dict | list) and holder[key]:
        holder = holder[key]
        key = list(holder)[rng.integers(len(holder))] if isinstance(holder, dict) else int(rng.integers(len(holder)))
    value = VALUES[rng.integers(len(VALUES))]
    way = rng.integers(8)
    what = f"{key} = {value!r:.60}"
    if way == 0 and "whole" not in holder:
        del holder[key]
        what = f"without {key}"
    elif way == 1 and isinstance(holder, dict):
        other = NAMES[rng.integers(len(NAMES))]
        holder[other] = holder.pop(key)
        what = f"{key} is called {other!r}"
    elif way == 2 and isinstance(holder, dict):
        holder[NAMES[rng.integers(len(NAMES))]] = value
        what = f"and {value!r:.60}"
    else:
        holder[key] = value
    whole = holder.get("whole", told) if isinstance(holder, dict) else told
    lines[which] = json.dumps(whole)
    path.write_text("\n".join(lines) + "\n")
    return what


def damage_parquet(path: Path, rng: np.random.Generator) -> str:
    """Change columns or rows of a Parquet file."""
    table = pq.read_table(path)
    light = [name for name in table.column_names if not name.startswith("stats/")]
    names = light if rng.random() < 0.7 else table.column_names
    name = names[rng.integers(len(names))]
    place, column, rows = table.column_names.index(name), table[name], table.num_rows

    def put(values: pa.Array) -> pa.Table:
        return table.set_column(place, name, values)

    ways: dict[str, Callable[[], pa.Table]] = {
        "drop": lambda: table.drop_columns([name]),
        "rename": lambda: table.rename_columns(
            [f"{column_name}x" if column_name == name else column_name for column_name in table.column_names]
        ),
        "twice": lambda: table.append_column(name, column),
        "type": lambda: put(other_type(rows, column, rng)),
        "type ": lambda: put(other_type(rows, column, rng)),
        "value": lambda: put(other_value(column, rng)),
        "value ": lambda: put(other_value(column, rng)),
        "nothing": lambda: put(pa.nulls(rows, column.type)),
        "order": lambda: table.take(pa.array(rng.permutation(rows))),
        "fewer": lambda: table.slice(0, max(rows - 1, 0)),
        "more": lambda: pa.concat_tables([table, table.slice(0, 1)]),
        "none": lambda: table.slice(0, 0),
    }
    way = list(ways)[rng.integers(len(ways))]
    changed = ways[way]()
    pq.write_table(changed, path)
    what = f" {changed[name].type} {changed[name].to_pylist()!r:.60}" if way.startswith(("type", "value")) else ""
    return f"{name}: {way}{what}"


def other_type(rows: int, column: pa.ChunkedArray, rng: np.random.Generator) -> pa.Array:
    """Return a column of another type."""
    numbers = pa.array(rng.integers(-3, 9, rows))
    return [
        pa.array([f"{value}" for value in column.to_pylist()]), numbers, numbers.cast(pa.float64()),
        numbers.cast(pa.int8()), pa.array([[1.0]] * rows), pa.array([[1.0, 2.0]] * rows), pa.array([[[1]]] * rows),
        pa.nulls(rows), pa.array([b"\xff"] * rows), pa.array([{"a": 1}] * rows), numbers.cast(pa.timestamp("s")),
        pa.array(rng.random(rows) < 0.5), pa.array([["x"]] * rows), pa.array([["x"], []] * rows).slice(0, rows),
    ][rng.integers(14)]  # fmt: skip


def other_value(column: pa.ChunkedArray, rng: np.random.Generator) -> pa.Array:
    """Return a column with one other value."""
    values, kind = column.to_pylist(), column.type
    others: list[Any] = [None]
    if pa.types.is_integer(kind):
        others += [-1, 0, 1, 2**31, 2**62, -(2**63)]
    elif pa.types.is_floating(kind):
        others += [math.nan, math.inf, -1.0, 0.0, 1e30]
    elif pa.types.is_string(kind):
        others += ["", "x", "{", "null", "[]", "[1]", "7", '{"frames": "x"}', '{"type": 3}', "[[1, 2]]", "\n", "1e999"]
        others += ['{"frames": 1e400, "ticks": null}', "[" * 10_000, '[["a", 3, {}], [0, 99999, "x"]]', '"\\ud800"']
        told = next((value for value in values if value and value.startswith("{")), "{}")
        with contextlib.suppress(ValueError):
            fields = json.loads(told)
            for name in [field for field in fields if rng.random() < 0.2]:
                fields[name] = VALUES[rng.integers(len(VALUES))]
            others += [json.dumps(fields)] * 10
    elif pa.types.is_list(kind):
        others += [[], [None]]
    if values:
        values[rng.integers(len(values))] = others[rng.integers(len(others))]
    return pa.array(values, type=kind)


def contents(root: Path) -> dict[str, bytes | str]:
    """Return everything below a folder: files by their content, links by their target, folders empty."""
    found: dict[str, bytes | str] = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        found[name] = str(path.readlink()) if path.is_symlink() else path.read_bytes() if path.is_file() else ""
    return found


def fresh(source: Path, root: Path) -> Path:
    """Return a copy of a dataset in a folder of its own, in the place of what was there."""
    shutil.rmtree(root.parent, ignore_errors=True)
    root.parent.mkdir(parents=True)
    return Path(shutil.copytree(source, root))
