"""The demo runs without further input, names files that exist, and takes nothing away from a folder that it finds."""

import io
import json
import re
import signal
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from bhd_lerobot.apps import demo
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.cli.demo import main
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import RenderingError, counted
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout.signals import StopRequest
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.world import World
from bhd_lerobot.training.arguments import parse_train

NUMBERS = {"steps": 4, "log_freq": 1, "eval_steps": 1, "n_envs": 2, "n_episodes": 2, "dataset.num_episodes": 2}
NUMBERS |= {"task.duration_s": 2}
OWN = {
    "ur5_pick": {"dataset.num_episodes": 1, "n_envs": 1},
    "ur5_reach": {"task.duration_s": 6, "save_freq": 2},
    "ur5_see": {"dataset.num_episodes": 12, "n_envs": 1, "n_episodes": 1, "steps": 2, "batch_size": 4}
    | {"task.duration_s": 0.04, "robot.camera_width": 96, "robot.camera_height": 72},
}


def read_small() -> tuple[dict[str, list[demo.Command]], dict[str, str]]:
    """The commands of the demo, with fewer and shorter episodes and trainings, and without videos, which are slow."""
    steps, words = WHOLE
    numbers = re.compile(r"--([\w.]+)=(\d[\d.]*)(?= |$)")

    def shrink(command: demo.Command) -> demo.Command:
        small = {**NUMBERS, **OWN.get(command.name, {})}
        line = command.line
        for word in ("roaming", "reaching", "seeing"):
            line = line.replace(f"{{{word}}}", words[word])
        line = numbers.sub(lambda one: f"--{one[1]}={small.get(one[1], one[2])}", line).replace("000300", "000002")
        if line.startswith("bhd-record"):
            line = line.replace("--preview_video=false ", "") + " --preview_video=false"
        if line.startswith(("bhd-record", "bhd-eval")):
            line += " --threads=1" + (" --robot.beams=36" if command.name == "turtlebot3_avoid" else "")
        if "bhd_perception" in line:
            line += " --policy.channels=4 --policy.hidden=4 --policy.context=4"
        return replace(command, line=line)

    without = {**words, "beside": words["beside"].replace("{videos}", "--videos=0")}
    return {heading: [shrink(one) for one in step] for heading, step in steps.items()}, without


WHOLE = demo.read_steps()


def _can_render() -> bool:
    try:
        Camera(World(turtlebot3_burger(), 1), 32, 24).close()
    except RenderingError:
        return False
    return True


CAN_RENDER = _can_render()


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(demo, "read_steps", read_small)
    monkeypatch.setenv("COLUMNS", "160")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Return the folder of a small demo, and what it printed."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "read_steps", read_small)
        patch.setattr(demo, "can_render", lambda _: CAN_RENDER)  # whether there is a video says it otherwise
        patch.setenv("COLUMNS", "160")
        with redirect_stdout(io.StringIO()) as printed:
            assert main([str(folder)]) == 0
    return folder, printed.getvalue()


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


def test_datasets_load_with_lerobot_and_checkpoints_name_what_they_were_trained_on(done):
    folder, printed = done
    for name, episodes in (("turtlebot3_avoid", 2), ("ur5_reach", 2), ("ur5_pick", 1)):
        root = folder / name / "dataset"
        dataset = LeRobotDataset(f"bhd/demo_{name}", root=root, video_backend="pyav")
        assert dataset.num_episodes == episodes == len(dataset_info(root).episodes)
        assert f"{counted(episodes, 'episode')}, {dataset.num_frames:,} frames" in printed
    for name in ("turtlebot3_avoid", "ur5_reach"):
        contract = PolicyContract.load(folder / name / "train/checkpoints/last/pretrained_model")
        assert contract.robot_type == name.partition("_")[0]
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
    broken = demo.Command(
        "ur5_pick", "bhd-record --robot.type=ur5 --task.type=pick --brain.type=pick --task.max_objects=0 {data}"
    )
    monkeypatch.setattr(demo, "read_steps", lambda: ({"1. Record": [broken]}, WHOLE[1]))
    assert main([str(tmp_path / "run")]) == 2
    assert "max_objects" in capsys.readouterr().err


def test_whole_size_command_lines_are_valid(tmp_path):
    steps, words = WHOLE
    splits = []
    for command in (one for step in steps.values() for one in step):
        options = demo.options_of(command, words, tmp_path, "--videos=1")
        if command.line.startswith("bhd-record"):
            splits.append(parse(RecordConfig, options).split)
        elif command.line.startswith("bhd-train"):
            config = parse_train(options).config
            assert not config.save_freq or config.steps % config.save_freq == 0
            assert config.dataset.root == str(tmp_path / "dataset")
        elif command.line.startswith("bhd-eval"):
            rules = [text for text in options if not re.search(r"learned|early|\.path=", text)]
            assert parse(EvalConfig, rules).split not in splits
        for note in command.notes:
            assert (Path(demo.__file__).parents[2] / re.search(r"configs/\S+yaml", note)[0]).is_file()
