"""Files, rows, frames and instructions in another order than their numbers are found and put in order."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from bhd_lerobot.datasets.edit.edits import edits_of, keep
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.format.columns import read_episodes
from bhd_lerobot.datasets.format.video_splice import splice
from bhd_lerobot.datasets.loader.loader import LoaderConfig, make_loader
from bhd_lerobot.datasets.loader.table_dataset import TableDataset
from bhd_lerobot.datasets.recovery.fix import fix
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.validate.findings import FIX
from bhd_lerobot.datasets.writer.recorder import RootLock
from bhd_lerobot.errors import DatasetCorruptError, DatasetError
from tests.cases import each_case
from tests.datasets import foreign, support
from tests.datasets.edit_support import assert_valid, content, record
from tests.datasets.loader.support import stock

DATA, ROWS, TASKS = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"
Damage = Callable[[Path], Any]


def files(*slots: int, **options: Any) -> Damage:
    return lambda root: foreign.write(root, files=slots, **options)


def changed(name: str, change: Callable[[dict[str, Any]], object], **options: Any) -> Damage:
    def damage(root: Path) -> None:
        foreign.edit(foreign.write(root, **options) / name, change)

    return damage


def shuffle(order: list[int]) -> Callable[[dict[str, Any]], object]:
    return lambda values: values.update({key: [column[i] for i in order] for key, column in values.items()})


def put(name: str, values: list[Any]) -> Callable[[dict[str, Any]], object]:
    return lambda columns: columns.update({name: values})


def later(rows: dict[str, Any]) -> None:
    for name in ("dataset_from_index", "dataset_to_index"):
        rows[name] = [number + 4 for number in rows[name]]


def numbered(*numbers: int) -> Damage:
    """Give the instructions these numbers, in the file and in the frames."""

    def damage(root: Path) -> None:
        def change(episode: int, columns: foreign.Columns) -> None:
            columns["task_index"][:] = numbers[episode]

        foreign.write(root, change=change)
        foreign.write_tasks(root, dict(zip(numbers, foreign.TASKS, strict=True)))

    return damage


def renamed(root: Path) -> None:
    """Count the rows of the instructions backwards; their numbers stay."""
    foreign.write_tasks(foreign.write(root), dict(reversed(list(enumerate(foreign.TASKS)))))


def left_over(root: Path) -> None:
    """Leave a data file that no episode is described in, before all others."""
    foreign.write(root, files=(1, 1, 1))
    shutil.copy(root / "data/chunk-000/file-001.parquet", root / DATA)


def copied(name: str, stem: str) -> Damage:
    """Leave a copy of a file under a name of its own, which LeRobot reads, too."""

    def damage(root: Path) -> None:
        foreign.write(root)
        shutil.copy(root / name, (root / name).with_name(f"{stem}.parquet"))

    return damage


def apart(root: Path) -> None:
    """Number the episodes 5, 15 and 25, in their rows and in the frames."""
    foreign.write(root)
    for name in (ROWS, DATA):
        foreign.edit(
            root / name, lambda values: values.update(episode_index=[10 * n + 5 for n in values["episode_index"]])
        )


SHUFFLED = np.random.default_rng(0).permutation(sum(foreign.LENGTHS)).tolist()
LISTS = [[task] for task in foreign.TASKS]

# What is wrong; the check and the place that name it; whether `--fix` corrects it, and whether `repair` does.
CASES: dict[str, tuple[Damage, str, str, bool, bool]] = {
    "files in another order": (files(1, 1, 0), "order", "data", True, True),
    "episodes of a file that do not follow each other": (files(0, 1, 0), "order", "data", True, True),
    "file numbers of four digits": (files(999, 999, 1000), "order", "data", True, True),
    "rows of a file": (changed(DATA, shuffle(SHUFFLED)), "order", DATA, True, True),
    "rows and files": (changed(DATA, shuffle([2, 0, 1, 4, 3]), files=(0, 1, 1)), "order", DATA, True, True),
    "index": (changed(DATA, put("index", list(range(20, 33)))), "counts", DATA, True, True),
    "rows of the episodes": (changed(ROWS, shuffle([2, 0, 1])), "order", "meta/episodes", True, True),
    "rows of the instructions": (renamed, "order", TASKS, True, True),
    "other instructions": (changed(ROWS, put("tasks", LISTS[::-1])), "counts", "meta/episodes", True, True),
    "an unknown instruction": (changed(ROWS, put("tasks", [["x"], *LISTS[1:]])), "counts", "meta/episodes", True, True),
    "no instruction": (changed(ROWS, put("tasks", [[], *LISTS[1:]])), "counts", "meta/episodes", True, True),
    "numbers of instructions": (numbered(5, 15, 25), "counts", TASKS, False, True),
    "negative numbers": (changed(DATA, put("index", list(range(-3, 10)))), "counts", DATA, True, True),
    "frames that do not begin at 0": (changed(ROWS, later), "counts", ROWS, False, True),
    "episodes in each other's file": (
        lambda root: foreign.edit(foreign.write(root, (4, 4, 4), (0, 1, 2)) / ROWS, put("data/file_index", [1, 0, 2])),
        "counts", DATA, False, True,
    ),
    "a data file before the others": (left_over, "order", DATA, False, True),
    "a copy of a data file": (copied(DATA, "backup"), "order", "data/chunk-000/backup.parquet", False, False),
    "a copy of the episodes": (copied(ROWS, "old"), "order", "meta/episodes/chunk-000/old.parquet", False, False),
    "numbers of episodes": (apart, "counts", "meta/episodes", False, True),
}  # fmt: skip


def served(root: Path) -> list[tuple[int, int, float, str]]:
    """Return episode, frame, action and instruction of each sample of stock LeRobot."""
    dataset = stock(root, delta_timestamps={"action": [0.0]})
    samples = [dataset[i] for i in range(len(dataset))]
    return [(int(s["episode_index"]), int(s["frame_index"]), float(s["action"].squeeze()), s["task"]) for s in samples]


def truth(lengths: tuple[int, ...]) -> list[tuple[int, int, float, str]]:
    return [
        (episode, frame, foreign.action(episode, frame), foreign.TASKS[episode])
        for episode, length in enumerate(lengths)
        for frame in range(length)
    ]


def lengths_of(case: str) -> tuple[int, ...]:
    return (4, 4, 4) if case == "episodes in each other's file" else foreign.LENGTHS


def test_a_dataset_in_order_has_no_finding(tmp_path: Path) -> None:
    for slots in (None, (0, 0, 1), (3, 4, 5)):
        root = foreign.write(tmp_path / str(slots), files=slots)
        assert foreign.check(root).findings == ()
        assert not repair(root)
        assert served(root) == truth(foreign.LENGTHS)


@pytest.mark.thorough(but=8)
@pytest.mark.parametrize("case", CASES)
def test_another_order_is_found_and_corrected(tmp_path: Path, case: str) -> None:
    damage, check, where, by_fix, by_repair = CASES[case]
    for name, correct in (("fix", by_fix), ("repair", by_repair)):
        root = tmp_path / name
        damage(root)
        found = foreign.errors(root)
        assert (check, where) in [(one.check, one.where) for one in found], found
        assert all(FIX in one.remedy for one in found) == by_fix, found
        done = fix(root, foreign.check(root).findings) if name == "fix" else repair(root)
        assert bool(done) == correct
        if correct:
            assert foreign.errors(root) == []
            assert served(root) == truth(lengths_of(case))
            assert not repair(root)
            assert not fix(root, foreign.check(root).findings)
            if name == "fix":
                assert [one["episodes"] for one in edits_of(root)] == [[0, 1, 2]]
            RootLock(root).release()


@pytest.mark.thorough
@each_case("case", [case for case in CASES if CASES[case][3]])
def test_edits_put_the_episodes_in_order(tmp_path: Path, case: str) -> None:
    CASES[case][0](tmp_path / "d")
    keep(tmp_path / "d", [0, 1, 2], tmp_path / "kept")
    mark(tmp_path / "d", [1], outcome="failure")
    for name in ("d", "kept"):
        assert foreign.errors(tmp_path / name) == []
        assert served(tmp_path / name) == truth(foreign.LENGTHS)


def test_instructions_numbered_with_gaps_keep_their_words(tmp_path: Path) -> None:
    """Also where no row of an episode tells which number has which words."""
    numbers = (5, 15, 25)

    def change(episode: int, columns: foreign.Columns) -> None:
        columns["task_index"][:] = numbers[episode]
        columns["task_index"][:3] = numbers[0]

    root = foreign.write(tmp_path / "d", (5, 4, 7), change=change)
    foreign.write_tasks(root, dict(zip(numbers, foreign.TASKS, strict=True)))
    first, *others = foreign.TASKS
    foreign.edit(root / ROWS, put("tasks", [[first], *([first, other] for other in others)]))
    report = repair(root)
    assert (report.episodes, report.lost) == (3, ())
    assert foreign.errors(root) == []
    wanted = [first if frame < 3 else foreign.TASKS[episode] for episode, frame, *_ in truth((5, 4, 7))]
    assert [task for *_, task in served(root)] == wanted


@each_case("case", ["numbers of instructions", "episodes in each other's file"])
def test_edits_refuse_what_repair_corrects(tmp_path: Path, case: str) -> None:
    CASES[case][0](tmp_path / "d")
    with pytest.raises(DatasetCorruptError, match="bhd-data repair"):
        keep(tmp_path / "d", [0, 1, 2], tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


@each_case("case", [case for case in CASES if CASES[case][3]])
def test_readers_of_ours_go_by_the_numbers(tmp_path: Path, case: str) -> None:
    CASES[case][0](tmp_path / "d")
    actions = [one["action"].tolist() for one in read_episodes(tmp_path / "d", range(3))]
    assert actions == [[foreign.action(e, i) for i in range(n)] for e, n in enumerate(foreign.LENGTHS)]


@pytest.mark.thorough
@each_case("case", [case for case in CASES if "numbers" not in case])
def test_a_training_gets_the_right_frames_or_an_error(tmp_path: Path, case: str) -> None:
    CASES[case][0](tmp_path / "d")
    for budget in (1.0, 1e-9):  # in memory, and by LeRobot's own loader
        messages: list[str] = []
        config = LoaderConfig(batch_size=5, delta_timestamps={"action": [0.0]}, budget_gib=budget, keep=["action"])
        try:
            loaders = make_loader("t/t", config, root=tmp_path / "d", report=messages.append)
        except DatasetError as error:
            assert FIX in str(error) or "bhd-data repair" in str(error)  # noqa: PT017
            assert messages == []
            continue
        samples = []
        for batch in loaders.train:
            columns = (batch[key].reshape(-1).tolist() for key in ("episode_index", "frame_index", "action"))
            samples += zip(*columns, batch["task"], strict=True)
        assert sorted(samples) == truth(lengths_of(case))


def test_the_order_of_a_dataset_in_memory_is_that_of_its_numbers(tmp_path: Path) -> None:
    """A sampler of LeRobot's asks for frames by number."""
    dataset = TableDataset("t/t", foreign.write(tmp_path / "d", files=(1, 1, 0)))
    places = dataset.absolute_to_relative_idx
    assert places is not None
    assert [int(dataset[places[i]]["index"]) for i in range(13)] == list(range(13))


def test_contradicting_numbers_are_left_as_they_are(tmp_path: Path) -> None:
    """Sorted by them, other columns of the frames would be in no order."""
    root = foreign.write(tmp_path / "d")
    foreign.edit(root / DATA, put("frame_index", [0, 1, 3, 2, 4, 0, *range(7)]))
    before = (root / DATA).read_bytes()
    (one,) = foreign.errors(root)
    assert (one.check, one.what) == ("counts", "frame_index is 3 in row 2, where meta/episodes has 2")
    assert FIX not in one.remedy
    assert fix(root, foreign.check(root).findings) == []
    with pytest.raises(DatasetCorruptError):
        keep(root, [0, 1], tmp_path / "kept")
    assert (root / DATA).read_bytes() == before


@pytest.mark.parametrize("video", [False, True])
def test_a_recording_of_ours_is_put_in_order_and_can_be_continued(tmp_path: Path, video: bool) -> None:
    root = record(tmp_path / "d", [0, 1, 2], video=video)
    before = content(root)
    table = pq.read_table(root / DATA)
    order = np.random.default_rng(1).permutation(table.num_rows)
    pq.write_table(table.take(order), root / DATA)
    assert [(one.check, one.where) for one in foreign.errors(root)] == [("order", DATA)]
    assert "in the order of their numbers" in str(repair(root))
    assert content(root) == before
    assert_valid(root)
    with support.resume(root, video=video) as recorder:
        support.record(recorder, video=video)
    assert [episode.columns for episode in content(root)][:3] == [episode.columns for episode in before]


def test_a_recording_whose_files_are_in_another_order_is_not_continued(tmp_path: Path) -> None:
    """The next file would take the place of one that is there."""
    root = record(tmp_path / "d", [0, 1, 2])
    before, table = content(root), pq.read_table(root / DATA)
    last = pa.compute.equal(table["episode_index"], 2)
    pq.write_table(table.filter(pa.compute.invert(last)), root / DATA.replace("000.p", "001.p"))
    pq.write_table(table.filter(last), root / DATA)
    foreign.edit(root / ROWS, put("data/file_index", [1, 1, 0]))
    held = support.snapshot(root)
    with pytest.raises(DatasetCorruptError, match="bhd-data repair"):
        support.resume(root)
    assert support.snapshot(root) == held
    assert repair(root)
    assert content(root) == before
    assert_valid(root)


def test_episodes_may_lie_in_a_video_in_any_order(tmp_path: Path) -> None:
    """Videos are found by their times; LeRobot reads them as they are."""
    root = record(tmp_path / "d", [0, 1, 2], video=True)
    before, video = content(root), next(root.glob("videos/*/*/*.mp4"))
    spans = [(0, 5), (5, 6), (11, 7)]
    assert [span[1] for span in spans] == [support.length(episode) for episode in range(3)]
    splice([(video, [spans[2], spans[0], spans[1]])], tmp_path / "other.mp4", support.FPS)
    shutil.copy(tmp_path / "other.mp4", video)
    for one, starts in (("from", [7, 12, 0]), ("to", [12, 18, 7])):
        foreign.edit(root / ROWS, put(f"videos/{support.CAMERA}/{one}_timestamp", [n / support.FPS for n in starts]))
    assert foreign.errors(root) == []
    assert not repair(root)
    assert content(root) == before
    keep(root, [2, 0], tmp_path / "kept")
    assert [episode.videos for episode in content(tmp_path / "kept")] == [before[2].videos, before[0].videos]
    ours, theirs = TableDataset("t/t", root, return_uint8=True), stock(root, return_uint8=True)
    for frame in range(18):
        assert torch.equal(ours[frame][support.CAMERA], theirs[frame][support.CAMERA])
