"""The demo runs without further input, names files that exist, and takes nothing away from a folder that it finds."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

from bhd_lerobot.apps import demo
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.cli.demo import main
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout.signals import StopRequest
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.world import World
from bhd_lerobot.training.arguments import parse_train
from tests.cases import each_case

pytestmark = pytest.mark.figures

SMALL = {"episodes": 2, "steps": 4, "trials": 2, "video": False}  # videos are the slowest part, and tested elsewhere
AVOID = replace(
    demo.AVOID,
    **SMALL,
    world=("--robot.type=turtlebot3", "--robot.beams=36", "--task.type=avoid", "--task.duration_s=2", "--threads=1"),
)
REACH = replace(
    demo.REACH,
    **SMALL,
    early_steps=2,
    world=(*demo.REACH.world, "--threads=1"),
)
PICK = replace(demo.PICK, episodes=1, video=False, options=("--threads=1",))
SEE = replace(
    demo.SEE,
    episodes=12,
    batch=4,
    steps=2,
    trials=1,
    world=("--robot.type=ur5", "--robot.camera=true", "--robot.camera_width=96", "--robot.camera_height=72"),
    policy=("--policy.channels=4", "--policy.hidden=4", "--policy.context=4"),
)


def _can_render() -> bool:
    try:
        Camera(World(turtlebot3_burger(), 1), 32, 24).close()
    except RenderingError:
        return False
    return True


CAN_RENDER = _can_render()


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(demo, "LESSONS", (AVOID, REACH, PICK))
    monkeypatch.setenv("COLUMNS", "160")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Return the folder of a small demo, and what it printed."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "LESSONS", (AVOID, REACH, PICK))
        patch.setattr(demo, "SEE", SEE)
        patch.setattr(demo.Demo, "_can_render", CAN_RENDER)  # whether there is a video says it otherwise
        patch.setenv("COLUMNS", "160")
        printed: list[str] = []
        patch.setattr("sys.stdout", _Kept(printed))
        assert main([str(folder)]) == 0
    return folder, "".join(printed)


class _Kept:
    """A text file that is no terminal."""

    def __init__(self, parts: list[str]) -> None:
        self.write, self.encoding = parts.append, "utf-8"

    def flush(self) -> None: ...

    def isatty(self) -> bool:
        return False


def test_the_last_lines_are_a_report_of_each_robot(done):
    folder, printed = done
    names = ("turtlebot3_avoid", "ur5_reach", *(("ur5_see",) if CAN_RENDER else ()))
    last = [Path(line) for line in printed.rstrip().splitlines()[-len(names) :]]
    assert last == [folder / name / "eval" / "report.html" for name in names]
    assert all(path.read_text(encoding="utf-8").rstrip().endswith("</html>") for path in last)


def test_every_path_that_is_named_exists(done):
    folder, printed = done
    named = [Path(line.strip()) for line in printed.splitlines() if line.strip().startswith(str(folder))]
    assert len(named) > 8
    assert all(path.exists() for path in named)
    assert {one.relative_to(folder).parts[0] for one in named} >= {
        "turtlebot3_avoid",
        "ur5_reach",
        "ur5_pick",
        demo.LOG,
    }
    for path in named:
        if path.suffix == ".png":
            assert min(Image.open(path).size) > 200


def test_datasets_load_with_lerobot_and_checkpoints_name_what_they_were_trained_on(done):
    folder, printed = done
    for one in (AVOID, REACH, PICK):
        root = folder / one.name / "dataset"
        dataset = LeRobotDataset(f"bhd/demo_{one.name}", root=root, video_backend="pyav")
        assert dataset.num_episodes == one.episodes == len(dataset_info(root).episodes)
        assert f"{one.episodes} episodes, {dataset.num_frames:,} frames" in printed
    for one in (AVOID, REACH):
        contract = PolicyContract.load(folder / one.name / "train/checkpoints/last/pretrained_model")
        assert contract.robot_type == one.name.partition("_")[0]
    assert (folder / "ur5_reach/train/checkpoints/000002/pretrained_model").is_dir()


def test_what_is_printed_of_an_evaluation_is_what_was_measured(done):
    folder, printed = done
    wanted = {"turtlebot3_avoid": ["rule", "learned", "random"], "ur5_reach": ["rule", "learned", "early"]}
    for name, brains in wanted.items():
        results = json.loads((folder / name / "eval/results.json").read_text())
        assert list(results["brains"]) == brains
        report = (folder / name / "eval/report.html").read_text(encoding="utf-8")
        assert all(brain in report for brain in brains)
        for brain in brains:
            found = results["brains"][brain]
            assert f"{brain} succeeded in {found['successes']} of {found['episodes']} episodes" in printed


def test_the_last_step_is_a_network_that_sees(done):
    folder, printed = done
    if not CAN_RENDER:
        assert "left out: images cannot be rendered here" in printed
        return
    results = json.loads((folder / "ur5_see/eval/results.json").read_text())
    assert list(results["brains"]) == ["rule", "seeing"]
    assert results["brains"]["seeing"]["perception"]["episodes"] == 1
    assert "seeing chose an object in" in printed


def test_replays_are_the_recorded_ones(done):
    assert done[1].count("same bits") == 4  # two robots, two modes


def test_a_folder_in_use_or_a_file_in_its_place_is_refused_and_nothing_changes(small, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("precious")
    for place, message in ((tmp_path, "mine.txt"), (tmp_path / "mine.txt", "cannot be used")):
        assert main([str(place)]) == 2
        printed = capsys.readouterr().err
        assert message in printed
        assert str(place) in printed
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    assert (tmp_path / "mine.txt").read_text() == "precious"


def test_unknown_options_end_with_status_2(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--steps=3"])
    assert ended.value.code == 2
    assert "--steps" in capsys.readouterr().err


def test_a_signal_in_a_step_ends_the_demo_with_its_status(small, tmp_path, monkeypatch, capsys):
    stop = StopRequest()
    stop.signal = signal.SIGTERM
    result = demo.record.RecordResult(tmp_path / "d", tmp_path / "o", stopped_by=stop)
    calls = []
    monkeypatch.setattr(demo.record, "record", lambda config, console: calls.append(config) or result)
    assert main([str(tmp_path / "run")]) == 128 + signal.SIGTERM
    assert len(calls) == 1
    assert "Stopped" in capsys.readouterr().err


def test_a_failure_in_a_step_gives_its_message_and_status_2(small, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "LESSONS", (replace(PICK, options=("--task.max_objects=0",)),))
    assert main([str(tmp_path / "run")]) == 2
    assert "max_objects" in capsys.readouterr().err


@each_case("one", [demo.AVOID, demo.REACH])
def test_whole_size_command_lines_are_valid(one, tmp_path):
    recorded = parse(RecordConfig, one.record_options(tmp_path))
    assert recorded.dataset.num_episodes == one.episodes
    trained = parse_train(one.train_options(tmp_path)).config
    assert trained.steps == one.steps
    assert trained.dataset.root == recorded.dataset.root
    assert not one.early_steps or one.steps % one.early_steps == 0
    assert (Path(demo.__file__).parents[2] / one.recipe).is_file()
    rule = replace(one, early_steps=0)
    options = [text for text in rule.eval_options(tmp_path, tmp_path / "none", None) if "learned" not in text]
    assert parse(EvalConfig, options).split != recorded.split
