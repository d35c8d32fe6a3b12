"""`bhd-data check`: is a dataset valid? Nothing is changed."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bhd_lerobot.datasets.format import video
from bhd_lerobot.datasets.format.episode_table import PREFIX
from bhd_lerobot.datasets.format.state import ordered_slots
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import complete_interrupted
from bhd_lerobot.datasets.storage.pointers import check_fetched
from bhd_lerobot.datasets.validate.files import RESTORE, Files, read_files
from bhd_lerobot.datasets.validate.findings import Finding, Findings, Severity
from bhd_lerobot.datasets.validate.values import Limits, ValueCheck

__all__ = ["CHECKS", "DatasetCheck", "Finding", "Severity", "check_dataset"]

CHECKS = {
    "schema": "features, their shapes, names and columns",
    "files": "every file exists and can be read to its last page",
    "counts": "meta/info.json, meta/episodes and the data files agree",
    "order": "files, frames and instructions lie in the order of their numbers, by which LeRobot finds them",
    "stats": "statistics exist and match the data",
    "video": "every video has as many frames as its episodes",
    "finite": "no NaN, no infinity, nothing missing",
    "frozen": "no value is constant that changes in other episodes",
    "jumps": "no action jumps",
    "limits": "positions and commands are within the robot's limits",
    "timing": "timestamps match the frame numbers; frames were not late",
    "outcome": "how many episodes succeeded",
}
"""What is checked, and what for."""


@dataclass(frozen=True)
class DatasetCheck:
    """What a check found."""

    root: Path
    episodes: int
    frames: int
    findings: tuple[Finding, ...]

    @property
    def worst(self) -> Severity:
        """The worst finding's severity."""
        return max((finding.severity for finding in self.findings), default=Severity.NOTE)

    @property
    def is_valid(self) -> bool:
        """Whether nothing worse than warnings was found."""
        return self.worst < Severity.ERROR

    def count(self, severity: Severity) -> int:
        """Return how many findings are of a severity."""
        return sum(finding.severity == severity for finding in self.findings)


def check_dataset(
    root: Path | str, limits_of: Callable[[str | None], Limits] = lambda robot_type: {}, *, videos: bool = True
) -> DatasetCheck:
    """Check a dataset, of this package or of another program.

    Args:
        root: the dataset.
        limits_of: gives the limits of a robot, by its type; only those numbers are compared.
        videos: read the videos, too, which takes longer than all the rest.

    Raises:
        DatasetError: there is no dataset, its `meta/info.json` cannot be read, or files of it were not fetched.
    """
    findings = Findings()
    complete_interrupted(Path(root))
    check_fetched(Path(root))
    files = read_files(Path(root), findings)
    robot = files.info.get("robot_type")
    if not files.info["total_episodes"]:
        remedy = "Record some (bhd-record --resume=true), or remove it; nothing can be learned from it as it is."
        findings.error("counts", layout.INFO, "the dataset is empty: it has no episodes", remedy)
    values = ValueCheck(files, findings, limits_of(robot if isinstance(robot, str) else None))
    values.run()
    if videos:
        _check_videos(files, findings)
    _judge_outcomes(files, findings)
    return DatasetCheck(files.root, files.num_episodes, values.frames, tuple(findings))


def _check_videos(files: Files, findings: Findings) -> None:
    fps = float(files.info["fps"])
    for key in files.video_keys:
        rows_by_time = sorted(files.rows, key=lambda row: row[f"videos/{key}/from_timestamp"])
        for slot, rows in ordered_slots(rows_by_time, f"videos/{key}").items():
            name = layout.video_file(key, slot)
            path = files.root / name
            if not path.is_file():
                continue  # reported already
            lengths = np.array([row["length"] for row in rows])
            try:
                times = video.frame_times(path)
            except OSError as error:
                findings.error("video", name, f"it cannot be read: {error}", RESTORE)
                continue
            found = len(times)
            frames = np.arange(found) / fps
            if (off := np.flatnonzero(np.abs(times - times[:1] - frames) > 0.5 / fps)).size:
                what = (
                    f"its frames are not {1 / fps:.4g} s apart: frame {off[0]} is shown "
                    f"{times[off[0]] - times[0]:.3f} s after the first, and due after {frames[off[0]]:.3f} s, where "
                    "loaders look for it"
                )
                findings.error("video", name, what, f"Encode it again with {fps:g} frames a second.")
            if found != lengths.sum():
                what = f"it has {found} frames; its episodes have {lengths.sum()}"
                if found > lengths.sum():
                    what += ": of a discarded take, for example; images behind them are of other rows"
                findings.error("video", name, what, RESTORE)
            begin, end = (np.array([row[f"videos/{key}/{at}_timestamp"] for row in rows]) for at in ("from", "to"))
            expected = (np.cumsum(lengths) - lengths) / fps
            misplaced = (np.abs(begin - expected) > 0.5 / fps) | (np.abs(end - begin - lengths / fps) > 0.5 / fps)
            for position in np.flatnonzero(misplaced)[:3]:
                what = (
                    f"episode {rows[position]['episode_index']} has the place from "
                    f"{begin[position]:.3f} to {end[position]:.3f} s, and its {lengths[position]} frames begin at "
                    f"{expected[position]:.3f} s"
                )
                findings.error("video", name, what, "Restore meta/episodes from a copy.")


def _judge_outcomes(files: Files, findings: Findings) -> None:
    outcomes = [row.get(f"{PREFIX}outcome") for row in files.rows]
    if "outcome" not in files.metadata_types or not outcomes:
        return
    counts = Counter("unknown" if outcome is None else str(outcome) for outcome in outcomes)
    summary = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    brains = {json.loads(row[f"{PREFIX}brain"]).get("type") for row in files.rows if row.get(f"{PREFIX}brain")}
    if counts.get("success") or brains == {"noop"}:  # which attempts nothing
        findings.note("outcome", f"{len(outcomes)} episodes", summary)
    else:
        remedy = "Do not train an imitation policy on it."
        findings.warning("outcome", f"{len(outcomes)} episodes", f"none succeeded: {summary}", remedy)
