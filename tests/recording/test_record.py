"""bhd-record: same seed same bytes, resume after any kill, signals, bad input, what is in the run folder."""

import json
import os
import random
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.validate.findings import Severity
from bhd_lerobot.errors import BhdError, ConfigError, DatasetExistsError, DatasetMismatchError, RenderingError
from bhd_lerobot.hub.card import CardOptions, make_card
from bhd_lerobot.options.parse import encode, parse
from bhd_lerobot.recording import record as record_module
from bhd_lerobot.recording.config import RecordConfig
from tests.cases import each_case
from tests.datasets.support import snapshot
from tests.recording.support import data_columns, episode_rows, run_record, save_lidar_policy, saved, start

ARM = {"robot__type": "ur5", "brain__type": "language", "task__type": "pick", "robot__beams": None}


def test_same_seed_same_bytes_for_any_number_of_simulations(tmp_path):
    reference = None
    for n_envs, threads in ((1, 1), (7, 2)):
        root = tmp_path / f"n{n_envs}"
        # 9 episodes on 7 simulations: two of them start when others end, in the middle of the run.
        run_record(root, n_envs=n_envs, threads=threads, dataset__num_episodes=9, seed=5)
        table = pq.read_table(root / "data").drop_columns(["task_index"])
        content = {name: table[name].combine_chunks() for name in table.column_names}
        rows = episode_rows(root)
        if reference is None:
            reference = content, rows
        for name, column in content.items():
            assert column.equals(reference[0][name]), (n_envs, name)
        assert rows == reference[1]


def test_what_is_recorded_is_consistent(tmp_path):
    root = tmp_path / "d"
    result, _ = run_record(root, dataset__num_episodes=4, n_envs=2, robot__odometry="true", seed=3)
    columns = {name: np.array(values) for name, values in data_columns(root).items()}
    assert result.episodes == result.recorded == 4
    for episode in range(4):
        rows = columns["episode_index"] == episode
        length = rows.sum()
        assert np.allclose(columns["control.time"][rows], np.arange(length) / 10, atol=0, rtol=0)
        assert np.array_equal(np.unique(columns["control.age"][rows]), np.float32([0.0, 0.1]))
        assert columns["next.done"][rows].tolist() == [False] * (length - 1) + [True]
        assert columns["next.success"][rows][:-1].sum() == 0
        assert (columns["event"][rows][:-1] == 0).all()
        assert columns["event"][rows][-1] != 0
        row = dataset_info(root).episodes[episode]
        assert row.frames == length
        assert bool(columns["next.success"][rows][-1]) == row.metadata["success"]
        score = columns["next.reward"][rows].sum() + 1 / row.metadata["cells_free"]
        assert score == pytest.approx(row.metadata["score"], abs=1e-6)
        physics = columns["simulation.state"][rows]
        assert np.hypot(*np.diff(physics[:, :2], axis=0).T).sum() == pytest.approx(row.metadata["path_m"], abs=0.03)
        # The command applied follows the requested one, within what the acceleration allows in one frame.
        applied, requested = columns["control.applied_action"][rows], columns["action"][rows]
        assert (np.abs(np.diff(applied, axis=0)) <= np.array([0.25, 0.32]) + 1e-6).all()
        assert np.allclose(applied[requested[:, 0] > 0, 0][2:], 0.2, atol=1e-6)  # it takes two frames to speed up
        seeds = [int(e.metadata["seed"]) for e in dataset_info(root).episodes]
        assert len(set(seeds)) == 4
        assert all(seed % 2 == 0 for seed in seeds)  # training seeds are even


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three episodes: the dataset, and what was printed. Nothing may change it."""
    root = tmp_path_factory.mktemp("record") / "d"
    result, text = run_record(root)
    before = snapshot(root)
    yield root, result, text
    assert snapshot(root) == before


def test_stock_lerobot_reads_it(recorded):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = recorded[0]
    dataset = LeRobotDataset("test/avoid", root=root, video_backend="pyav", delta_timestamps={"action": [0.0, 0.1]})
    columns = data_columns(root)
    assert dataset.num_episodes == 3
    item = dataset[4]
    assert np.array_equal(item["observation.state"].numpy(), np.float32(columns["observation.state"][4]))
    assert np.array_equal(item["action"].numpy(), np.float32(columns["action"][4:6]))
    assert item["task"] == "Roam without touching anything."
    assert set(dataset.meta.stats) >= {"observation.state", "action"}


def test_another_seed_gives_other_episodes(recorded, tmp_path):
    run_record(tmp_path / "d", seed=2, dataset__num_episodes=1, dataset__episode_time_s=0.5)
    key = "observation.state"
    assert data_columns(tmp_path / "d")[key] != data_columns(recorded[0])[key][:5]


def test_an_existing_root_is_refused_and_left_alone(recorded):
    with pytest.raises(DatasetExistsError, match="exists already"):
        run_record(recorded[0])


@pytest.mark.law
def test_resume_adds_the_episodes_that_an_undisturbed_run_has(tmp_path):
    run_record(tmp_path / "whole", dataset__num_episodes=5, n_envs=2)
    run_record(tmp_path / "parts", dataset__num_episodes=2, n_envs=3)
    result, _ = run_record(tmp_path / "parts", dataset__num_episodes=5, n_envs=1, resume="true")
    assert (result.recorded, result.episodes) == (3, 5)
    assert data_columns(tmp_path / "parts") == data_columns(tmp_path / "whole")


def test_resume_of_a_complete_dataset_adds_nothing(recorded):
    result, _ = run_record(recorded[0], resume="true")
    assert result.recorded == 0


def test_resume_refuses_another_recording_and_shows_the_difference(recorded):
    for change, shown in (
        ({"seed": 9}, "seed"),
        ({"robot__beams": 18}, "observation.state"),
        ({"brain__safe_distance_m": 0.4}, "safe_distance_m"),
        ({"task__arena": "turtlebot3_world"}, "arena"),
        ({"dataset__fps": 20}, "fps"),
        ({"split": "held_out"}, "held_out"),
    ):
        with pytest.raises(DatasetMismatchError, match=shown):
            run_record(recorded[0], resume="true", dataset__num_episodes=5, **change)


@pytest.mark.parametrize(("number", "shown"), [(7, "number 7 of its recording"), (None, "of another program")])
def test_resume_refuses_episodes_that_are_not_those_of_their_numbers(recorded, tmp_path, number, shown):
    """As of `bhd-eval` with `episodes`, or of LeRobot that went on: the next would not be the missing ones."""
    root = Path(shutil.copytree(recorded[0], tmp_path / "d"))
    (path,) = (root / "meta/episodes").rglob("*.parquet")
    table = pq.read_table(path)
    place = table.schema.get_field_index("bhd/episode")
    numbers = pa.array([*table["bhd/episode"].to_pylist()[:-1], number], pa.int64())
    pq.write_table(table.set_column(place, table.schema.field(place), numbers), path)
    with pytest.raises(DatasetMismatchError, match=f"cannot be resumed: its episode 2 is {shown}"):
        run_record(root, resume="true", dataset__num_episodes=5)
    assert saved(root) == 3


def test_killed_and_resumed_is_the_same_as_undisturbed(tmp_path):
    many = {"dataset__num_episodes": 10, "dataset__episode_time_s": 2, "n_envs": 2, "seed": 1}
    run_record(tmp_path / "whole", **many)
    generator = random.Random(1)
    root = tmp_path / "killed"
    for wanted in (1, 6):
        process = start(root, wanted, resume="true", **many)
        time.sleep(generator.random() * 0.05)
        process.kill()
    result, _ = run_record(root, resume="true", **many)
    assert result.episodes == 10
    assert data_columns(root) == data_columns(tmp_path / "whole")
    assert dataset_info(root).compact


def test_a_signal_ends_the_run_with_a_finalised_dataset(tmp_path, monkeypatch):
    process = start(tmp_path / "program", 2, dataset__num_episodes=100_000, n_envs=2)
    process.send_signal(signal.SIGTERM)
    ended = {"program": (process.wait(), (tmp_path / "program.log").read_text(), signal.SIGTERM)}
    for number in (signal.SIGINT, signal.SIGHUP):  # in this process
        save = record_module.DatasetRecorder.save

        def saving(self, *args, save=save, number=number, **kwargs):
            if self.num_episodes == 1:
                os.kill(os.getpid(), number)
            return save(self, *args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(record_module.DatasetRecorder, "save", saving)
            result, text = run_record(tmp_path / number.name, dataset__num_episodes=100, n_envs=2)
        ended[number.name] = (result.exit_status, text, number)
    for name, (status, text, number) in ended.items():
        assert status == 128 + number, text
        assert number.name in text
        assert "--resume=true" in text
        summary = dataset_info(tmp_path / name)
        assert summary.compact
        assert len(summary.episodes) >= 2
        assert len(data_columns(tmp_path / name)["index"]) == summary.frames


def test_a_failing_save_leaves_the_earlier_episodes_and_names_the_cause(tmp_path, monkeypatch):
    calls = []
    save = record_module.DatasetRecorder.save

    def failing(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 3:
            raise BhdError("the disk is full")
        return save(self, *args, **kwargs)

    monkeypatch.setattr(record_module.DatasetRecorder, "save", failing)
    with pytest.raises(BhdError, match="disk is full"):
        run_record(tmp_path / "d", dataset__num_episodes=5)
    assert len(dataset_info(tmp_path / "d").episodes) == 2
    assert dataset_info(tmp_path / "d").compact


def test_a_run_without_an_episode_leaves_a_link_to_an_empty_folder_as_it_was(tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise BhdError("It is broken.")

    (tmp_path / "disk").mkdir()
    (tmp_path / "d").symlink_to("disk")
    with monkeypatch.context() as patch:
        patch.setattr(record_module, "save_episode", fail)
        with pytest.raises(BhdError, match="It is broken"):
            run_record(tmp_path / "d")
    assert list((tmp_path / "disk").iterdir()) == []
    result, _ = run_record(tmp_path / "d", dataset__num_episodes=1, dataset__episode_time_s=0.5)
    assert result.episodes == 1


def test_the_run_folder_has_the_resolved_configuration_and_an_image(recorded):
    root, result, text = recorded
    folder = root.parent / "d_run"
    saved = folder / "config.yaml"
    again = parse(RecordConfig, [f"--config_path={saved}"])
    assert encode(again) == yaml.safe_load(saved.read_text())
    assert (folder / "trajectories.png").is_file()
    for part in (f"{result.successes} of 3", "mean score", "real time", "trajectories.png"):
        assert part in text


def test_the_video_is_made_where_images_can_be_rendered(tmp_path):
    import av

    try:
        run_record(tmp_path / "d", preview_video="true")
    except RenderingError as error:
        pytest.skip(f"no OpenGL here: {error}")
    with av.open(str(tmp_path / "d_run" / "episode.mp4")) as video:
        frames = list(video.decode(video=0))
    assert len(frames) >= 10
    assert frames[0].to_ndarray(format="rgb24").std() > 5


def test_without_opengl_the_recording_continues_and_reports_it(tmp_path, monkeypatch):
    def no_gl(*args):
        raise RenderingError("No image can be rendered here. Install EGL.")

    monkeypatch.setattr(record_module, "Preview", no_gl)
    result, text = run_record(tmp_path / "d", preview_video="null")
    assert result.recorded == 3
    assert "No video of an episode: No image can be rendered here" in text
    with pytest.raises(RenderingError):
        run_record(tmp_path / "e", preview_video="true")
    assert not (tmp_path / "e").exists()


def test_a_camera_is_recorded_frame_by_frame(base):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("test/avoid", root=base, video_backend="pyav")
    assert dataset.meta.features["observation.images.front"]["shape"] == (48, 64, 3)
    assert len(list(base.rglob("*.mp4"))) == 1
    images = [dataset[i]["observation.images.front"] for i in (0, 19, 20, len(dataset) - 1)]
    assert all(image.shape == (3, 48, 64) for image in images)
    assert len({image.numpy().tobytes() for image in images}) == 4


@pytest.mark.law
@each_case(
    ("change", "message"),
    [
        ({"estop_signal": "SIGINT"}, "'SIGINT'. Valid: SIGUSR1"),
        ({"estop_key": "true"}, "standard input is not a terminal"),
        ({"robot__fps": 20, "dataset__fps": 10}, "leave robot.fps out"),
        ({"dataset__fps": 7}, "valid values of fps"),
        ({"task__duration_s": 12}, "task.duration_s is 12.* and dataset.episode_time_s is 3"),
        (
            {**ARM, "task__type": "avoid", "brain__type": "avoidance"},
            "needs a drive; robot.type is 'ur5', which has none. Valid: turtlebot3",
        ),
        (
            {**ARM, "brain__type": "gap_follower"},
            "Brains for it: blanked, dagger, language, learned, noop, pick, pick_servo, random, reach, reach_servo",
        ),
        ({**ARM, "brain__type": "reach"}, "target_x"),
        (
            {**ARM, "robot__type": "turtlebot3_manipulation", "task__type": "reach", "brain__type": "reach"},
            "without a drive; .* Valid: arm, so101, ur10e, .* Tasks of turtlebot3_manipulation: avoid, fetch",
        ),
        ({**ARM, "task__max_objects": 6}, "max_objects is 6"),
        ({**ARM, "robot__action_space": "joints"}, "Did you mean 'joint'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        run_record(tmp_path / "d", **change)
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_that_is_older_than_an_option_of_its_task_is_resumed_while_that_is_as_it_was(tmp_path: Path) -> None:
    root = tmp_path / "d"
    arm = {"robot__type": "ur5", "robot__beams": None, "brain__type": "reach", "task__type": "reach"}
    run_record(root, **arm, dataset__num_episodes=1, dataset__episode_time_s=1)
    path = root / "meta" / "bhd.json"
    identity = json.loads(path.read_text())
    task = identity["recording"]["task"]
    del task["sensing"], task["randomisation"]["plain"]
    path.write_text(json.dumps(identity))
    for changed, named in (
        ({"task__sensing__dropout": 0.5}, "recording.task.sensing: not recorded"),
        (
            {"task__randomisation__enabled": "true", "task__randomisation__plain": 0.1},
            "recording.task.randomisation.plain: not recorded",
        ),
        ({"task__hold_s": 0.5}, "recording.task.hold_s: recorded 0.25, requested 0.5"),
    ):
        with pytest.raises(DatasetMismatchError, match=named):
            run_record(root, **arm, **changed, resume="true", dataset__num_episodes=2, dataset__episode_time_s=1)
    result, _ = run_record(root, **arm, resume="true", dataset__num_episodes=2, dataset__episode_time_s=1)
    assert (result.recorded, result.episodes) == (1, 2)
    assert json.loads(path.read_text()) == identity


def test_a_policy_is_recorded_as_what_it_is_and_not_where_it_lies(tmp_path, monkeypatch):
    """Neither dataset nor card names a folder of this machine, and a policy that was moved is still the same."""
    run = tmp_path / "alice" / "run"
    save_lidar_policy(run / "checkpoints" / "000004" / "pretrained_model")
    (run / "checkpoints" / "last").symlink_to("000004")
    (tmp_path / "link").symlink_to(run)
    monkeypatch.chdir(tmp_path)
    brain = {"brain__type": "dagger", "brain__learner__type": "learned", "brain__expert__type": "gap_follower"}
    brain |= {"dataset__episode_time_s": 0.5}
    root = tmp_path / "data"
    checkpoint = "checkpoints/last/pretrained_model"
    moved = tmp_path / "bob" / "run"
    for number, named in enumerate([run, "alice/run", f"../{tmp_path.name}/link", run / checkpoint, moved], start=1):
        if named == moved:
            run.parent.rename(moved.parent)
        run_record(root, **brain, brain__learner__path=named, dataset__num_episodes=number, resume=number > 1)
    identity = json.loads((root / "meta/bhd.json").read_text())
    learner = identity["recording"]["brain"]["learner"]
    assert learner["path"] == "run/checkpoints/000004"
    rows = dataset_info(root).episodes
    assert {row.metadata["brain"] for row in rows} == {rows[0].metadata["brain"]}
    assert json.loads(rows[0].metadata["brain"])["learner"] == learner
    card = make_card(load_state(root), CardOptions("me/data")).text
    for text in (card, json.dumps(identity), *(str(row.metadata) for row in rows)):
        assert str(tmp_path) not in text
        assert "alice" not in text
    # A dataset of an older version names the folder as the user did.
    learner["path"] = str(run)
    (root / "meta/bhd.json").write_text(json.dumps(identity))
    run_record(root, **brain, brain__learner__path=moved, dataset__num_episodes=6, resume="true")
    learner["weights"] = "sha256:0"
    (root / "meta/bhd.json").write_text(json.dumps(identity))
    with pytest.raises(DatasetMismatchError, match=r"brain\.learner\.weights"):
        run_record(root, **brain, brain__learner__path=moved, dataset__num_episodes=7, resume="true")


def test_what_attempts_nothing_has_no_outcomes(tmp_path: Path) -> None:
    """Single looks at tables: none is a failure, in the terminal, in the picture, or when the data are checked."""
    looks = ARM | {"brain__type": "noop", "dataset__episode_time_s": 0.04}
    result, printed = run_record(tmp_path / "d", **looks)
    assert result.recorded == 3
    assert result.succeeded == ""
    assert not any(word in printed for word in ("succe", "fail", "timeout", "score"))
    assert not [one for one in check_dataset(tmp_path / "d").findings if one.severity > Severity.NOTE]
