"""Aggregation in rounds: every program runs once, a stop loses nothing, and what cannot be is said before the first."""

import json
import os
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from bhd_lerobot.cli.train import algorithm_of, main
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse, read_line
from bhd_lerobot.policies.learned.checkpoint import find_checkpoint, weights_digest
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.training.dagger import train as dagger
from bhd_lerobot.training.dagger.config import parse_aggregation, read_stages
from tests.cases import each_case
from tests.recording.support import episode_rows, run_record

CONFIGS = Path("configs").absolute()
BRIEF = ["--robot.beams=36", "--task.duration_s=2"]


def stage(name: str, *options: str) -> dict[str, Any]:
    return {"config": str(CONFIGS / f"{name}.yaml"), "options": list(options)}


def settings(folder: Path, **changed: Any) -> Path:
    """Write a configuration of short rounds; return the file."""
    record = (*BRIEF, "--n_envs=2", "--preview_video=false")
    training = ("--steps=4", "--save_freq=2", "--batch_size=8", "--eval_steps=0", "--policy.hidden_dims=[8]")
    values: dict[str, Any] = {
        "algorithm": "dagger",
        "expert": stage("record/turtlebot3_avoid", *record, "--brain.type=gap_follower", "--brain.margin_m=0.08"),
        "learner": stage(
            "record/turtlebot3_avoid_dagger", *record, "--brain.expert.margin_m=0.08", "--brain.learner.exact=true"
        ),
        "policy": stage("train/bc_turtlebot3_avoid", *training, "--selection.learner_weight=0.5"),
        "evaluation": stage("eval/turtlebot3_avoid", *BRIEF, "--n_envs=2", "--ray={num_workers: null}"),
        "output_dir": str(folder / "run"),
        "rounds": 1,
        "expert_episodes": 2,
        "episodes": 2,
        "validation_episodes": 1,
        **changed,
    }
    file = folder / "dagger.yaml"
    file.write_text(yaml.safe_dump(values))
    return file


def results(folder: Path) -> Any:
    return json.loads((folder / "run" / "rounds.json").read_text())


def test_rounds_learn_from_all_that_was_recorded_and_go_on_where_they_stopped(tmp_path, monkeypatch, capsys):
    called: list[tuple[str, list[str]]] = []

    def watched(name: str, fails: bool = False) -> Any:
        program = PROGRAMS[name]

        def run(arguments: list[str]) -> int:
            called.append((name, arguments))
            return 130 if fails and len([one for one, _ in called if one == name]) == 2 else program(arguments)

        return run

    PROGRAMS = dict(dagger._PROGRAMS)
    argument = f"--config_path={settings(tmp_path)}"
    # The second training is stopped before it begins.
    monkeypatch.setattr(dagger, "_PROGRAMS", {name: watched(name, name == "bhd-train") for name in PROGRAMS})
    assert main([argument]) == 130
    assert [name for name, _ in called] == ["bhd-record", "bhd-train", "bhd-eval", "bhd-record", "bhd-train"]
    assert "the same command continues there" in " ".join(capsys.readouterr().err.split())
    assert [row["round"] for row in results(tmp_path)["rounds"]] == [0]
    # The time of what was stopped counts.
    spent = [json.loads((tmp_path / "run" / f"round_{one}" / "done.json").read_text())["seconds"] for one in (0, 1)]
    assert results(tmp_path)["rounds"][0]["seconds"] == spent[0]
    called.clear()
    assert main([argument]) == 0
    assert [name for name, _ in called] == ["bhd-train", "bhd-eval"]
    assert {"--selection.expert_action=true", "--selection.learner_weight=0.5"} <= set(called[0][1])

    run = tmp_path / "run"
    first, second = (dataset_info(run / f"round_{number}" / "data") for number in (0, 1))
    assert [len(one.episodes) for one in (first, second)] == [2, 2]
    assert not {one.metadata["seed"] for one in first.episodes} & {one.metadata["seed"] for one in second.episodes}
    learned = PolicyContract.load(run / "round_1" / "policy").dataset
    assert learned is not None
    assert (learned["episodes"], learned["frames"]) == (4, first.frames + second.frames)
    brain = json.loads(second.episodes[0].metadata["brain"])
    assert brain["learner"]["path"] == "policy/checkpoints/000004"

    found = results(tmp_path)
    assert found["expert"]["type"] == "gap_follower"
    assert [row["episodes"] for row in found["rounds"]] == [2, 4]
    assert [row["expert_share"] is None for row in found["rounds"]] == [True, False]
    assert found["rounds"][0]["seconds"] == spent[0]
    assert found["rounds"][1]["seconds"] > sum(spent) > spent[0] > 0
    for one in (found["expert"], *found["rounds"]):
        assert 0 <= one["success"]["low"] <= one["success"]["value"] <= one["success"]["high"] <= 1
    assert (run / "rounds.png").exists()
    printed = capsys.readouterr().err.splitlines()
    (said,) = (line for line in printed if line.startswith("  bhd-eval ") and "--brains.policy.path=" in line)
    said_brain = parse(EvalConfig, shlex.split(said)[1:]).brains["policy"]
    assert said_brain.path == str(run / "round_1" / "policy")

    # Nothing is left to do, nor where an option is not in the folder's file; another seed would be other rounds.
    called.clear()
    kept = run / "config.yaml"
    values = yaml.safe_load(kept.read_text())
    assert main([argument]) == 0
    assert results(tmp_path) == found
    assert values.pop("data") == []
    kept.write_text(yaml.safe_dump(values))
    assert main([argument]) == 0
    assert called == []
    assert main([argument, "--seed=1"]) == 2
    assert "were made with something else: seed was 0, and is 1." in " ".join(capsys.readouterr().err.split())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with two rounds that nothing disturbed, named from beside it, and its `dagger.yaml`."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([f"--config_path={settings(folder, output_dir='run')}"]) == 0
    return folder


@pytest.mark.thorough
def test_a_run_that_was_moved_or_is_named_by_another_path_ends_as_if_nothing_had_happened(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = dict(dagger._PROGRAMS)

    def record_one(arguments: list[str]) -> int:
        if "--dataset.num_episodes=2" in arguments and "round_1" in " ".join(arguments):
            programs["bhd-record"]([one.replace("num_episodes=2", "num_episodes=1") for one in arguments])
            return 130
        return programs["bhd-record"](arguments)

    def train_half(arguments: list[str]) -> int:
        assert programs["bhd-train"](arguments) == 0
        checkpoints = Path(next(one for one in arguments if one.startswith("--output_dir=")).partition("=")[2])
        shutil.rmtree(checkpoints / "checkpoints/000004")
        (checkpoints / "checkpoints/last").unlink()  # as a copy without links leaves it
        return 143

    monkeypatch.chdir(tmp_path)
    argument = f"--config_path={settings(tmp_path, output_dir='run')}"
    monkeypatch.setitem(dagger._PROGRAMS, "bhd-record", record_one)
    assert main([argument]) == 130
    monkeypatch.setitem(dagger._PROGRAMS, "bhd-record", programs["bhd-record"])
    monkeypatch.setitem(dagger._PROGRAMS, "bhd-train", train_half)
    (tmp_path / "link").symlink_to("run")
    assert main([argument, f"--output_dir={tmp_path / 'link'}"]) == 143
    monkeypatch.setitem(dagger._PROGRAMS, "bhd-train", programs["bhd-train"])
    moved = tmp_path / "elsewhere" / "again"
    shutil.copytree(tmp_path / "run", moved)
    shutil.rmtree(tmp_path / "run")
    monkeypatch.chdir(tmp_path / "elsewhere")
    near = [f"--expert.config={os.path.relpath(CONFIGS / 'record/turtlebot3_avoid.yaml')}"]
    assert main([argument, "--output_dir=again", *near]) == 0

    for number in (0, 1):
        policies = [run / f"round_{number}" / "policy" for run in (finished / "run", moved)]
        assert weights_digest(find_checkpoint(policies[0])) == weights_digest(find_checkpoint(policies[1]))
        rows = [episode_rows(run / f"round_{number}" / "data") for run in (finished / "run", moved)]
        assert rows[0] == rows[1]
    reports = [json.loads((run / "rounds.json").read_text()) for run in (finished / "run", moved)]
    for row in (*reports[0]["rounds"], *reports[1]["rounds"]):
        assert row.pop("seconds") > 0
    assert reports[0] == reports[1]


def test_what_was_reported_stays(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "copy")
    run = tmp_path / "copy" / "run"
    before = (run / "rounds.json").read_bytes()
    assert main([f"--config_path={run / 'config.yaml'}", "--rounds=0"]) == 0  # of the copy, where it lies now
    assert (run / "rounds.json").read_bytes() == before


def test_after_a_failure_the_same_command_is_said_to_repeat_the_step_and_not_to_go_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(dagger._PROGRAMS, "bhd-record", lambda _: 2)
    assert main([f"--config_path={settings(tmp_path)}"]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert "when the cause is resolved, the same command repeats this step" in printed
    assert "continues there" not in printed


def test_files_that_say_something_else_than_before_are_not_gone_on_with(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dagger, "_PROGRAMS", dict.fromkeys(dagger._PROGRAMS, lambda _: 130))
    argument = f"--config_path={settings(tmp_path)}"
    stages = yaml.safe_load((tmp_path / "dagger.yaml").read_text())
    policy = tmp_path / "policy.yaml"
    shutil.copy(stages["policy"]["config"], policy)
    stages["policy"]["config"] = str(policy)
    (tmp_path / "dagger.yaml").write_text(yaml.safe_dump(stages))
    assert main([argument]) == 130
    values = yaml.safe_load(policy.read_text())
    policy.write_text(yaml.safe_dump({**values, "log_freq": values["log_freq"]}))  # in another order, without comments
    assert main([argument]) == 130
    capsys.readouterr()
    policy.write_text(yaml.safe_dump({**values, "policy": {**values["policy"], "optimizer_lr": 0.5}}))
    before = values["policy"].get("optimizer_lr")
    assert main([argument]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert f"The rounds in {tmp_path / 'run'} were made with something else" in printed
    assert f"policy.config.policy.optimizer_lr was {before}, and is 0.5." in printed


def test_a_training_that_had_ended_before_it_was_noted_is_not_gone_on_with(finished, tmp_path, monkeypatch):
    run = shutil.copytree(finished / "run", tmp_path / "run", symlinks=True)
    (run / "round_0" / "done.json").write_text(json.dumps({"done": ["record"], "seconds": 1.0}))
    called: list[str] = []
    programs = {name: lambda given, name=name: called.append(name) or 130 for name in dagger._PROGRAMS}
    monkeypatch.setattr(dagger, "_PROGRAMS", programs)
    assert main([f"--config_path={run / 'config.yaml'}"]) == 130
    assert called == ["bhd-eval"]


def test_the_expert_is_judged_as_it_is_configured(finished: Path) -> None:
    judged = yaml.safe_load((finished / "run" / "round_0" / "evaluation" / "config.yaml").read_text())
    assert judged["brains"]["expert"]["margin_m"] == 0.08


def test_the_reason_for_a_stop_is_said_also_where_nothing_more_can_be_written(tmp_path, monkeypatch, capsys):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    def fails(_: list[str]) -> int:
        monkeypatch.setattr(dagger.Disk, "publish", full)
        raise BhdError("The folder is full.")

    monkeypatch.setattr(dagger, "_PROGRAMS", {**dagger._PROGRAMS, "bhd-record": fails})
    assert main([f"--config_path={settings(tmp_path)}"]) == 2
    assert "The folder is full." in capsys.readouterr().err


@pytest.mark.thorough
def test_every_round_learns_from_data_that_was_recorded_before_as_well(tmp_path, capsys):
    folders = [tmp_path / name for name in ("before", "after")]
    for folder in folders:
        folder.mkdir()
    assert main([f"--config_path={settings(folders[0], rounds=0)}"]) == 0
    before = folders[0] / "run" / "round_0" / "data"
    # What is in several of them, because one is a copy of another, is learned once.
    copied = shutil.copytree(before, folders[0] / "copied")
    assert main([f"--config_path={settings(folders[1], rounds=0, seed=5)}", f"--data=[{before}, {copied}]"]) == 0
    assert "leave out 2 episodes that are in these datasets more than once" in " ".join(capsys.readouterr().err.split())
    run = folders[1] / "run"
    frames = [dataset_info(root).frames for root in (before, run / "round_0" / "data")]
    learned = PolicyContract.load(run / "round_0" / "policy").dataset
    assert learned is not None
    assert (learned["episodes"], learned["frames"]) == (4, sum(frames))
    # Data of another frame rate is refused before anything is recorded.
    other = folders[1] / "other"
    given = settings(folders[1], rounds=0, output_dir=str(other))
    info = before / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"fps": 5}))
    assert main([f"--config_path={given}", f"--data=[{before}]"]) == 2
    assert not other.exists()
    assert "with 5 frames a second; the expert of" in " ".join(capsys.readouterr().err.split())


def without_advice(folder: Path) -> dict[str, Any]:
    """Write a learner's configuration that does not record what the expert would do; return it as a stage."""
    values = yaml.safe_load((CONFIGS / "record/ur5_pick_servo.yaml").read_text())
    values["dataset"]["expert_action"] = False
    file = folder / "without_advice.yaml"
    file.write_text(yaml.safe_dump(values))
    return {"config": str(file), "options": []}


def test_where_it_is_not_recorded_what_the_expert_would_do_only_what_it_did_is_learned(tmp_path, monkeypatch):
    called: list[list[str]] = []
    monkeypatch.setattr(dagger, "_PROGRAMS", dict.fromkeys(dagger._PROGRAMS, lambda given: called.append(given) or 1))
    stages = {
        "expert": stage("record/ur5_pick"),
        "learner": without_advice(tmp_path),
        "policy": stage("train/bc_ur5_pick_servo"),
        "evaluation": stage("eval/ur5_pick"),
    }
    config = parse_aggregation([f"--config_path={settings(tmp_path, **stages)}"])
    found = read_stages(config)
    assert (found.expert, found.has_advice) == ("pick", False)
    rounds = dagger._Rounds(config, found, tmp_path, dagger.Console(quiet=True))
    monkeypatch.setattr(rounds, "_data", lambda number, folder: folder)
    for number in (0, 1):
        with pytest.raises(dagger._StoppedError):
            rounds._train(number, tmp_path)
    # What is recorded in all rounds is merged.
    assert not Path(tmp_path / "data").exists()
    with pytest.raises(dagger._StoppedError):
        rounds._record(0, tmp_path)
    assert "--dataset.expert_action=false" in called.pop()
    # What was recorded before may hold a learner's mistakes as well.
    rounds._config.data = ["before"]
    with pytest.raises(dagger._StoppedError):
        rounds._train(0, tmp_path)
    assert ["--selection.learner_weight=0" in one for one in called] == [False, True, True]
    assert not any("expert_action" in option for one in called for option in one)


@each_case(
    ("changed", "message"),
    [
        ({"output_dir": ""}, "output_dir is empty"),
        ({"data": ["nowhere"]}, "nowhere"),
        ({"policy": {"config": "", "options": []}}, "policy.config is empty; name a configuration file"),
        ({"policy": {"config": "missing.yaml", "options": []}}, "missing.yaml"),
        ({"learner": stage("record/turtlebot3_avoid")}, "whose brain is 'avoidance'; it must be 'dagger'"),
        *(
            (
                {"evaluation": stage("eval/turtlebot3_avoid", f"--{name}=x")},
                f"The option --{name} of .* is set by the rounds themselves",
            )
            for name in ("split", "brains.policy.path", "brains.expert.margin_m")
        ),
        (
            {"expert": {"config": "held_out.yaml", "options": BRIEF}},
            "split is 'held_out' in 'held_out.yaml': its episodes are reserved for evaluation",
        ),
        ({"data": ["without"]}, r"data names without, which has no expert\.action"),
        (
            {"evaluation": stage("eval/ur5_pick")},
            "robot.type is 'ur5' in evaluation.config, .*ur5_pick.yaml', and 'turtlebot3' in that of the expert",
        ),
        (
            {"evaluation": stage("eval/turtlebot3_navigate")},
            "task.type is 'navigate' in evaluation.config, .* and 'avoid' in that of the expert",
        ),
        (
            {"learner": stage("record/ur5_pick_servo")},
            "robot.type is 'ur5' in learner.config, .*ur5_pick_servo.yaml', and 'turtlebot3' in that of the expert",
        ),
        (
            {"learner": stage("record/turtlebot3_avoid_dagger", *BRIEF, "--dataset.fps=5")},
            "the frame rate is 5 in learner.config, .* and 10 in that of the expert",
        ),
        (
            {
                "expert": stage("record/ur5_pick"),
                "evaluation": stage("eval/ur5_pick"),
                "learner": {"config": "without_advice.yaml", "options": []},
                "policy": stage("train/bc_ur5_pick_servo", "--selection.learner_weight=2"),
            },
            "--selection.learner_weight of .* they are not used for training",
        ),
        (
            {"learner": stage("record/ur5_pick_servo", "--brain.expert.type=pick")},
            "brain.expert.type is 'pick', which gives goals",
        ),
    ],
)
def test_what_cannot_be_is_said_before_the_first_round(changed, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    held_out = yaml.safe_load((CONFIGS / "record/turtlebot3_avoid.yaml").read_text())
    Path("held_out.yaml").write_text(yaml.safe_dump({**held_out, "split": "held_out"}))
    without_advice(tmp_path)
    if changed == {"data": ["without"]}:
        run_record(tmp_path / "without", dataset__episode_time_s=0.5, n_envs=1, dataset__num_episodes=1)
    assert main([f"--config_path={settings(tmp_path, **changed)}"]) == 2
    assert re.search(message, " ".join(capsys.readouterr().err.split()))
    assert not (tmp_path / "run").exists()


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.txt").write_text("mine")
    assert main([f"--config_path={settings(tmp_path)}"]) == 2
    assert "holds other files" in " ".join(capsys.readouterr().err.split())
    assert [one.name for one in (tmp_path / "run").iterdir()] == ["thesis.txt"]


@pytest.mark.law
def test_the_algorithm_decides_which_training_is_asked_for(tmp_path: Path) -> None:
    assert algorithm_of(read_line(["--algorithm=ppo"])) == "ppo"
    assert algorithm_of(read_line(["--config_path=configs/train/ppo_turtlebot3.yaml", "--steps=5"])) == "ppo"
    assert algorithm_of(read_line(["--config_path=configs/train/dagger_turtlebot3_avoid.yaml"])) == "dagger"
    assert algorithm_of(read_line(["--dataset.repo_id=a/b", "--policy.type=bhd_mlp"])) is None
    assert algorithm_of(read_line([f"--config_path={tmp_path}", "--resume=true"])) is None
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        algorithm_of(read_line([f"--config_path={tmp_path / 'missing.yaml'}"]))
    other = tmp_path / "bc.yaml"
    other.write_text(yaml.safe_dump({"dataset": {"repo_id": "a/b"}}))
    assert algorithm_of(read_line([f"--config_path={other}"])) is None
