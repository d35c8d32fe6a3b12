"""Export and import again: the same episodes, whichever robot it is; and what of it other options leave."""

import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.format.columns import read_episode, video_frames
from bhd_lerobot.datasets.format.summary import EpisodeSummary, dataset_info
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.ros2.bag.storage.write import BagWriter, Stream
from bhd_lerobot.tasks.task import Event
from tests.cases import each_case
from tests.datasets import foreign
from tests.recording.support import run_record

SCAN = tuple(f"scan_{beam:03d}.pos" for beam in range(36))
ONE_BAG = ("--one_bag", "--format=sqlite3", "--twist", "--compressed_images", "--start_time=1000.3")
NOT_IMPORTED = {"control.effort", "simulation.state", "subtask", "observation.environment_state", "control.reading_age"}
OUTCOMES = ("success", "nothing", "timeout")


def by_hand(root: Path, robot: str, observed: tuple[str, ...], actions: tuple[str, ...], **options: Any) -> Path:
    """A recording of the wall clock: frames at 30 Hz that jitter, some left out; readings of 5 Hz that are old."""
    rng, fps, is_judged = np.random.default_rng(5), options.pop("fps", 30), options.pop("is_judged", True)
    camera, word = options.pop("camera", "front"), options.pop("word", "")
    features = keys.dataset_features(observed, actions, {camera: (32, 48, 3)} if robot == "ros2" else {}, {})
    with DatasetRecorder.create("t/t", fps, features, robot_type=robot, root=root) as recorder:
        for number, outcome in enumerate(OUTCOMES):
            n = 1 if number == 1 else 40
            time = np.arange(n) / fps + rng.uniform(0, 0.02, n)
            time[n // 2 + 1 :] += 1.4  # without a frame, as of a computer that was busy
            time[8:10] = time[7:8]  # the same record again, as of a control loop that was held up
            state, action = (rng.uniform(0.2, 3.5, (n, len(names))).astype(np.float32) for names in (observed, actions))
            state[:, 2:] = state[np.arange(n) // 6 * 6, 2:]
            writer = recorder.begin_episode()
            columns: dict[str, Any] = {
                key: rng.uniform(0, 0.1, n).astype(dtype) if "float" in dtype else rng.integers(0, 2, n).astype(dtype)
                for key, (dtype, _) in keys.SCALARS.items()
            }
            event = int(Event[outcome.upper()])
            columns |= {keys.OBSERVATION_STATE: state, keys.ACTION: action, keys.APPLIED_ACTION: action / 2}
            columns |= {keys.TIME: time, keys.DONE: np.arange(n) == n - 1, keys.EVENT: (np.arange(n) == n - 1) * event}
            writer.set_columns(columns)
            for frame in range(n if robot == "ros2" else 0):
                writer.add_image(f"observation.images.{camera}", np.full((32, 48, 3), 40 + 4 * frame, np.uint8))
            ended = {"outcome": word or outcome, "success": outcome == "success"} if is_judged else {}
            recorder.save(writer, task=f"Bring cup {number}.", metadata=ended)
    return root


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A dataset of each robot: simulated ones, the manual's example of any robot over ROS 2, and an unknown one."""
    folder = tmp_path_factory.mktemp("recorded")
    base = {"robot__odometry": "true", "robot__imu": "true", "robot__beams": 360}
    arm = {"robot__type": "ur5", "brain__type": "reach", "task__type": "reach", "robot__beams": None}
    for name, options in {"turtlebot3": base, "ur5": arm}.items():
        run_record(folder / name, seed=4, dataset__num_episodes=2, n_envs=2, **options)
        assert main.main(["mark", str(folder / name), "--episodes=1", "--outcome=timeout"]) == 0
    twist = ("x.vel", "theta.vel")
    by_hand(folder / "ros2", "ros2", (*twist, *SCAN, "lift.pos"), (*twist, "lift.pos"))
    by_hand(folder / "toy", "toy", ("pan.pos", "lift.pos"), ("pan.pos", "lift.pos"))
    by_hand(folder / "slow_toy", "toy", ("pan.pos", "lift.pos"), ("pan.pos", "lift.pos"), fps=10)
    by_hand(folder / "tool", "other toy", ("pan.pos", "lift.pos"), ("pan.pos", "lift.pos"))
    return {path.name: path for path in folder.iterdir()}


def export(root: Path, output: Path, *arguments: str) -> Path:
    assert main.main(["export", str(root), f"--output={output}", *arguments]) == 0
    return output


def run(root: Path, *arguments: object) -> int:
    return main.main(["import", *map(str, arguments), "--repo_id=t/t", f"--root={root}"])


def described(episode: EpisodeSummary) -> tuple[Any, ...]:
    return episode.frames, episode.task, episode.metadata["outcome"], episode.metadata["success"]


@pytest.mark.law
@pytest.mark.parametrize("layout", [(), ONE_BAG])
@pytest.mark.parametrize("robot", ["turtlebot3", "ur5", "ros2", "toy"])
def test_an_exported_dataset_comes_back_equal(recorded, tmp_path, robot, layout):
    """To the bit: episodes, frames, columns, instructions and outcomes; without an option, of every layout."""
    root, back = recorded[robot], tmp_path / "back"
    assert run(back, export(root, tmp_path / "bags", *layout)) == 0
    old, new = dataset_info(root), dataset_info(back)
    assert (new.robot_type, new.fps) == (old.robot_type, old.fps)
    assert [described(one) for one in new.episodes] == [described(one) for one in old.episodes]
    assert new.features.items() <= old.features.items()
    assert old.features.keys() - new.features.keys() <= NOT_IMPORTED
    for episode in old.episodes:
        ours, theirs = read_episode(root, episode.index), read_episode(back, episode.index)
        for key in new.features.keys() & ours.keys():
            assert np.array_equal(ours[key], theirs[key]), key
    for video in (back / "videos").rglob("*.mp4"):
        grey = [image.mean() for image in video_frames(video, 0.0, 40)]
        assert grey == pytest.approx(40 + 4 * np.arange(40), abs=4)
    assert robot == "toy" or main.main(["check", str(back)]) == 0


@pytest.mark.law
@pytest.mark.parametrize("layout", [(), ONE_BAG])
@pytest.mark.parametrize("lost", [keys.OBSERVATION_STATE, keys.ACTION])
def test_a_dataset_of_another_program_comes_back_but_for_frames_without_numbers(tmp_path, layout, lost):
    """Of an unnamed robot at one frame a second, as a float, with nothing but observation and action."""

    def lose(episode: int, columns: foreign.Columns) -> None:
        columns[lost][: episode == 2] = np.nan

    finite = partial(statistics.column_stats, finite=False)
    root, back = foreign.write(tmp_path / "d", change=lose, stats_of=finite), tmp_path / "back"
    foreign.edit_json(root / "meta/info.json", lambda info: info.update(robot_type=None, fps=1.0))
    names = {"axes": ["joint[0].pos", "x=y]", "右 2"]}
    foreign.edit_json(root / "meta/info.json", lambda info: info["features"]["observation.state"].update(names=names))
    assert run(back, export(root, tmp_path / "bags", *layout)) == 0
    old, new = dataset_info(root), dataset_info(back)
    assert (new.robot_type, new.fps) == ("", 1)
    assert [one.task for one in new.episodes] == [one.task for one in old.episodes]
    for episode, first in enumerate((0, 0, 1)):
        ours, theirs = read_episode(root, episode), read_episode(back, episode)
        for key in (keys.OBSERVATION_STATE, keys.ACTION):
            assert np.array_equal(ours[key][first:], theirs[key]), key


def test_words_of_other_programs_for_cameras_and_outcomes_cost_nothing_else(tmp_path):
    names = ("x.vel", "lift.pos")
    root = by_hand(tmp_path / "d", "ros2", names, names, camera="cam-left", word="well done")
    assert run(tmp_path / "back", export(root, tmp_path / "bags", "--one_bag")) == 0
    found = dataset_info(tmp_path / "back")
    assert "observation.images.cam_left" in found.features  # as its topic is called
    assert [one.frames for one in found.episodes] == [one.frames for one in dataset_info(root).episodes]
    assert not any("outcome" in one.metadata for one in found.episodes)


NUMBERS = "topic: /bhd/observation_state, type: bhd_msgs/msg/Numbers, field: 'values[names=theta.vel]', scale: 10"
COMMANDS = "topic: /bhd/action, type: bhd_msgs/msg/Numbers, field: 'values[names=lift.pos]'"
MAP = [f"--map.observation.turn={{{NUMBERS}}}", f"--map.action.lift.pos={{{COMMANDS}}}"]


@pytest.mark.law
@each_case(
    ("robot", "layout", "arguments"),
    [
        ("turtlebot3", ONE_BAG, ["--odometry", "--imu=/imu"]),
        ("turtlebot3", (), ["--robot=turtlebot3", "--odometry", "--imu=/imu"]),
        ("ur5", (), ["--map=ur5"]),
        ("ros2", ONE_BAG, MAP),
        ("ros2", (), [*MAP, "--stamps=auto"]),  # resampled
    ],
)
def test_a_preset_or_a_mapping_reads_what_each_episode_states(recorded, tmp_path, robot, layout, arguments):
    root, back = recorded[robot], tmp_path / "back"
    assert run(back, export(root, tmp_path / "bags", *layout), *arguments) == 0
    old, new = dataset_info(root), dataset_info(back)
    assert {described(one)[1:] for one in new.episodes} == {described(one)[1:] for one in old.episodes}
    for episode in () if "--stamps=auto" in arguments else old.episodes:
        ours, theirs = read_episode(root, episode.index), read_episode(back, episode.index)
        if robot == "ros2":
            ours |= {
                keys.OBSERVATION_STATE: ours[keys.OBSERVATION_STATE][:, 1] * 10,
                keys.ACTION: ours[keys.ACTION][:, 2],
            }
        for key in (keys.OBSERVATION_STATE, keys.ACTION):
            np.testing.assert_allclose(theirs[key], ours[key], rtol=1e-6, atol=1e-6)
        for key in (keys.TIME, keys.AGE, keys.EVENT, keys.MODE):
            assert np.array_equal(ours[key], theirs[key]), key


@pytest.mark.parametrize("layout", [(), ONE_BAG])
def test_options_have_precedence_over_what_a_bag_states(recorded, tmp_path, layout):
    bags, back = export(recorded["toy"], tmp_path / "bags", *layout), tmp_path / "back"
    assert run(back, bags, "--fps=10", "--task=Wave.", "--outcome=collision", "--min_episode_s=0.5") == 0
    info = dataset_info(back)
    assert (info.fps, info.tasks, len(info.episodes)) == (10, ("Wave.",), 4)  # the 1.4 s end an episode
    assert {one.metadata["outcome"] for one in info.episodes} == {"collision"}
    assert np.array_equal(read_episode(back, 0)[keys.TIME], np.arange(info.episodes[0].frames) / 10)
    shutil.rmtree(back)
    assert run(back, bags, "--outcome=collision", "--min_episode_s=0.5") == 0
    assert [one.frames for one in dataset_info(back).episodes] == [40, 40]
    assert read_episode(back, 1)[keys.EVENT].tolist() == [0] * 39 + [Event.COLLISION]


@each_case(
    ("other", "message"),
    [
        ("slow_toy", "at 30 fps, and .* of 'toy' at 10 fps.*--fps sets one rate"),
        ("tool", "of 'toy' at 30 fps, and .* of 'other toy' at 30 fps"),
    ],
)
def test_bags_of_another_robot_or_rate_are_refused(recorded, tmp_path, capsys, other, message):
    bags = [export(recorded[name], tmp_path / name, f"--start_time={len(name)}000") for name in ("toy", other)]
    assert run(tmp_path / "back", *bags) == 2
    assert not (tmp_path / "back").exists()
    assert re.search(message, capsys.readouterr().err)
    numbers = [f"--map.{key}.lift.pos={{topic: /bhd/{topic}, type: bhd_msgs/msg/Numbers, field: 'values[1]'}}"
               for key, topic in (("observation", "observation_state"), ("action", "action"))]  # fmt: skip
    assert run(tmp_path / "back", *bags, "--fps=20", *numbers) == 0


def test_a_bag_without_a_state_of_floats_is_refused_with_the_way_to_read_it(tmp_path, capsys):
    root = foreign.write(tmp_path / "d")
    foreign.edit_json(
        root / "meta/info.json", lambda info: info["features"]["observation.state"].update(names=["a"] * 3)
    )
    bags = export(root, tmp_path / "bags")
    assert run(tmp_path / "back", bags) == 2
    assert "without a state or an action of floats, each with a name of its own" in capsys.readouterr().err
    fields = (("observation", "observation_state", 2), ("action", "action", 0))
    named = [f"--map.{key}.x={{topic: /bhd/{topic}, type: bhd_msgs/msg/Numbers, field: 'values[{place}]'}}"
             for key, topic, place in fields]  # fmt: skip
    assert run(tmp_path / "back", bags, *named) == 0
    ours, theirs = (read_episode(one, 2) for one in (root, tmp_path / "back"))
    assert np.array_equal(ours[keys.OBSERVATION_STATE][:, 2], theirs[keys.OBSERVATION_STATE])


def test_bags_with_outcomes_and_without_need_one_for_all(recorded, tmp_path, capsys):
    names = ("pan.pos", "lift.pos")
    unjudged = by_hand(tmp_path / "unjudged", "toy", names, names, is_judged=False)
    bags = [export(recorded["toy"], tmp_path / "a"), export(unjudged, tmp_path / "b", "--start_time=1000")]
    for pair, stated in ((bags, "no outcomes"), (bags[::-1], "outcomes")):
        assert run(tmp_path / "back", *pair) == 2
        assert f" states {stated} of its episodes, unlike the bags before it" in capsys.readouterr().err
    assert run(tmp_path / "back", *bags, "--outcome=failure") == 0


def copied(bag: Path, path: Path, *, later_ns: int = 0, without: str = "") -> Path:
    """A bag that was recorded anew while it was played, or one of whose topics a message is missing."""
    (source,) = find_bags(bag)
    messages: dict[str, list[tuple[int, bytes]]] = {name: [] for name in source.topics}
    for topic, received, _, data in source.messages(messages):
        messages[topic].append((received + later_ns, data))
    if without:
        del messages[without][5]
    with BagWriter(path, "mcap", {}) as writer:
        writer.write([Stream(name, source.topics[name].msgtype, sent) for name, sent in messages.items()])
    return path


@each_case(
    ("changed", "arguments"),
    [
        ({"later_ns": 700 * 10**9 + 1}, []),
        ({"later_ns": 700 * 10**9 + 1}, ["--stamps=header"]),
        ({"without": "/bhd/cerebellum"}, []),
    ],
)
def test_a_bag_that_was_recorded_anew_is_resampled_and_keeps_instructions_and_outcomes(
    recorded: dict[str, Path], tmp_path: Path, changed: dict[str, Any], arguments: list[str]
) -> None:
    bag = copied(export(recorded["toy"], tmp_path / "bag", *ONE_BAG), tmp_path / "again", **changed)
    assert run(tmp_path / "back", bag, *arguments) == 0
    first, *_, last = dataset_info(tmp_path / "back").episodes
    assert [(one.task, one.metadata["outcome"]) for one in (first, last)] == [
        ("Bring cup 0.", "success"),
        ("Bring cup 2.", "timeout"),
    ]
    times = read_episode(tmp_path / "back", 0)[keys.TIME]
    assert np.allclose(times, np.arange(len(times)) / 30, atol=1e-9)
