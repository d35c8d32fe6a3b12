"""One reader of `meta/info.json`: LeRobot's defaults for what is missing, and a clear error for what is not valid."""

import copy
import importlib.util
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from lerobot.datasets.utils import DatasetInfo

from bhd_lerobot.datasets.edit.edits import keep
from bhd_lerobot.datasets.format.info import CONVERT, COUNTS, InfoError, checked_info, parse_object
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.loader.table import open_metadata
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.errors import DatasetError
from tests.datasets import edit_support

REQUIRED = ("codebase_version", "features", "fps", *COUNTS)
WRONG: dict[str, tuple[Any, ...]] = {
    "features": (None, [], "x", 3, {"a": None}, {"a": {"dtype": 3, "shape": [1]}}, {"a": {"dtype": "x"}}),
    "fps": (None, "10", 0, -1, True, math.nan, math.inf, 10**400, [10], 1e-300),
    "total_episodes": (None, "1", -1, 1.0, True, math.nan, 2**63),
    "total_frames": (None, "1", -1, 1.0, [], 10**400),
    "total_tasks": (None, {}, -1, 1.5),
    "chunks_size": (None, "1000", 0, -5, 1.5, True, math.nan, 2**31),
    "data_files_size_in_mb": (None, "100", 0, -1, True, math.nan, math.inf, 10**400),
    "video_files_size_in_mb": (None, [], 0, -1, math.nan),
    "data_path": (3, [], {}, True),
    "video_path": (3, [], {}, False),
    "robot_type": (3, [], {}, True),
    "splits": (3, "train", [], True),
}


@pytest.fixture
def info(three_episodes: Path) -> dict[str, Any]:
    return json.loads((three_episodes / "meta/info.json").read_text())


def test_missing_keys_have_lerobots_defaults(info) -> None:
    required = {key: info[key] for key in REQUIRED}
    theirs = DatasetInfo.from_dict(copy.deepcopy(required)).to_dict()
    assert checked_info(required, "d") == theirs
    # What is there stays, also what nobody here knows.
    assert checked_info({**info, "more": [1]}, "d") == {**info, "more": [1]}


def test_datasets_without_the_optional_keys_can_be_edited_and_repaired(
    three_episodes: Path, info, tmp_path: Path
) -> None:
    optional = [key for key in info if key not in REQUIRED]
    for left_out in ([key] for key in [*optional, None]):
        root = Path(shutil.copytree(three_episodes, tmp_path / "d"))
        gone = optional if left_out == [None] else left_out
        (root / "meta/info.json").write_text(json.dumps({key: v for key, v in info.items() if key not in gone}))
        keep(root, [0, 2], tmp_path / "kept")
        assert repair(root).episodes == 3
        assert len(edit_support.content(tmp_path / "kept")) == 2
        edit_support.assert_valid(tmp_path / "kept")
        shutil.rmtree(root)
        shutil.rmtree(tmp_path / "kept")


def test_invalid_values_are_named_and_nothing_is_changed(three_episodes: Path, info, tmp_path: Path) -> None:
    root = Path(shutil.copytree(three_episodes, tmp_path / "d"))
    cases = [(key, value) for key, values in WRONG.items() for value in values]
    for key, value in [*cases, *((key, KeyError) for key in REQUIRED)]:
        changed = {**info, key: value}
        if value is KeyError:
            del changed[key]
        with pytest.raises(InfoError, match=key if key != "features" else "feature"):
            checked_info(changed, "d")
        (root / "meta/info.json").write_text(json.dumps(changed))
        before = {path: path.read_bytes() for path in root.rglob("*.*")}
        for action in (dataset_info, open_metadata, lambda root: keep(root, [0], tmp_path / "new")):
            with pytest.raises(DatasetError, match=r"info\.json is corrupt: ") as error:
                action(root)
            assert len(str(error.value)) < 1000
        if key in COUNTS:
            with pytest.raises(DatasetError):
                repair(root)
        assert {path: path.read_bytes() for path in root.rglob("*.*")} == before, (key, value)
    assert not (tmp_path / "new").exists()


def test_anything_but_a_json_object_is_refused_with_a_reason() -> None:
    for content, reason in (
        (b"", "Expecting value"),
        (b"[1]", "a list and no JSON object"),
        (b"[" * 100_000, "nested too deeply"),
        (b"\xff{}", "utf-8"),
        (b'{"a": ' + b"1" * 5000 + b"}", "4300 digits"),
        (b'{"\\ud800": 1}', "surrogates"),
    ):
        with pytest.raises(InfoError, match=reason):
            parse_object(content)


def test_another_version_is_reported_first() -> None:
    module = CONVERT.split()[2]
    assert importlib.util.find_spec(module) is not None
    for version in ("v2.1", 3.0, None):
        with pytest.raises(DatasetError, match=rf"dataset format {version}; this program reads v3\.x.* {module} "):
            checked_info({"codebase_version": version, "features": 3, "fps": "x"}, "d", counts=False)
