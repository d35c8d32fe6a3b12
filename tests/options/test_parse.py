"""Configuration files and command lines: precedence, types, near misses, round trip."""

import dataclasses
import re
import typing

import pytest

from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.options.parse import parse, read_file
from bhd_lerobot.recording.config import DatasetConfig, RecordConfig
from bhd_lerobot.training.rl.config import RlConfig
from tests.cases import each_case

REQUIRED = ["--robot.type=turtlebot3", "--dataset.repo_id=a/b", "--brain.type=avoidance", "--task.type=avoid"]


@pytest.mark.law
def test_the_command_line_wins_over_the_file_and_the_file_over_the_defaults(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("robot: {type: turtlebot3, beams: 36}\nseed: 3\nn_envs: 4\ndataset: {repo_id: a/b, fps: 20}\n")
    config = parse(
        RecordConfig, [f"--config_path={path}", "--seed=7", "--brain.type=avoidance", "--task.type", "avoid"]
    )
    assert (config.seed, config.n_envs, config.robot.beams, config.dataset.fps) == (7, 4, 36, 20)
    assert config.robot.fps == 20  # the robot acts at the dataset's rate
    assert config.dataset.num_episodes == 50


def test_a_part_of_a_group_is_set_where_the_file_of_a_run_has_nothing_and_beside_the_whole(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("robot: {type: turtlebot3}\ntask: {type: avoid}\ndataset: {root: d}\nbrain: null\nteleop: null\n")
    part = "--brain.margin_m=0.1"
    for options in (["--brain.type=gap_follower", part], [part, "--brain={type: gap_follower, rim_speed: 0.1}"]):
        brain = parse(RecordConfig, [f"--config_path={path}", *options]).brain
        assert brain.margin_m == 0.1
    for options in (["--brain=gap_follower", part], [part, "--brain=gap_follower"]):
        with pytest.raises(ConfigError, match=r"--brain.margin_m sets a key of 'brain', which is 'gap_follower'"):
            parse(RecordConfig, [f"--config_path={path}", *options])


def test_what_looks_like_a_date_is_text():
    assert parse(RecordConfig, [*REQUIRED, "--output_dir=2026-11-30"]).output_dir == "2026-11-30"


def test_a_mapping_of_a_file_may_be_merged_into_others_which_override_it(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("a: &a {x: 1, y: 1}\nb: {c: &c {<<: *a, y: 2}}\nd: {<<: *c, x: 3}\n")
    assert read_file(path) == {"a": {"x": 1, "y": 1}, "b": {"c": {"x": 1, "y": 2}}, "d": {"x": 3, "y": 2}}


@pytest.mark.parametrize("text", ["1e-2", "0.01", "1.0e-2"])
def test_numbers_may_have_an_exponent(text):
    config = parse(RecordConfig, [*REQUIRED, f"--robot.lidar_noise_std={text}"])
    assert config.robot.lidar_noise_std == 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sed=1"], "Did you mean 'seed'"),
        (["--robot.beens=36"], "Did you mean 'robot.beams'"),
        (["--brain.safe_dist=0.4"], "Did you mean 'brain.safe_distance_m'"),
        (["--brain.tpye=random"], "Did you mean 'brain.type'"),
        (["--num_episodes=3"], "Did you mean 'dataset.num_episodes'"),
        (["--seed"], "has no value"),
        (["seed=1"], "written --key=value"),
        (["--seed=1", "--seed=2"], "given twice"),
        (["--seed=1.5"], "must be a whole number"),
        (["--seed=true"], "must be a whole number"),
        (["--resume=1"], "must be true or false"),
        (["--dataset.tags=x"], r"dataset.tags is 'x'; it must be a list of texts in brackets, such as \[a, b\]"),
        (["--timing=x"], r"has keys of its own, such as timing\.max_lateness_s"),
        (["--dataset=x"], r"--dataset.repo_id sets a key of 'dataset', which is 'x'"),
        (["--dataset.fps.x=1"], "fps"),
        (["--seed=[1"], "cannot be read"),
        (["--seed=0x_"], "cannot be read"),
        (["--gate={max_change: 1, max_change: 2}"], "'max_change' occurs twice"),
        (["--robot.id=7"], "robot.id is 7; it must be text or null.*: --robot.id='\"7\"'"),
        (["--config_path=missing.yaml"], "'missing.yaml' cannot be read: No such file"),
    ],
)
def test_mistakes_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        parse(RecordConfig, [*REQUIRED, *options])


@pytest.mark.parametrize("left_out", range(4))
def test_missing_required_options_are_named(left_out):
    options = [option for index, option in enumerate(REQUIRED) if index != left_out]
    with pytest.raises(ConfigError, match=REQUIRED[left_out][2:].split("=")[0].removesuffix(".type")):
        parse(RecordConfig, options)


def test_errors_of_this_package_are_messages_and_others_keep_their_traceback(capsys):
    def fail(config):
        raise BhdError("a sentence")

    def bug(config):
        raise RuntimeError("a bug")

    assert run(Program(RecordConfig, fail), REQUIRED) == 2
    assert capsys.readouterr().err == "error: a sentence\n"
    with pytest.raises(RuntimeError):
        run(Program(RecordConfig, bug), REQUIRED)


def test_help_is_that_of_what_the_command_line_chooses_whatever_else_is_wrong_with_it(capsys):
    def choose(line):
        kind = RlConfig if "algorithm" in {**line.options, **line.file} else RecordConfig
        return Program(kind, lambda _: pytest.fail("it ran"))

    for given, option in (
        (["--algorithm=ppo", "--help"], "--ppo.lr"),
        (["-h", "--robot.type=ur5", "x"], "--robot.id"),
        (["--config_path=missing.yaml", "--help"], "--dataset.num_episodes"),
    ):
        assert run(choose, given) == 0
        assert option in capsys.readouterr().out
    assert run(choose, ["x"]) == run(choose, ["--config_path=missing.yaml"]) == 2


@each_case(
    ("name", "content", "message"),
    [
        ("a.yaml", b"", "found nothing"),
        ("a.yaml", b"- x\n", "found list"),
        ("a.yaml", b"a: [1\nb: {", "is not a YAML file"),
        (
            "a.yaml",
            b"seed: 1\nrobot: {type: ur5}\nseed: 2\n",
            "'seed' occurs twice in the mapping that begins in line 1",
        ),
        ("a.yaml", b"robot:\n  type: ur5\n  type: turtlebot3\n", "'type' occurs twice.* line 2"),
        ("a.yaml", b"\xff\xfe\x00", "is not a YAML file"),
        ("a.yaml", b"\x00", "is not a YAML file"),
        ("a.json", b"{", "is not a JSON file"),
        ("a.json", b'{"robot": {"type": "ur5", "type": "ur3e"}}', "'type' occurs twice"),
    ],
)
def test_files_that_are_no_configuration(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=message) as caught:
        parse(RecordConfig, [f"--config_path={tmp_path / name}"])
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"Is a directory.*--config_path a YAML"):
        parse(RecordConfig, [f"--config_path={tmp_path}"])


@each_case(
    ("option", "message"),
    [
        ("--dataset.single_task=x", "option of LeRobot's command. Here: --task.type=free --task.instruction"),
        ("--play_sounds=false", "leave it out"),
        ("--policy.path=x", "--brain.type=learned --brain.path=CHECKPOINT"),
        ("--dataset.streaming_encoding=true", "leave it out"),
        ("--robot.type=UR5", "Did you mean 'ur5'"),
        ("--robot.type=SO101_Follower", "Did you mean 'so101_follower'"),
        ("--brain.type=Avoidence", "Did you mean 'avoidance'"),
        ("--robot.realtime.recorder_timeout_s=2", "robot.realtime.recorder_timeout_s was removed: there is no"),
        ("--robot.realtime.plant_process=true", "robot.realtime.plant_process was removed: a simulated world"),
    ],
)
def test_names_of_lerobots_commands_and_other_spellings_lead_to_ours(option, message):
    others = [one for one in REQUIRED if one.partition("=")[0] != option.partition("=")[0]]
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse(RecordConfig, [*others, option])


def test_every_option_of_lerobots_recorder_is_ours_or_has_an_answer():
    from lerobot.scripts.lerobot_record import RecordConfig as Stock

    for ours, stock in ((RecordConfig, Stock), (DatasetConfig, typing.get_type_hints(Stock)["dataset"])):
        names = {field.name for field in dataclasses.fields(ours)}
        assert {field.name for field in dataclasses.fields(stock)} <= names | ours.of_lerobot.keys()
        assert not names & ours.of_lerobot.keys()
