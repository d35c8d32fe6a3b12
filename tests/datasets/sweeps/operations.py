"""What the sweeps do to datasets, and what is at a place before and after."""

import hashlib
import json
import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.storage.atomic import UNFINISHED_VERSION
from tests.datasets import support
from tests.datasets.edit_support import record
from tests.datasets.foreign import edit_json
from tests.ros2.bag.support import drive, write

NOTES = "notes.txt"  # what somebody else put there; it must stay


@dataclass(frozen=True)
class Operation:
    """A command, by the folder in which it works.

    Attributes:
        name: for the report.
        prepare: puts into a folder what the command needs; called once, and copied for each run.
        command: the command line; {f} stands for that folder.
        target: what the command makes or changes.
        is_new: whether nothing is there before.
        places: "no exchange" of names by the file system, or a "fixed" folder, such as a mount point.
        is_refused: whether other commands refuse what is there before.
        repeated: exit status of the same command again, when it had been completed.
        says: what it says of that.
    """

    name: str
    prepare: Callable[[Path], object]
    command: str
    target: str
    is_new: bool = False
    places: tuple[str, ...] = ("plain",)
    is_refused: bool = False
    repeated: int = 0
    says: str = ""

    def argv(self, folder: Path) -> list[str]:
        """Return the arguments, in a folder."""
        return [word.format(f=folder) for word in shlex.split(self.command)]


def dataset(folder: Path, name: str = "d 1", episodes: int = 4) -> Path:
    """Make a dataset with notes of somebody else in it; its name has a space."""
    root = record(folder / name, list(range(episodes)))
    for place in (root, root / "meta", root / "own"):
        place.mkdir(exist_ok=True)
        (place / NOTES).write_text("mine", encoding="utf-8")
    return root


def _two(folder: Path) -> None:
    dataset(folder, "a", 2)
    record(folder / "b", [2, 3])


def _without_stats(folder: Path) -> None:
    (dataset(folder) / "meta/stats.json").unlink()


def _miscounted(folder: Path) -> Path:
    root = dataset(folder)
    edit_json(root / "meta/info.json", lambda info: info.update(total_frames=info["total_frames"] - 3))
    return root


def _disordered(folder: Path) -> Path:
    """Make a dataset with several faults of those that `--fix` corrects: order, counts, and statistics."""
    root = _miscounted(folder)
    path = next(root.glob("data/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.take(list(reversed(range(table.num_rows)))), path)
    path = root / "meta/tasks.parquet"
    pq.write_table(pq.read_table(path).take([1, 0]), path)
    edit_json(root / "meta/stats.json", lambda stats: stats["observation.state"].update(std=[0.0, 0.0, 0.0]))
    return root


def _shuffled(folder: Path) -> None:
    root = dataset(folder)
    path = next(root.glob("data/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.take([3, 1, 2, 0, *range(4, table.num_rows)]), path)


def _cut(folder: Path) -> None:
    """Cut the footer of the data off: their episodes can be recovered."""
    root = dataset(folder)
    path = next(root.glob("data/*/*.parquet"))
    os.truncate(path, path.stat().st_size - 8)


def _without_info(folder: Path) -> None:
    root = dataset(folder)
    shutil.copy(root / "meta/info.json", folder / "info.json")
    (root / "meta/info.json").write_text("{")


def _into(folder: Path) -> None:
    dataset(folder)
    (folder / "parts").mkdir()
    (folder / "parts" / NOTES).write_text("mine", encoding="utf-8")


def _bag(folder: Path) -> None:
    write(folder / "bag", drive(seconds=2))


def _afar(folder: Path) -> None:
    shutil.copytree(record(folder / "made", [0, 1, 2]), folder / "afar")


def _afar_and_here(folder: Path) -> None:
    _afar(folder)
    dataset(folder)


def _killed(folder: Path) -> None:
    """Leave a recording as after a kill: episodes in files of their own, an unfinished one, no statistics."""
    support.fill(support.killed(folder / "d 1", 3).begin_episode(), 3)
    (folder / "d 1/.bhd/episode-3").mkdir(parents=True)


ANYWHERE = ("plain", "no exchange")
NEW_ANYWHERE = ("plain", "fixed")
EXISTS = {"is_new": True, "repeated": 2, "says": "exists already", "places": NEW_ANYWHERE}
OPERATIONS = (
    Operation(
        "delete", dataset, "delete '{f}/d 1' --episodes=1", "d 1", places=ANYWHERE, says="nothing was changed now"
    ),
    Operation("mark", dataset, "mark '{f}/d 1' --episodes=1 --outcome=failure", "d 1", says="changed now"),
    Operation("fix", _without_stats, "check '{f}/d 1' --fix", "d 1"),
    Operation("fix the count", _miscounted, "check '{f}/d 1' --fix", "d 1", places=ANYWHERE, is_refused=True),
    Operation("fix everything", _disordered, "check '{f}/d 1' --fix", "d 1", places=ANYWHERE, is_refused=True),
    Operation("repair the order", _shuffled, "repair '{f}/d 1'", "d 1", places=ANYWHERE),
    Operation("repair damage", _cut, "repair '{f}/d 1'", "d 1", places=ANYWHERE, is_refused=True),
    Operation(
        "repair with the info of another", _without_info, "repair '{f}/d 1' --info {f}/info.json", "d 1",
        is_refused=True, repeated=2, says="can be read and fits its data",
    ),
    Operation("repair", _killed, "repair '{f}/d 1'", "d 1", places=ANYWHERE),
    Operation("resume", _killed, "record '{f}/d 1' 5", "d 1"),
    Operation("record", lambda folder: None, "record '{f}/d 1' 2", "d 1", is_new=True, places=NEW_ANYWHERE),
    Operation("merge", _two, "merge {f}/a {f}/b --output {f}/all", "all", **EXISTS),
    Operation("filter", dataset, "filter '{f}/d 1' --episodes=0,2 --output {f}/some", "some", **EXISTS),
    Operation("split", dataset, "split '{f}/d 1' --parts=x=0.5,y=0.5 --output {f}/parts", "parts", **EXISTS),
    Operation(
        "split into a folder", _into, "split '{f}/d 1' --parts=x=0.5,y=0.5 --output {f}/parts", "parts",
        repeated=2, says="exists already",
    ),
    Operation("export", lambda folder: dataset(folder, "d", 2), "export {f}/d --output {f}/bags", "bags", **EXISTS),
    Operation("import", _bag, "import {f}/bag --task=Drive. --beams=36 --repo_id=t/t --root {f}/new", "new", **EXISTS),
    Operation("pull", _afar, "pull file://{f}/afar --root {f}/new", "new", is_new=True, places=NEW_ANYWHERE),
    Operation(
        "pull in the place of another", _afar_and_here, "pull file://{f}/afar --root '{f}/d 1' --replace", "d 1",
        places=(*ANYWHERE, "fixed"),
    ),
)  # fmt: skip


REFUSED = "refused by LeRobot"


class RefusedError(Exception):
    """LeRobot would not load it."""


def content(place: Path) -> str:
    """Return a digest of all datasets at a place, or of the bags there; "nothing", or "broken", if there are none.

    Read without the code that is tested: as a stock LeRobot would find it.
    """
    try:
        found = sorted([*place.rglob("meta/info.json"), *place.rglob("*.mcap")])
        shown = [path for path in found if not any(part.startswith(".") for part in path.relative_to(place).parts)]
        if any(path.name == NOTES for path in place.glob("*")):
            shown.append(place / NOTES)
        return _digest(shown) if shown else "nothing"
    except RefusedError:
        return REFUSED
    except (OSError, KeyError, ValueError, pa.ArrowException) as error:
        return f"broken: {error!r}"


def _digest(found: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in found:
        if path.name != "info.json":
            digest.update(path.read_bytes())
            continue
        root = path.parents[1]
        info = json.loads(path.read_text(encoding="utf-8"))
        if info["codebase_version"] == UNFINISHED_VERSION:
            raise RefusedError
        rows = pa.concat_tables([_light(one) for one in sorted(root.glob("meta/episodes/*/*.parquet"))]).to_pylist()
        rows = [row for row in rows if row["episode_index"] < info["total_episodes"]]
        data = pa.concat_tables([pq.read_table(one) for one in sorted(root.glob("data/*/*.parquet"))])
        if [row["episode_index"] for row in rows] != list(range(info["total_episodes"])):
            raise ValueError("episodes are missing")
        if data.num_rows < info["total_frames"]:
            raise ValueError("frames are missing")
        values = [data.slice(0, info["total_frames"]).to_pydict(), rows, info["total_episodes"], info["features"]]
        digest.update(json.dumps([root.name, values], default=str).encode())
    return digest.hexdigest()


def _light(path: Path) -> pa.Table:
    """Return episodes without statistics and the places of their files, which change with every merge of files."""
    table = pq.read_table(path)
    names = [name for name in table.column_names if not name.startswith(("stats/", "data/", "meta/"))]
    return table.select(names)


def leftovers(folder: Path) -> list[str]:
    """Return what is hidden in a folder, which nobody wants there after a command."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob(".*") if path.name != ".cache")
