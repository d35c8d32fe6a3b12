"""bhd-replay: bit-exact on its own recordings, and a number where it is not."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.cli.replay import main
from bhd_lerobot.datasets.edit.edits import delete, merge
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.rollout.replay.simulated import Replay
from tests.cases import each_case
from tests.recording.support import run_record

ROBOT = ("--robot.type=turtlebot3", "--robot.clock=realtime")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("replay") / "d"
    run_record(root, n_envs=3, seed=4, dataset__num_episodes=3, dataset__episode_time_s=4, robot__odometry="true")
    return root


@pytest.mark.law
@pytest.mark.parametrize("episode", [0, 2])
def test_open_loop_repeats_the_recording_bit_for_bit(recorded, episode):
    result = Replay(recorded, episode).open_loop()
    assert result.identical
    assert result.not_compared == ()
    assert result.position_m.max() == 0
    travelled = np.hypot(*np.diff(result.recorded_xy, axis=0).T).sum()
    assert travelled > 0.3  # there was something to repeat


def test_every_recorded_state_gives_the_recorded_observation(recorded):
    result = Replay(recorded, 2).state_exact()
    assert result.identical
    assert result.not_compared == ("x.pos", "y.pos", "theta.pos")


def test_scans_between_frames_are_counted_in_state_mode(tmp_path):
    run_record(tmp_path / "d", dataset__fps=4, dataset__num_episodes=1, dataset__episode_time_s=5)
    assert Replay(tmp_path / "d", 0).state_exact().observation.max() == 0
    assert Replay(tmp_path / "d", 0).open_loop().identical


def test_a_changed_action_diverges_from_its_frame_on(recorded):
    replay = Replay(recorded, 1)
    replay.columns["action"] = replay.columns["action"].copy()
    replay.columns["action"][30] += 0.05
    result = replay.open_loop()
    assert not result.identical
    assert result.state[:31].max() == 0
    assert result.state[31] > 0
    assert result.position_m[-1] > 1e-3
    assert replay.state_exact().identical  # the states were not touched


def test_a_quaternion_and_its_negative_are_the_same_orientation(recorded):
    replay = Replay(recorded, 1)
    states = replay.columns["simulation.state"].copy()
    turned = states.copy()
    turned[:, 3:7] *= -1  # the same rotation
    replay.columns["simulation.state"] = turned
    assert replay.open_loop().angle_rad.max() == pytest.approx(0, abs=1e-12)


@pytest.mark.figures
def test_the_command_draws_and_reports(recorded, tmp_path, capsys):
    status = main([f"--dataset.root={recorded}", f"--output_dir={tmp_path}", "--tolerance_m=0"])
    text = capsys.readouterr().err
    assert status == 0
    assert text.count("identical") == 2
    for mode in ("open_loop", "state"):
        assert (tmp_path / f"episode_000000_{mode}.png").stat().st_size > 5_000


def test_a_divergence_beyond_the_tolerance_is_the_exit_status(recorded, tmp_path, monkeypatch):
    original = Replay.open_loop

    def disturbed(self):
        self.columns["action"] = self.columns["action"] * np.float32(0.9)
        return original(self)

    monkeypatch.setattr(Replay, "open_loop", disturbed)
    arguments = [f"--dataset.root={recorded}", f"--output_dir={tmp_path}", "--mode=open_loop"]
    assert main([*arguments, "--tolerance_m=1e-6"]) == 1
    assert main([*arguments, "--tolerance_m=100"]) == 0


@each_case(
    ("options", "message"),
    [
        (["--dataset.root={}", "--mode=openloop"], "Did you mean 'open_loop'"),
        (["--dataset.root={}", *ROBOT, "--tolerance_m=1"], "tolerance_m and robot are both given"),
        (["--dataset.root={}", *ROBOT, "--mode=state"], "mode and output_dir are of a replay in simulation"),
        (["--dataset.root={}", *ROBOT, "--output_dir=x"], "mode and output_dir are of a replay in simulation"),
        (["--dataset.root={}", "--gate.max_change=5"], "gate is set, and no robot"),
        (["--dataset.root={}", *ROBOT, "--gate.max_change=5"], "gate is of robots of other packages"),
        (["--dataset.root={}", "--dataset.episode=9"], "from 0 to 2"),
        ([], "No dataset is given; set --dataset.root=FOLDER"),
    ],
)
def test_what_cannot_be_replayed_is_named(recorded, capsys, options, message):
    assert main([option.format(recorded) for option in options]) == 2
    assert message in capsys.readouterr().err


def test_options_in_which_merged_recordings_differ_are_named(tmp_path, capsys):
    """Of these no episode says any more what it had; also after further merges and edits."""
    for name, seed, more in (("a", 1, {}), ("b", 2, {"robot__physics_hz": 400}), ("c", 3, {"robot__physics_hz": 400})):
        run_record(tmp_path / name, seed=seed, dataset__num_episodes=1, dataset__episode_time_s=1, **more)
    merge([tmp_path / "b", tmp_path / "c"], tmp_path / "same")
    merge([tmp_path / "same", tmp_path / "a"], tmp_path / "both")
    merge([tmp_path / "both", tmp_path / "a"], tmp_path / "all")
    delete(tmp_path / "all", [0])
    for name, is_named in (("same", False), ("both", True), ("all", True)):
        main([f"--dataset.root={tmp_path / name}", f"--output_dir={tmp_path}", "--mode=open_loop"])
        text = " ".join(capsys.readouterr().err.split())
        assert ("Merged of recordings with different robot.physics_hz" in text) == is_named, name
        assert is_named or "identical" in text


def test_a_dataset_of_another_program_is_refused_with_a_remedy(recorded, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {"action": {"dtype": "float32", "shape": (2,), "names": ["x.vel", "theta.vel"]}}
    dataset = LeRobotDataset.create("test/other", 10, features, root=tmp_path / "other", use_videos=False)
    for _ in range(3):
        dataset.add_frame({"action": np.zeros(2, np.float32), "task": "none"})
    dataset.save_episode()
    dataset.finalize()
    with pytest.raises(DatasetError, match=r"--robot.type"):
        Replay(tmp_path / "other", 0)


def test_an_episode_of_setpoints_and_goals_as_version_0_3_recorded_it_is_repeated(tmp_path, monkeypatch):
    root, held, give_goals = tmp_path / "d", [], ReachBrain.act

    def hold_first(self, observation):
        held.append(observation.state[:, :7])
        return held[0] if len(held) <= 10 else give_goals(self, observation)

    monkeypatch.setattr(ReachBrain, "act", hold_first)
    arm = {"robot__type": "ur5", "robot__beams": None, "task__type": "reach", "brain__type": "reach"}
    run_record(root, **arm, dataset__num_episodes=1)
    frames = len(Replay(root, 0).columns["action"])
    assert not Replay(root, 0).open_loop().identical
    (file,) = (root / "meta/episodes").rglob("*.parquet")
    pq.write_table(pq.read_table(file).append_column("bhd/goal_frames", [[json.dumps([[10, frames]])]]), file)
    assert Replay(root, 0).metadata["goal_frames"] == f"[[10, {frames}]]"
    assert Replay(root, 0).open_loop().identical


@pytest.mark.parametrize("seconds", [2.0, 20.0])
def test_an_episode_of_setpoints_and_goals_is_repeated(tmp_path, seconds):
    """Also one that is over before the first goal; it has the metadata of the others."""
    fetch = {"robot__type": "turtlebot3_manipulation", "task__type": "fetch", "brain__type": "fetch"}
    run_record(tmp_path / "d", **fetch, robot__beams=120, dataset__episode_time_s=seconds, dataset__num_episodes=1)
    replay = Replay(tmp_path / "d", 0)
    followed = sum(end - first for first, end in json.loads(replay.metadata["goal_frames"]))
    assert (followed > 0) == (seconds > 2)
    assert followed < len(replay.columns["action"])
    assert replay.open_loop().identical
    assert replay.state_exact().identical


def test_other_versions_are_named(recorded):
    replay = Replay(recorded, 0)
    assert replay.changed_versions() == {}
    replay.metadata["versions"] = replay.metadata["versions"].replace('"mujoco":"', '"mujoco":"0.')
    assert list(replay.changed_versions()) == ["mujoco"]
