"""bhd-record and bhd-replay with the UR5: goals, plans, instructions, and the same bytes for any number of arms."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.bodies.scenes import scene_from_json
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.rollout.replay.simulated import Replay
from tests.recording.support import data_columns, episode_rows, run_record

PICK = {
    "robot__type": "ur5",
    "brain__type": "language",
    "task__type": "pick",
    "task__randomisation__enabled": "true",
    "dataset__episode_time_s": 20,
    "robot__beams": None,
}

SPOKEN = {"dataset__num_episodes": 2, "seed": 6, "task__language": "any", "dataset__language": "true"}


def record(root, **overrides):
    return run_record(root, **{**PICK, **overrides})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("ur5") / "d"
    record(root, **SPOKEN, n_envs=2)
    return root


def test_same_seed_same_bytes_for_any_number_of_arms(recorded, tmp_path):
    root = tmp_path / "d"
    record(root, **SPOKEN, n_envs=1, threads=1)
    one, other = (pq.read_table(folder / "data") for folder in (recorded, root))
    assert one.column_names == other.column_names
    for name in one.column_names:
        assert one[name].combine_chunks().equals(other[name].combine_chunks()), name
    assert episode_rows(root) == episode_rows(recorded)


def test_every_episode_has_outcome_instruction_plan_goals_and_results(recorded):
    for episode in dataset_info(recorded).episodes:
        metadata = episode.metadata
        assert metadata["success"]
        scene = scene_from_json(metadata["scene"])
        assert episode.task == scene.instruction
        plan = json.loads(metadata["plan"])
        assert plan["instruction"] == episode.task
        assert plan["target"] == scene.target_object  # found by its name, not by the task's mark
        assert [skill for skill, _ in plan["steps"]][-1] == "hold"
        goals, results = json.loads(metadata["goals"]), json.loads(metadata["results"])
        sent = [goal["task_id"] for _, goal in goals]
        assert sorted(sent) == sorted(name for _, name, *_ in results)  # each ends exactly once
        assert len(set(sent)) == len(sent)
        assert all(success for _, _, success, *_ in results)
        assert scene.variation.sensor_noise > 0


def test_columns_tell_what_happened(recorded):
    columns = {name: np.array(values) for name, values in data_columns(recorded).items()}
    names = json.loads((recorded / "meta" / "info.json").read_text())["features"]
    environment = names["observation.environment_state"]["names"]
    for episode in dataset_info(recorded).episodes:
        rows = columns["episode_index"] == episode.index
        state = columns["observation.environment_state"][rows]
        target = int(np.argmax([state[0, environment.index(f"object_{k}_target")] for k in range(5)]))
        height = state[:, environment.index(f"object_{target}_z")]
        assert height[-1] - height[0] > 0.1
        assert np.allclose(columns["next.reward"][rows].sum(), 1.0, atol=1e-5)
        subtasks = columns["subtask"][rows].tolist()
        order = list(dict.fromkeys(subtasks))
        assert [text.split()[0] for text in order] == ["move", "close", "lift", "hold"]
        # The action is where the reference stands at the end of the frame: one frame later the arm is there.
        action, seen = columns["action"][rows], columns["observation.state"][rows]
        assert np.abs(action[:-1, :6] - seen[1:, :6]).max() < 0.06
        assert np.array_equal(action, columns["control.applied_action"][rows])


def test_replay_repeats_goals_and_states_bit_for_bit(recorded):
    replay = Replay(recorded, 1)
    assert replay.goals
    assert replay.open_loop().identical
    result = Replay(recorded, 1).state_exact()
    assert result.identical
    assert np.ptp(result.recorded_xy, axis=0).max() > 0.01  # there was something to repeat


def test_the_recorded_reference_replayed_as_setpoints_stays_close(recorded):
    replay = Replay(recorded, 1)
    replay.goals = None  # as on a robot that takes setpoints only
    result = replay.open_loop()
    assert not result.identical
    assert result.position_m.max() < 0.01


def test_reach_is_recorded_and_repeated(tmp_path):
    root = tmp_path / "d"
    result, _ = record(root, task__type="reach", brain__type="reach", dataset__num_episodes=2, n_envs=2)
    assert result.successes == 2
    assert Replay(root, 1).open_loop().identical


def test_tool_actions_are_recorded_as_tool_poses(tmp_path):
    root = tmp_path / "d"
    record(root, robot__action_space="tool", dataset__num_episodes=1)
    features = json.loads((root / "meta" / "info.json").read_text())["features"]
    assert features["action"]["names"][:4] == ["tool_x.pos", "tool_y.pos", "tool_z.pos", "tool_qw.pos"]
    action = np.array(data_columns(root)["action"])
    assert np.allclose(np.sqrt((action[:, 3:7] ** 2).sum(axis=1)), 1, atol=1e-6)
    assert np.abs(np.diff(action[:, 3:7], axis=0)).max() < 0.2  # no flips of the quaternion's sign
    replay = Replay(root, 0)
    assert replay.open_loop().identical
    replay.goals = None
    assert replay.open_loop().position_m.max() < 0.01


def test_an_instruction_without_a_matching_object_is_not_carried_out_and_says_why(tmp_path):
    root = tmp_path / "d"
    result, text = record(
        root, brain__instruction="pick up the elephant", dataset__num_episodes=1, dataset__episode_time_s=1
    )
    assert result.successes == 0
    assert "gave up" in text
    assert "elephant" in text
    (episode,) = dataset_info(root).episodes
    plan = json.loads(episode.metadata["plan"])
    assert "elephant" in plan["problem"]
    assert plan["steps"] == []
    assert data_columns(root)["subtask"][-1].startswith("cannot:")
    state = np.array(data_columns(root)["observation.state"])
    assert np.abs(state[:, 7:]).max() < 0.1  # nothing moved but by the noise
    assert json.loads(episode.metadata["goals"]) == []
    assert Replay(root, 0).open_loop().identical
