"""A `meta/info.json` that is lost: every message leads to the next step that works, to its end."""

import json
import re
import shutil
from pathlib import Path

import pytest

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetError
from tests.datasets import support
from tests.datasets.edit_support import assert_valid, content, record


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("info") / "other", [5], video=True)


def torn(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:40])


def without_features(path: Path) -> None:
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "features"}))


@pytest.mark.parametrize("break_it", [torn, without_features, Path.unlink, lambda path: path.write_text("[]")])
def test_the_advice_works(video_episodes, other, tmp_path, capsys, break_it):
    root = Path(shutil.copytree(video_episodes, tmp_path / "d"))
    break_it(root / "meta/info.json")
    for command in ("info", "check", "repair", "view"):
        assert main.main([command, str(root)]) == 2
        advice = re.search(r"`bhd-data (repair .* --info) OTHER`", capsys.readouterr().err)
        assert advice is not None, command
    assert main.main([*advice[1].split(), str(other)]) == 0
    assert "3 episodes, 18 frames" in capsys.readouterr().out
    assert content(root) == content(video_episodes)
    assert_valid(root)
    with support.resume(root, video=True) as recorder:  # it is still the recorder's own
        support.record(recorder, video=True)
    assert dataset_info(root).episodes[-1].metadata == support.metadata(3)


def test_an_interrupted_recording_of_ours_loses_nothing(other: Path, tmp_path: Path) -> None:
    root = tmp_path / "d"
    support.killed(root, 3, video=True)
    torn(root / "meta/info.json")
    report = repair(root, other)
    assert (report.episodes, report.lost) == (3, ())
    assert_valid(root)
    assert [episode.metadata["seed"] for episode in dataset_info(root).episodes] == [0, 1, 2]


def test_info_that_is_not_needed_or_cannot_be_used_changes_nothing(
    video_episodes: Path, other: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(video_episodes, tmp_path / "d"))
    stranger = tmp_path / "stranger"
    features = {"action": {"dtype": "float32", "shape": (1,), "names": ["x"]}}
    DatasetRecorder.create("t/none", 10, features, robot_type="toy", root=stranger, recording={}).finalize()
    (tmp_path / "v2.json").write_text((root / "meta/info.json").read_text().replace("v3.0", "v2.1"))
    before = support.snapshot(root)
    for donor, message in ((other, "can be read and fits"), (root, "is the dataset's own")):
        with pytest.raises(ConfigError, match=message):
            repair(root, donor)
    (root / "meta/info.json").unlink()
    (tmp_path / "list.json").write_text("[1]")
    for donor, message in (
        (stranger, "does not describe event, next.done, note"),
        (tmp_path / "none", "No such file"),
        (tmp_path, "No such file"),
        (tmp_path / "list.json", "no JSON object"),
        (tmp_path / "v2.json", "this program reads v3.x"),
    ):
        with pytest.raises(ConfigError, match=message):
            repair(root, donor)
    del before["meta/info.json"]
    assert support.snapshot(root) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d", "list.json", "stranger", "v2.json"]


def test_a_wrong_count_of_frames_leads_to_check_fix(video_episodes: Path, tmp_path: Path, capsys) -> None:
    root = Path(shutil.copytree(video_episodes, tmp_path / "d"))
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "total_frames": 7}))
    assert main.main(["repair", str(root)]) == 2
    advice = re.search(r"`bhd-data (check .* --fix)`", capsys.readouterr().err)
    assert advice is not None
    assert main.main(advice[1].split()) == 0
    assert main.main(["repair", str(root)]) == 0
    assert content(root) == content(video_episodes)


def test_repair_never_advises_repair(video_episodes: Path, tmp_path: Path) -> None:
    for pattern in ("data/*/*.parquet", "meta/episodes/*/*.parquet", "videos/*/*/*.mp4", "meta/tasks.parquet"):
        root = Path(shutil.copytree(video_episodes, tmp_path / pattern[:4]))
        path = next(root.glob(pattern))
        path.write_bytes(bytes(30) if path.suffix == ".parquet" else b"video")
        try:
            message = str(repair(root))
        except DatasetError as error:
            message = str(error)
        assert "bhd-data repair" not in message
        assert path.name in message
        shutil.rmtree(root)


def test_a_folder_of_datasets_names_them(video_episodes: Path, other: Path, tmp_path: Path, capsys) -> None:
    for name in ("b", "a"):
        shutil.copytree(other, tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    for command in ("info", "check", "repair", "view"):
        assert main.main([command, str(tmp_path)]) == 2
        assert "It holds some; name one: a, b." in capsys.readouterr().err
        assert main.main([command, str(tmp_path / "link")]) == 2
        assert "is a broken link" in capsys.readouterr().err
        assert main.main([command, str(other / "meta/info.json")]) == 2
        assert "is a file" in capsys.readouterr().err
