"""Whatever is wrong with a dataset's files: `bhd-data` ends with a message and status 0, 1 or 2, never in a traceback.

A short form runs here; ``BHD_SWEEP=full`` runs thousands of examples, ``BHD_SWEEP=NUMBER`` the one of this number.
"""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.apps.view.dataset import ViewedDataset
from bhd_lerobot.cli.data import main
from bhd_lerobot.errors import DatasetError
from tests.cli.data import fuzz_support
from tests.datasets import support
from tests.datasets.loader import support as loader_support
from tests.recording.support import run_record

SEEDS = {"": range(60), "full": range(6000)}

GRANT = ("name", "wanted", "granted", "detail", "remedy")
READS: Mapping[str, Sequence[str]] = {
    "info": (), "info --short": ("--short",), "info --json": ("--json",), "check": (),
    "check --no-videos": ("--no-videos", "--json"), "filter": ("--outcome=all", "--output={out}"),
    "filter --exclude_late": ("--exclude_late", "--min_score=0", "--output={out}"),
    "split": ("--parts=a=0;b=1,2", "--output={out}"), "export": ("--output={out}",),
}  # fmt: skip
CHANGES: Mapping[str, Sequence[str]] = {
    "delete": ("--episodes=1",), "mark": ("--episodes=0", "--outcome=stuck", "--intervention=1-2"),
    "mark --clear_interventions": ("--episodes=1", "--clear_interventions"), "check --fix": ("--fix",), "repair": (),
}  # fmt: skip


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> list[Path]:
    """An edited recording of ours, one with videos, an unfinished one, and one of LeRobot's."""
    folder = tmp_path_factory.mktemp("sources")
    run_record(folder / "recorded", dataset__episode_time_s=1)
    main.main(["mark", str(folder / "recorded"), "--episodes=2", "--outcome=stuck"])
    (path,) = (folder / "recorded/meta/episodes").rglob("*.parquet")
    table = pq.read_table(path)
    for name, values in (("interventions", [[1, 3, "a person"]]), ("realtime", [dict.fromkeys(GRANT, "x")])):
        table = table.append_column(f"bhd/{name}", pa.array([json.dumps(values)] * table.num_rows))
    pq.write_table(table, path)
    run_record(
        folder / "video_dataset", dataset__episode_time_s=0.5, robot__camera="true", n_envs=1, dataset__num_episodes=2
    )
    support.killed(folder / "killed", 3, video=True)
    stock = loader_support.record_stock(folder / "stock", cameras=True)
    return [folder / "recorded", folder / "video_dataset", folder / "killed", stock]


def seeds() -> Sequence[int]:
    wanted = os.environ.get("BHD_SWEEP", "")
    return [int(wanted)] if wanted.isdecimal() else SEEDS["full" if wanted == "full" else ""]


def run(arguments: list[str]) -> int | str:
    """Return a command's exit status, or that it ended in something else than a message."""
    try:
        return main.main(arguments)
    except SystemExit as ended:
        return ended.code or 0


@pytest.mark.thorough
@pytest.mark.timeout(3600)  # the complete form takes minutes
def test_a_damaged_dataset_ends_no_command_in_a_traceback(sources: list[Path], tmp_path: Path, capsys) -> None:
    root, out = tmp_path / "data" / "d", tmp_path / "out"
    commands = {**READS, **CHANGES}
    names = [*commands, "merge", "view"]
    for seed in seeds():
        rng = np.random.default_rng(seed)
        source = sources[rng.integers(len(sources))]
        fuzz_support.fresh(source, root)
        what = [fuzz_support.damage(root, rng) for _ in range(rng.integers(1, 3))]
        name = names[rng.integers(len(names))]
        before = fuzz_support.contents(root.parent)
        shutil.rmtree(out, ignore_errors=True)
        if name == "merge":
            arguments = ["merge", str(root), str(source), f"--output={out}"]
        elif name in commands:
            command, *_ = name.split()
            arguments = [command, str(root), *(one.format(out=out) for one in commands[name])]
        where = f"seed {seed}: {name} of {source.name} with {'; '.join(what)}"
        try:
            status = view(root) if name == "view" else run(arguments)
        except Exception as error:
            raise AssertionError(f"{where} ends in {error!r}") from error
        output = capsys.readouterr()
        assert status in (0, 1, 2), where
        assert status == 0 or len((output.err or output.out).strip()) > 20 or name == "view", where
        assert "Traceback" not in output.err, where
        if name not in CHANGES or ("nothing was changed" in output.err.lower() and status == 2):
            assert fuzz_support.contents(root.parent) == before, where
        if status == 2 and name in (*READS, "merge"):  # which may have made a part of them
            assert not out.exists() or not any(out.rglob("info.json")), where


def view(root: Path) -> int:
    """Do what `bhd-data view` does before it serves the page, and what the page asks for first."""
    try:
        dataset = ViewedDataset(root)
        for index in range(dataset.state.num_episodes):
            dataset.packed(index)
    except DatasetError:
        return 2
    return 0
