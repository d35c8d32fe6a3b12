"""Whether the files of a dataset are there, can be read, and agree on what they count.

The reader is that of `state.load_state`, which stops at the first contradiction, because a recorder must not continue
from it. Here all of them are reported, in datasets of other programs, too.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.features import names_of
from bhd_lerobot.datasets.format.info import InfoError, parse_object, read_info, wrong_feature
from bhd_lerobot.datasets.format.parquet_rescue import is_cut_off
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.format.state import (
    DamagedFileError,
    DatasetState,
    check_places,
    no_dataset,
    numbered_tasks,
    read_rows,
    repair_with_info,
    slot_of,
)
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import has_unfinished_episodes, is_decided
from bhd_lerobot.datasets.storage.places import check_links
from bhd_lerobot.datasets.validate.findings import FIX, Findings, one_line
from bhd_lerobot.datasets.validate.order import SORTS, check_order
from bhd_lerobot.datasets.validate.statistics import UNREAD
from bhd_lerobot.errors import DatasetError, brief

_COPY = "Restore it from a copy, or try bhd-data repair."
RESTORE = "Restore it from a copy, or run bhd-data repair, which recovers the episodes that are whole."
_RECORD = "Restore it from a copy; bhd-data repair continues without the data that is lost with it."
_STATISTICS = ("min", "max", "mean", "std", "count")


@dataclass
class Files(DatasetState):
    """What can be read of the small files of a dataset; `rows` has the episodes that are described.

    Attributes:
        described: the number of the episode of each row of `meta/episodes`, in the order of the files.
        stats: `meta/stats.json`, by feature and name, flat; what is missing there, or no numbers, is not here.
    """

    described: list[int] = field(default_factory=list)
    stats: dict[str, dict[str, NDArray[np.float64]]] = field(default_factory=dict)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The features."""
        return self.info["features"]

    @property
    def is_ours(self) -> bool:
        """Whether this package recorded it."""
        return (self.root / layout.IDENTITY).is_file()


def read_files(root: Path, findings: Findings) -> Files:
    """Read the small files, and check them."""

    def report(check: str, path: Path, what: object) -> None:
        where = path.relative_to(root).as_posix()
        findings.error(check, where, f"it cannot be read: {one_line(what)}" if check == "files" else str(what), _COPY)

    files = Files(root, _read_info(root), None)
    _check_features(files, findings)
    _read_tasks(files, findings)
    files.described = read_rows(files, report, is_full=True)
    frames = check_places(files, report)
    if files.info["total_episodes"] == len(files.rows) > 0 and frames != files.info["total_frames"]:
        what = f"it counts {files.info['total_frames']} frames; the episodes have {frames}"
        findings.error("counts", layout.INFO, what, f"{FIX} counts them.")
    if files.without_stats and not files.is_ours:
        what = "episodes have no statistics of their own, without which nothing can be edited"
        findings.warning("stats", "meta/episodes", what, stats_remedy(files))
    _check_names(files, findings)
    check_order(root, [slot_of(row, "data") for row in files.rows], files.described, findings)
    _read_stats(files, findings)
    return files


def _read_info(root: Path) -> dict[str, Any]:
    path = root / layout.INFO
    if not path.is_file():
        raise no_dataset(root)
    try:
        return read_info(path, root, features=False)
    except (OSError, InfoError) as error:
        raise DatasetError(
            f"{path} cannot be used, and nothing can be checked without it: {one_line(error)}. {repair_with_info(root)}"
        ) from error


def _check_features(files: Files, findings: Findings) -> None:
    for key in DEFAULT_FEATURES:
        if key not in files.features:
            findings.error("schema", layout.INFO, f"the feature {key!r} is missing, which every dataset has", _COPY)
    for key, feature in list(files.features.items()):
        if wrong := wrong_feature(feature):
            findings.error("schema", f"{layout.INFO}: {key}", f"it {wrong}", _COPY)
            del files.features[key]  # it cannot be checked further
            continue
        names, size = feature.get("names"), feature["shape"][0]
        if feature["dtype"] in ("video", "image") or not names or names_of(feature):
            continue
        if isinstance(names, list) and len(names) > 1:
            findings.error("schema", f"{layout.INFO}: {key}", f"{len(names)} names for {size} numbers", _COPY)
        else:  # one name for all, as openpi's converters write
            findings.note("schema", f"{layout.INFO}: {key}", f"{names} names the {size} numbers together")


def _read_tasks(files: Files, findings: Findings) -> None:
    path = files.root / layout.TASKS
    if not path.is_file() and not files.info["total_episodes"]:
        return
    try:
        tasks = numbered_tasks(path)
    except DamagedFileError as error:
        findings.error("files", layout.TASKS, f"it cannot be read: {error.reason}", _COPY)
        return
    numbers = list(tasks)
    if sorted(numbers) != list(range(len(numbers))):
        what = f"its numbers are {brief(numbers)}; they have to be 0 to {len(numbers) - 1}, because LeRobot counts rows"
        findings.error("counts", layout.TASKS, what, "bhd-data repair numbers the instructions again.")
        return
    files.tasks = [tasks[number] for number in range(len(tasks))]
    if numbers != sorted(numbers):
        what = f"its rows have the numbers {brief(numbers)}; LeRobot takes row i for that of number i"
        findings.error("order", layout.TASKS, what, SORTS)
    if len(tasks) < files.info["total_tasks"]:
        what = f"it holds {len(tasks)} instructions; meta/info.json counts {files.info['total_tasks']}"
        findings.error("counts", layout.TASKS, what, _COPY)


def _check_names(files: Files, findings: Findings) -> None:
    """Compare the files that there are with those that the episodes name."""
    wanted = {name for name in files.files() if not name.startswith("meta/")}
    there = {name for name in layout.recorded_files(files.root) if not name.startswith("meta/")}
    try:
        check_links(files.root)
    except DatasetError as error:
        findings.error("files", layout.INFO, "a link leads out of the dataset, which no command follows", str(error))
    missing = sorted(wanted - there)
    if missing and (files.root / layout.SUBSET).is_file():
        what = f"of a dataset that was pulled in part, {brief(missing, 3)} are not here"
        findings.warning("files", layout.SUBSET, what, "bhd-data pull without --episodes fetches them.")
        missing = []
    for name in missing:
        findings.error("files", name, "it is missing", _RECORD)
    leftovers = sorted(there - wanted)
    if len(files.rows) < files.info["total_episodes"]:
        remedy = "It may hold an episode that is not described: bhd-data repair recovers those that are whole."
    elif files.is_ours:
        remedy = "bhd-data repair removes it."
    else:
        remedy = "Inspect it; it may hold unfinished episodes."
    torn = [name for name in leftovers if name.endswith(".parquet") and is_cut_off(files.root / name)]
    if torn:
        what = "its writer was killed; an episode may be in it, and LeRobot loads nothing while it is there"
        findings.error("files", brief(torn, 3), what, "bhd-data repair recovers what is whole.")
    elif leftovers:
        findings.warning("files", brief(leftovers, 3), "no described episode is in it", remedy)
    if (files.root / layout.STAGING).exists():
        findings.warning("files", layout.STAGING, *_interrupted(files))


def _interrupted(files: Files) -> tuple[str, str]:
    """Return what the staging folder is left of, and what to do."""
    if is_decided(files.root):
        return (
            "an edit, or the merging of a recording's files, was interrupted at its end",
            "bhd-data repair completes it.",
        )
    is_whole = not files.is_ours or (bool(files.rows) and not files.without_stats)
    if is_whole and not has_unfinished_episodes(files.root):
        # A recording whose files are being merged has episodes without statistics.
        return "an edit was interrupted before it changed anything", "bhd-data repair drops it. Repeat the edit."
    what = "a recording was interrupted; what it saved is complete, and not yet merged"
    return what, "bhd-data repair finishes it."


def stats_remedy(files: Files) -> str:
    """Return what computes missing or wrong statistics."""
    return f"{'bhd-data repair' if has_unfinished_episodes(files.root) else FIX} computes them."


def _read_stats(files: Files, findings: Findings) -> None:
    path, name = files.root / layout.STATS, layout.STATS
    if not files.rows:
        return
    remedy = stats_remedy(files)
    if not path.is_file():
        findings.error("stats", name, "it is missing, so no policy can be normalised", remedy)
        return
    try:
        stats = parse_object(path.read_bytes())
    except (OSError, InfoError) as error:
        findings.error("stats", name, f"it cannot be read: {one_line(error)}", remedy)
        return
    for key, feature in files.features.items():
        if feature["dtype"] in ("string", "language"):
            continue
        stored = stats.get(key)
        known = files.stats[key] = _vectors(stored if isinstance(stored, dict) else {})
        lacking = [statistic for statistic in _STATISTICS if statistic not in known]
        report = findings.warning if key in UNREAD else findings.error
        if lacking:
            report("stats", f"{name}: {key}", f"it has no {brief(lacking)}", remedy)
        elif feature["dtype"] not in ("video", "image"):
            count = known["count"][0]
            if count != files.info["total_frames"]:
                what = f"they are of {count:g} frames; the dataset has {files.info['total_frames']}"
                report("stats", f"{name}: {key}", what, remedy)


def _vectors(stored: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """Return what there are numbers for, flat."""
    vectors: dict[str, NDArray[np.float64]] = {}
    for name, value in stored.items():
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            values = np.asarray(value, np.float64).reshape(-1)
            if values.size:
                vectors[name] = values
    return vectors
