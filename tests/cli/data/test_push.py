"""bhd-data push and pull, and what uploads by itself: against a Hub on this machine, through the real client."""

import json
import os
import re
import shlex
import shutil
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml

from bhd_lerobot.cli import record as record_module
from bhd_lerobot.cli.data import main
from bhd_lerobot.cli.data.check import limits_of
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.remote.push import is_generated
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.errors import TransferError
from bhd_lerobot.evaluation.statistics import wilson
from bhd_lerobot.hub.card import CardOptions, make_card
from tests.datasets import support
from tests.datasets.support import snapshot as content
from tests.fake_hub.hub import FakeHub, Fault, real_client
from tests.forks import Fork
from tests.recording.support import options as record_options
from tests.recording.support import run_record
from tests.training.support import MLP, make_dataset, run_train
from tests.training.support import options as train_options
from tests.waiting import until


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def text_of(hub: FakeHub, name: str, path: str = "README.md") -> str:
    return hub.dataset(name).files()[path].content.decode()


def test_there_and_back(hub: FakeHub, drives: Path, tmp_path: Path, capsys) -> None:
    before = content(drives)
    assert main.main(["push", str(drives), "me/avoid"]) == 0
    assert "me/avoid: 3 episodes\n  sent" in capsys.readouterr().out
    assert main.main(["push", str(drives), "--repo_id=me/avoid"]) == 0
    assert "nothing to send" in capsys.readouterr().out
    assert main.main(["pull", "me/avoid", f"--root={tmp_path / 'e'}"]) == 0
    assert "fetched" in capsys.readouterr().out
    assert content(drives) == before
    assert {**content(tmp_path / "e")} == before | {
        name: hub.dataset("me/avoid").files()[name].content for name in ("README.md", "preview.png")
    }
    assert not [
        finding for finding in check_dataset(tmp_path / "e", limits_of).findings if finding.severity.word == "error"
    ]
    # The card came along; to push what was pulled sends nothing.
    assert main.main(["push", str(tmp_path / "e"), "me/avoid"]) == 0
    assert "nothing to send" in capsys.readouterr().out


@pytest.mark.figures
def test_the_card_says_what_is_in_the_dataset(hub: FakeHub, drives: Path) -> None:
    assert main.main(["push", str(drives), "me/avoid", "--tags=roaming,small", "--licence=mit"]) == 0
    card = text_of(hub, "me/avoid")
    assert is_generated(card.encode())
    front = yaml.safe_load(card.split("---\n")[1])
    assert front["license"] == "mit"
    assert front["task_categories"] == ["robotics"]
    assert front["tags"] == ["LeRobot", "bhd_lerobot", "turtlebot3", "avoid", "roaming", "small"]
    assert front["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    summary = dataset_info(drives)
    for key in summary.features:
        assert f"| `{key}` |" in card
    assert "m/s" in card
    outcomes = [str(episode.metadata["outcome"]) for episode in summary.episodes]
    for outcome in set(outcomes):
        assert f"| {outcome} | {outcomes.count(outcome)} | {100 * outcomes.count(outcome) / 3:.0f} % |" in card
    successes = sum(bool(episode.metadata["success"]) for episode in summary.episodes)
    share = wilson(successes, 3)
    assert f"{successes} of 3 episodes succeeded: {100 * share.value:.1f} %" in card
    assert f"{100 * share.low:.1f} to {100 * share.high:.1f} %" in card
    folded = re.search(r"<details>.*```json\n(.*)\n```\n\n</details>", card, re.DOTALL)
    assert folded is not None
    assert json.loads(folded[1]) == json.loads((drives / "meta/bhd.json").read_text())
    assert 'LeRobotDataset("me/avoid")' in card
    assert "](preview.png)" in card
    preview = hub.dataset("me/avoid").files()["preview.png"].content
    from matplotlib.image import imread

    (Path(os.environ["HF_HOME"]) / "p.png").write_bytes(preview)
    image = imread(Path(os.environ["HF_HOME"]) / "p.png")
    assert image.shape[0] > 200
    assert image[..., :3].std() > 0.05


def test_an_instruction_is_one_cell_of_the_card(tmp_path: Path) -> None:
    with support.create(tmp_path / "d") as recorder:
        writer = support.fill(recorder.begin_episode(), 0)
        recorder.save(writer, task="open the <left|right> door", metadata=support.metadata(0))
        recorder.finalize()
    card = make_card(load_state(tmp_path / "d"), CardOptions("me/d"), has_image=True).text
    assert "| instruction | open the &lt;left\\|right> door |" in card


@pytest.mark.figures
def test_images_of_cameras_and_of_curves(hub: FakeHub, lesson: Path, tmp_path: Path) -> None:
    videos = make_dataset(tmp_path / "videos", episodes=2, camera=True)
    for root, caption in ((videos, "as `observation.images.front` saw it"), (lesson, "observations and actions")):
        assert main.main(["push", str(root), f"me/{root.name}"]) == 0
        assert caption in text_of(hub, f"me/{root.name}")
        assert hub.dataset(f"me/{root.name}").files()["preview.png"].content.startswith(b"\x89PNG")


def test_a_failure_says_what_is_kept_and_how_to_repeat(hub: FakeHub, lesson: Path, tmp_path: Path, capsys) -> None:
    hub.expired.add("hf_me")
    assert main.main(["push", str(lesson), "me/d", "--branch=b", "--private", "--tags=a b,c"]) == 2
    error = capsys.readouterr().err
    assert f"The dataset at {lesson} is unchanged" in error
    command = error.strip().splitlines()[-1].strip()
    hub.expired.clear()
    assert main.main(shlex.split(command)[1:]) == 0  # as printed
    assert hub.dataset("me/d").private
    assert "meta/info.json" in hub.dataset("me/d").files("b")
    hub.expired.add("hf_me")
    assert main.main(["pull", "me/d", f"--root={tmp_path / 'my e'}", "--revision=b", "--episodes=1"]) == 2
    command = capsys.readouterr().err.strip().splitlines()[-1].strip()
    hub.expired.clear()
    assert main.main(shlex.split(command)[1:]) == 0
    assert (tmp_path / "my e" / "meta/info.json").is_file()


def push_to_a_hub_that_stalls(root: Path, asked: Path) -> int:
    """Upload in a process of its own; a file appears as soon as the upload waits."""
    hub = FakeHub()
    hub.faults = [Fault("^PUT", times=-1, meanwhile=lambda: (asked.touch(), threading.Event().wait()))]
    with real_client(hub):
        try:
            return main.main(["push", str(root), "me/d", "--no-card"])
        finally:
            assert list(hub.dataset("me/d").files()) == [".gitattributes"]


def test_ctrl_c_ends_a_stalled_upload_at_once(lesson: Path, tmp_path: Path) -> None:
    process = Fork(push_to_a_hub_that_stalls, lesson, tmp_path / "asked", output=tmp_path / "log")
    until((tmp_path / "asked").exists)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    error = (tmp_path / "log").read_text()
    assert f"Stopped; the dataset at {lesson} is unchanged" in error
    assert error.endswith(f"\n  bhd-data push {lesson} me/d --no-card\n")  # to be copied
    assert "Traceback" not in error


# --- what uploads by itself


def test_recording_uploads_by_the_same_code(hub: FakeHub, tmp_path: Path, capsys) -> None:
    root = tmp_path / "d"
    short = {"dataset__repo_id": "me/avoid", "dataset__push_to_hub": "true", "dataset__num_episodes": 1}
    _, output = run_record(root, **short, dataset__private="true", dataset__tags="[avoid]")
    assert "me/avoid: 1 episode" in output
    assert hub.dataset("me/avoid").private
    assert is_generated(text_of(hub, "me/avoid").encode())
    hub.faults = [Fault("/preupload/", times=-1, status=403)]
    assert record_module.main(record_options(tmp_path / "e", **short | {"dataset__num_episodes": 2})) == 2
    error = capsys.readouterr().err
    assert "no permission" in error
    assert f"bhd-data push {tmp_path / 'e'} me/avoid" in error
    assert len(dataset_info(tmp_path / "e").episodes) == 2


def test_recording_does_not_begin_what_cannot_be_uploaded(hub: FakeHub, tmp_path: Path, monkeypatch, capsys) -> None:
    wanted = {"dataset__push_to_hub": "true", "dataset__num_episodes": 1}
    assert record_module.main(record_options(tmp_path / "d", **wanted, dataset__repo_id="avoid")) == 2
    assert "user/name" in capsys.readouterr().err
    monkeypatch.delenv("HF_TOKEN")
    assert record_module.main(record_options(tmp_path / "d", **wanted)) == 2
    assert "no token" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_policy_that_cannot_be_uploaded_is_kept(hub: FakeHub, lesson: Path, tmp_path: Path, monkeypatch) -> None:
    short = {"steps": 1, "policy__push_to_hub": "true", "policy__repo_id": "me/brain"}
    result, _ = run_train(train_options(lesson, tmp_path / "good", MLP, **short))
    pushed = hub.repositories["models/me/brain"].files()
    folder = result.checkpoint / "pretrained_model"  # type: ignore[operator]
    for name in ("config.json", "model.safetensors", "bhd.json"):
        assert pushed[name].content == (folder / name).read_bytes()
    hub.faults = [Fault("/preupload/", times=-1, status=403)]
    with pytest.raises(TransferError, match="no permission") as caught:
        run_train(train_options(lesson, tmp_path / "bad", MLP, **short))
    checkpoint = tmp_path / "bad/checkpoints/000001"
    assert (checkpoint / "pretrained_model/model.safetensors").is_file()
    assert f"The policy is complete at {checkpoint}" in str(caught.value)
    assert f"hf upload me/brain {checkpoint}/pretrained_model ." in str(caught.value)
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(TransferError, match="no token"):
        run_train(train_options(lesson, tmp_path / "none", MLP, **short))
    assert not (tmp_path / "none/checkpoints").exists()


@pytest.mark.thorough
def test_streaming_gives_the_same_samples(hub: FakeHub, drives: Path, monkeypatch) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

    assert main.main(["push", str(drives), "me/avoid"]) == 0
    monkeypatch.setattr("datasets.config.HF_HUB_OFFLINE", False)
    deltas = {"action": [0.0, 0.1, 0.2]}
    reference = LeRobotDataset("t/t", root=drives, delta_timestamps=deltas)
    for where in ({"repo_id": "me/avoid"}, {"repo_id": "t/t", "root": drives}):
        streamed = StreamingLeRobotDataset(**where, delta_timestamps=deltas, buffer_size=20, shuffle=False)  # type: ignore
        seen = set()
        for sample in streamed:
            wanted = reference[int(sample["index"])]
            assert set(sample) == set(wanted)
            for key in ("observation.state", "action", "action_is_pad", "simulation.state"):
                np.testing.assert_array_equal(np.asarray(sample[key]), np.asarray(wanted[key]), key)
            seen.add(int(sample["index"]))
        assert seen == set(range(len(reference)))
    assert hub.asked(r"GET /datasets/me/avoid/resolve/.*\.parquet")
    shutil.rmtree(Path(os.environ["HF_LEROBOT_HOME"]) / "hub", ignore_errors=True)


def test_a_name_that_could_be_a_folder_gets_a_warning(hub: FakeHub, lesson: Path, empty: Path, capsys) -> None:
    """`store/c3` may be meant as the folder beside this one; nothing in its form says which."""
    (empty / "store").mkdir()
    assert main.main(["push", str(lesson), "store/c3"]) == 2
    error = capsys.readouterr().err
    assert f"store/c3 is taken for a name on the Hub. The folder here would be file://{empty}/store/c3\n" in error
    assert "no permission" in error
    assert main.main(["push", str(lesson), f"file://{empty}/store/c3"]) == 0
    assert main.main(["pull", "store/c3", "--root=x"]) == 2
    assert "is taken for a name on the Hub" in capsys.readouterr().err
    shutil.copytree(lesson, empty / "me" / "d")
    assert main.main(["push", "me/d", "me/d"]) == 0  # the dataset itself: nobody means to copy it onto itself
    assert "is taken for" not in capsys.readouterr().err
