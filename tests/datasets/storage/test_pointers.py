"""A file that Git, or a pull of some episodes, did not fetch is no damage; it is to be fetched, not recovered."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from bhd_lerobot.datasets.edit.edits import delete, keep
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.loader.loader import LoaderConfig, make_loader
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.remote.local import open_local
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.pointers import NotFetchedError, check_fetched
from bhd_lerobot.datasets.validate.dataset import check_dataset
from tests.cases import each_case
from tests.datasets import support
from tests.datasets.edit_support import record
from tests.datasets.foreign import edit_json

LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "0f" * 32 + "\nsize 12345678\n"
ANNEX = "/annex/objects/SHA256E-s12345--" + "0f" * 32 + ".mp4\n"
DATA, ROWS = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{support.CAMERA}/chunk-000/file-000.mp4"
META = ("meta/info.json", "meta/tasks.parquet", ROWS)


def push(root: Path) -> None:
    with open_local(root):
        pass


def train(root: Path) -> None:
    make_loader("t/t", LoaderConfig(batch_size=2), root=root)


# What is done, and the files without which it cannot be.
COMMANDS: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "check": (check_dataset, (*META, "meta/stats.json", DATA, VIDEO)),
    "repair": (repair, (*META, "meta/stats.json", DATA, VIDEO)),
    "push": (push, (*META, "meta/stats.json", DATA, VIDEO)),
    "resume": (lambda root: support.resume(root, video=True), (*META, "meta/stats.json", DATA, VIDEO)),
    "train": (train, (*META, "meta/stats.json", DATA, VIDEO)),
    "filter": (lambda root: keep(root, [1], root.with_name("kept")), (*META, DATA, VIDEO)),
    "delete": (lambda root: delete(root, [0]), (*META, DATA, VIDEO)),
    "info": (dataset_info, META),
}


@pytest.mark.parametrize("is_ours", [True, False])
def test_no_command_takes_a_pointer_for_damage(video_episodes: Path, tmp_path: Path, is_ours: bool) -> None:
    root = Path(shutil.copytree(video_episodes, tmp_path / "d"))
    if not is_ours:
        (root / "meta/bhd.json").unlink()
    for name, (command, needed) in COMMANDS.items():
        if name == "resume" and not is_ours:
            continue
        for path in needed:
            content = (root / path).read_bytes()
            (root / path).write_text(LFS)
            before = {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()}
            with pytest.raises(NotFetchedError, match=r"pointer.* of Git.*`git lfs pull`"):
                command(root)
            assert {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()} == before, (name, path)
            (root / path).write_bytes(content)
    check_fetched(root)


@pytest.mark.parametrize("is_ours", [True, False])
def test_no_command_takes_what_was_not_pulled_for_damage(tmp_path: Path, is_ours: bool) -> None:
    root = record(tmp_path / "d", [0, 1], video=True)
    edit_json(root / layout.INFO, lambda info: info.update(data_files_size_in_mb=1e-6, video_files_size_in_mb=1e-6))
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    for path in ((root / VIDEO).with_name("file-001.mp4"), (root / DATA).with_name("file-001.parquet")):
        path.unlink()
        (root / layout.SUBSET).write_text('{"source": "me/d", "episodes": [0]}')
        if not is_ours:
            (root / layout.IDENTITY).unlink(missing_ok=True)
        before = {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()}
        for name in ("repair", "push", "filter", "delete", "info", *(["resume"] if is_ours else [])):
            with pytest.raises(NotFetchedError, match=r"some episodes .* only.*`bhd-data pull` without them"):
                COMMANDS[name][0](root)
        found = check_dataset(root)
        assert found.is_valid, found.findings
        assert any(path.name in finding.what for finding in found.findings if finding.where == layout.SUBSET)
        assert {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()} == before


@each_case(("text", "command"), [(LFS, "git lfs pull"), (ANNEX, "git annex get .")])
def test_the_message_names_the_files_and_the_command(video_episodes, tmp_path, text, command):
    root = Path(shutil.copytree(video_episodes, tmp_path / "d"))
    for path in (DATA, VIDEO):
        (root / path).write_text(text)
    with pytest.raises(NotFetchedError) as error:
        repair(root)
    assert f"{DATA}, {VIDEO} in {root} are pointers" in str(error.value)
    assert f"`{command}`" in str(error.value)
