"""A mark changes every column that it belongs to, and nothing else."""

import json
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.datasets.edit.edits import edits_of
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.loader.selection import frame_weights
from bhd_lerobot.datasets.loader.table import open_metadata
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.tasks.task import OUTCOMES, Event, outcomes_of
from tests.cases import each_case
from tests.datasets import support
from tests.datasets.edit_support import assert_valid, content, stack

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (1,), "names": ["a.pos"]},
    "event": {"dtype": "int64", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
}
LENGTH = 8


def recorded(root: Path, interventions: str | None = None) -> Path:
    """Three episodes that end in a time-out; in the second one, frames 2 and 3 were driven by an expert."""
    recorder = DatasetRecorder.create("t/t", 10, FEATURES, robot_type="toy", root=root)
    for episode in range(3):
        events = np.zeros(LENGTH, np.int64)
        events[-1] = Event.TIMEOUT
        if episode == 1:
            events[2:4] = Event.INTERVENTION
        writer = recorder.begin_episode()
        state = np.arange(LENGTH, dtype=np.float32) + episode
        writer.set_columns({"observation.state": state, "event": events, "next.success": np.zeros(LENGTH, np.bool_)})
        extra = {}
        if interventions is not None:
            spans = interventions if episode == 1 else "[]"
            extra = {"interventions": spans, "intervened_frames": 2 if episode == 1 else 0}
        metadata = {"outcome": "timeout", "success": False, "score": 0.5, **extra}
        recorder.save(writer, task="t", metadata=metadata)
    recorder.finalize()
    return root


def test_an_outcome_is_written_to_every_column(tmp_path: Path) -> None:
    root = recorded(tmp_path / "d")
    before, former = content(root), "timeout"
    for outcome in OUTCOMES:
        mark(root, [1], outcome=outcome, note="ä 'quoted'\nline\u2028\x85")
        after = content(root)
        assert [after[0], after[2]] == [before[0], before[2]]
        metadata = dataset_info(root).episodes[1].metadata
        assert (metadata["outcome"], metadata["success"], metadata["score"]) == (outcome, outcome == "success", 0.5)
        assert after[1].columns["event"] == [*before[1].columns["event"][:-1], Event[outcome.upper()]]
        assert after[1].columns["next.success"] == [False] * (LENGTH - 1) + [outcome == "success"]
        assert after[1].columns["observation.state"] == before[1].columns["observation.state"]
        assert_valid(root)  # the statistics are those of the new content
        edit = edits_of(root)[-1]
        assert edit["episodes"] == [{"episode": 1, "outcome": [former, outcome]}]
        assert edit["note"] == "ä 'quoted'\nline\u2028\x85"
        former = outcome


@pytest.mark.law
def test_marks_can_be_undone(tmp_path: Path) -> None:
    root = recorded(tmp_path / "d")
    before = content(root)
    with pytest.raises(ConfigError, match="Give the episodes"):
        mark(root, [], outcome="success")
    mark(root, [0, 2], outcome="success")
    mark(root, [0], intervention=(1, 3))
    assert content(root) != before
    mark(root, [0, 2], outcome="timeout")
    mark(root, [0], clear_interventions=True)
    assert content(root) == before
    assert len(edits_of(root)) == 4


def test_an_intervention_marks_its_frames_and_leaves_the_end(tmp_path: Path) -> None:
    root = recorded(tmp_path / "d")
    for first, last in ((0, 0), (1, 5), (6, 7), (0, 7)):
        mark(root, [0], intervention=(first, last), clear_interventions=True)
        events = stack(root, "event")[:LENGTH]
        assert events[-1] == Event.TIMEOUT
        driven = np.flatnonzero(events == Event.INTERVENTION)
        assert driven.tolist() == [frame for frame in range(first, last + 1) if frame < LENGTH - 1]


def test_recorded_interventions_keep_their_reasons(tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", '[[2, 4, "no progress"]]')
    mark(root, [1], intervention=(6, 7))
    metadata = dataset_info(root).episodes[1].metadata
    assert metadata["interventions"] == '[[2, 4, "no progress"], [6, 8, "marked afterwards"]]'
    assert metadata["intervened_frames"] == 4
    assert stack(root, "event")[LENGTH : 2 * LENGTH].tolist() == [0, 0, 5, 5, 0, 0, 5, 4]
    weights = frame_weights(open_metadata(root), [1], learner=0.0)
    assert weights is not None
    assert weights.tolist() == [0, 0, 1, 1, 0, 0, 1, 1]
    mark(root, [1], clear_interventions=True)
    metadata = dataset_info(root).episodes[1].metadata
    assert (metadata["interventions"], metadata["intervened_frames"]) == ("[]", 0)


def test_a_dataset_of_another_program_gets_the_columns(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset.create(
        "t/t", fps=10, features={"action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}},
        root=tmp_path / "d", use_videos=False,
    )  # fmt: skip
    for episode in range(2):
        for frame in range(4):
            dataset.add_frame({"action": np.array([episode, frame], np.float32), "task": "t"})
        dataset.save_episode()
    dataset.finalize()
    mark(tmp_path / "d", [1], outcome="success")
    episodes = dataset_info(tmp_path / "d").episodes
    assert [episode.metadata for episode in episodes] == [{}, {"outcome": "success", "success": True}]
    assert stack(tmp_path / "d", "action").tolist() == [[e, f] for e in range(2) for f in range(4)]
    assert len(LeRobotDataset("t/t", root=tmp_path / "d")) == 8
    with pytest.raises(DatasetError, match="no column 'event'"):
        mark(tmp_path / "d", [0], intervention=(0, 1))


@each_case(
    ("robot", "task", "impossible", "possible"),
    [
        ("turtlebot3", "avoid", ("dropped", "wrong_object", "unreachable"), ("stuck", "collision", "failure")),
        ("turtlebot3", "navigate", ("dropped", "wrong_object"), ("unreachable", "stuck")),
        ("turtlebot3", None, ("dropped",), ("stuck", "unreachable")),
        ("ur5", "reach", ("stuck", "dropped"), ("unreachable", "collision")),
        ("ur5", "pick", ("stuck",), ("dropped", "wrong_object", "unreachable")),
        ("toy", None, (), ("stuck", "dropped")),
    ],
)
def test_an_impossible_outcome_of_a_task_or_robot_is_refused(tmp_path, robot, task, impossible, possible) -> None:
    recording = {"task": {"type": task}} if task else {}
    with DatasetRecorder.create(
        "t/t", 10, support.FEATURES, robot_type=robot, root=tmp_path / "d", recording=recording
    ) as recorder:
        support.record(recorder)
    before = (tmp_path / "d/meta/info.json").stat().st_mtime_ns
    for outcome in impossible:
        with pytest.raises(ConfigError, match=f"cannot have ended with '{outcome}'.*Valid: success, ") as error:
            mark(tmp_path / "d", [0], outcome=outcome)
        valid = str(error.value).partition("Valid: ")[2].rstrip(".").split(", ")
        assert set(valid) == set(outcomes_of(task, body_of(robot)))
        assert set(possible) <= set(valid)
    assert (tmp_path / "d/meta/info.json").stat().st_mtime_ns == before
    mark(tmp_path / "d", [0], outcome=possible[0])


def test_in_a_mixture_each_episode_is_judged_by_its_own_task(tmp_path) -> None:
    with DatasetRecorder.create(
        "t/t", 10, support.FEATURES, robot_type="ur5", root=tmp_path / "d", recording={}
    ) as recorder:
        for number, task in enumerate(("reach", "pick")):
            writer = support.fill(recorder.begin_episode(), number)
            recorder.save(writer, task="do it", metadata={"outcome": "success", "task": json.dumps({"type": task})})
    mark(tmp_path / "d", [1], outcome="dropped")
    with pytest.raises(ConfigError, match=r"Episode 0 of .* cannot have ended with 'dropped'"):
        mark(tmp_path / "d", [1, 0], outcome="dropped")
