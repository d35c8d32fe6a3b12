"""Whether the files of a dataset are those that its episodes name, and what others are left of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bhd_lerobot.datasets.format.parquet_rescue import is_cut_off
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import WORK, is_decided
from bhd_lerobot.datasets.storage.places import check_links
from bhd_lerobot.datasets.validate.findings import Findings, few
from bhd_lerobot.errors import DatasetError

if TYPE_CHECKING:
    from bhd_lerobot.datasets.validate.files import Files

_RECORD = "Restore it from a copy; bhd-data repair goes on without what is lost with it."


def check_names(files: Files, findings: Findings) -> None:
    """Compare the files that there are with those that the episodes name."""
    wanted = {layout.data_file(slot) for slot in files.slots("data")}
    for key in files.cameras:
        wanted |= {layout.video_file(key, slot) for slot in files.slots(f"videos/{key}")}
    there = {name for name in layout.recorded_files(files.root) if not name.startswith("meta/")}
    try:
        check_links(files.root)
    except DatasetError as error:
        findings.error("files", layout.INFO, "a link leads out of the dataset, which no command follows", str(error))
    for name in sorted(wanted - there):
        findings.error("files", name, "it is missing", _RECORD)
    leftovers = sorted(there - wanted)
    described = len(files.episodes.get("episode_index", ()))
    if described < files.info["total_episodes"]:
        remedy = "It may hold an episode that is not described: bhd-data repair recovers those that are whole."
    elif files.is_ours:
        remedy = "bhd-data repair removes it."
    else:
        remedy = "Look what it is; it may hold unfinished episodes."
    torn = [name for name in leftovers if name.endswith(".parquet") and is_cut_off(files.root / name)]
    if torn:
        what = "its writer was killed; an episode may be in it, and LeRobot loads nothing while it is there"
        findings.error("files", few(torn, 3), what, "bhd-data repair recovers what is whole.")
    elif leftovers:
        findings.warning("files", few(leftovers, 3), "no described episode is in it", remedy)
    if (files.root / layout.STAGING).exists():
        findings.warning("files", layout.STAGING, *_interrupted(files))


def _interrupted(files: Files) -> tuple[str, str]:
    """Return what the staging folder is left of, and what to do."""
    if is_decided(files.root):
        return (
            "an edit, or the merging of a recording's files, was interrupted at its end",
            "bhd-data repair completes it.",
        )
    is_whole = not files.is_ours or (bool(files.episodes) and files.has_stats)
    if is_whole and {path.name for path in (files.root / layout.STAGING).iterdir()} == {WORK.name}:
        # A recording whose files are being merged has episodes without statistics.
        return "an edit was interrupted; nothing of it was done", "bhd-data repair drops it. Repeat the edit."
    what = "a recording was interrupted; what it saved is complete, and not yet merged"
    return what, "bhd-data repair finishes it."
