import itertools
import json
import os
import re
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import draccus
import pytest
import torch
import yaml
from accelerate import Accelerator
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts import lerobot_train

from bhd_lerobot.cli.train import main
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.training import checkpoint
from bhd_lerobot.training import train as module
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.data import TrainingData, open_data
from bhd_lerobot.training.log import MetricsFile
from bhd_lerobot.training.setup import make_accelerator
from bhd_lerobot.training.step import Learner, StepResult
from tests.training.support import ACT, MLP, curve, make_dataset, options, run_train


@pytest.mark.figures
def test_a_run_leaves_metrics_a_curve_its_configuration_and_checkpoints(lesson: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    result, printed = run_train(options(lesson, run, eval_steps=10, dataset__eval_split=0.3))
    rows = curve(run)
    assert [row["step"] for row in rows] == [5, 10, 15, 20]
    assert [row["step"] for row in rows if "held_out_loss" in row] == [10, 20]
    assert all({"epoch", "loss", "l1_loss", "kld_loss", "lr", "grad_norm"} <= set(row) for row in rows)
    assert rows[-1]["loss"] < rows[0]["loss"]
    assert (run / "loss.png").stat().st_size > 5000
    assert sorted(one.name for one in (run / "checkpoints").iterdir()) == ["000010", "000020", "last"]
    assert os.readlink(run / "checkpoints" / "last") == "000020"
    assert result.checkpoint == run / "checkpoints" / "000020"
    assert str(result.checkpoint / "pretrained_model") in printed
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["steps"] == 20
    assert config["policy"]["input_features"]["observation.state"]["shape"] == [4]


def test_config_yaml_gives_the_same_run_again(lesson: Path, tmp_path: Path) -> None:
    run_train(options(lesson, tmp_path / "one", MLP, selection__outcome="success", selection__intervention_weight=3.0))
    config = tmp_path / "one" / "config.yaml"
    run_train([f"--config_path={config}", f"--output_dir={tmp_path / 'two'}"])
    assert curve(tmp_path / "one") == curve(tmp_path / "two")
    # Also of a run that was resumed, which it does not touch.
    again = ["--resume=true", f"--config_path={tmp_path / 'two' / 'checkpoints' / '000010'}"]
    assert run_train(again)[0].step == 20
    with pytest.raises(ConfigError, match=r"two exists\. .*continue its run with --resume=true"):
        run_train([f"--config_path={tmp_path / 'two'}"])
    run_train([f"--config_path={tmp_path / 'two'}", f"--output_dir={tmp_path / 'three'}"])
    assert curve(tmp_path / "one") == curve(tmp_path / "two") == curve(tmp_path / "three")


@pytest.mark.parametrize("policy", [ACT, MLP], ids=["act", "bhd_mlp"])
def test_the_first_losses_are_those_of_lerobot_train(lesson, tmp_path, policy, monkeypatch):
    result, _ = run_train(options(lesson, tmp_path / "ours", policy, log_freq=1, save_freq=0))
    values = json.loads((result.output_dir / "train_config.json").read_text())
    values |= {"output_dir": str(tmp_path / "stock"), "checkpoint_path": None, "optimizer": None, "scheduler": None}
    values["save_freq"] = 12
    monkeypatch.setattr(sys, "argv", ["lerobot-train"])
    losses: list[float] = []
    original = lerobot_train.update_policy

    def spy(tracker, *args, **kwargs):
        tracker, outputs = original(tracker, *args, **kwargs)
        losses.append(tracker.metrics["loss"].val)
        return tracker, outputs

    monkeypatch.setattr(lerobot_train, "update_policy", spy)
    lerobot_train.train(draccus.decode(TrainPipelineConfig, values))
    assert [row["loss"] for row in curve(tmp_path / "ours")] == losses
    path = "checkpoints/last/pretrained_model/model.safetensors"
    assert (tmp_path / "ours" / path).read_bytes() == (tmp_path / "stock" / path).read_bytes()
    # With one of its checkpoints `bhd-train` goes on where it was in its order of samples, 15 batches an epoch.
    run_train(["--resume=true", f"--config_path={tmp_path / 'stock' / 'checkpoints' / '000012'}"])
    assert curve(tmp_path / "stock") == curve(tmp_path / "ours")[12:]


def test_evaluating_does_not_change_the_training(lesson: Path, tmp_path: Path) -> None:
    split = {"dataset__eval_split": 0.3}
    run_train(options(lesson, tmp_path / "one", **split))
    run_train(options(lesson, tmp_path / "two", eval_steps=3, **split))
    losses = [[row["loss"] for row in curve(tmp_path / name) if "loss" in row] for name in ("one", "two")]
    assert losses[0] == losses[1]


@pytest.mark.parametrize("budget", [4.0, 1e-6], ids=["in memory", "lerobot's loader"])
def test_a_resumed_run_continues_to_the_same_bits(lesson, tmp_path, budget, monkeypatch):
    # 12 is no multiple of log_freq, so a window of metrics is cut in two as well.
    common = {"save_freq": 12, "eval_steps": 10, "dataset__eval_split": 0.3, "budget_gib": budget}
    _, printed = run_train(options(lesson, tmp_path / "whole", **common))
    assert ("LeRobot's own loader" in printed) == (budget < 1)

    class KilledError(Exception):
        pass

    save = checkpoint.save

    def killed(*args, **kwargs):
        save(*args, **kwargs)
        raise KilledError

    monkeypatch.setattr(checkpoint, "save", killed)
    with pytest.raises(KilledError):
        run_train(options(lesson, tmp_path / "cut", **common))
    monkeypatch.undo()
    with (tmp_path / "cut" / "metrics.jsonl").open("a") as file:
        file.write('{"step": 13, "loss": 1}\n{"step": 14, "lo')  # what came after the checkpoint, and a torn line
    last = tmp_path / "cut" / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    result, printed = run_train(["--resume=true", f"--config_path={last}"])
    assert result.step == 20
    assert "after step 12" in printed
    assert curve(tmp_path / "cut") == curve(tmp_path / "whole")
    weights = "checkpoints/last/pretrained_model/model.safetensors"
    assert (tmp_path / "cut" / weights).read_bytes() == (tmp_path / "whole" / weights).read_bytes()


def test_the_scale_of_gradients_in_half_precision_goes_on_where_it_was(lesson, tmp_path, monkeypatch):
    """Only a GPU computes with it; its scale is the same anywhere."""
    scalers: list[torch.amp.GradScaler] = []

    def half(config: BhdTrainConfig) -> Accelerator:
        accelerator = make_accelerator(config)
        accelerator.scaler = torch.amp.GradScaler("cpu", init_scale=16.0, growth_interval=5)
        scalers.append(accelerator.scaler)
        return accelerator

    monkeypatch.setattr(module, "make_accelerator", half)
    monkeypatch.setattr(Accelerator, "mixed_precision", property(lambda _: "fp16"))
    run_train(options(lesson, tmp_path / "run", MLP, save_freq=12))
    whole = curve(tmp_path / "run")
    run_train(["--resume=true", f"--config_path={tmp_path / 'run' / 'checkpoints' / '000012'}"])
    assert curve(tmp_path / "run") == whole
    assert scalers[1].state_dict() == scalers[0].state_dict()
    assert scalers[0].get_scale() == 16.0 * 2**4


def test_what_is_not_logged_is_not_kept(lesson: Path, tmp_path: Path) -> None:
    result, _ = run_train(options(lesson, tmp_path / "run", MLP, steps=104, log_freq=0, save_freq=0))
    assert result.checkpoint is not None
    assert len(json.loads((result.checkpoint / "training_state" / "bhd_loop.json").read_text())["window"]) == 4


def test_a_signal_in_the_last_step_leaves_a_complete_run(lesson, tmp_path, hub, monkeypatch, capfd):
    step, steps = Learner.step, itertools.count(1)

    def pressed(self: Learner, batch: dict) -> StepResult:
        if next(steps) == 5:
            signal.raise_signal(signal.SIGINT)
        return step(self, batch)

    monkeypatch.setattr(Learner, "step", pressed)
    pushed = {"policy.repo_id": "me/p", "policy.push_to_hub": True}
    assert main(options(lesson, tmp_path / "run", MLP | pushed, steps=5)) == 130
    assert "model.safetensors" in hub.repositories["models/me/p"].files()
    assert "--resume=true" not in capfd.readouterr().err  # there is nothing to continue


def test_ctrl_c_saves_and_prints_the_resume_command(lesson, tmp_path, monkeypatch, capfd):
    run = tmp_path / "run"
    common = {"steps": 30, "save_freq": 0, "policy": MLP}
    run_train(options(lesson, tmp_path / "whole", **common))
    append = MetricsFile.append

    def press(self: MetricsFile, row: dict) -> None:
        append(self, row)
        if row["step"] == 15:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(MetricsFile, "append", press)
    assert main(options(lesson, run, **common)) == 130
    monkeypatch.undo()
    path = run / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    assert f"bhd-train --resume=true --config_path={path}" in capfd.readouterr().err
    result, _ = run_train(["--resume=true", f"--config_path={path}"])
    assert result.step == 30
    assert curve(run) == curve(tmp_path / "whole")


def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(lesson, tmp_path, monkeypatch):
    run = tmp_path / "run"
    calls = []
    flush = checkpoint._flush

    class Killed(BaseException):
        pass

    def die_the_second_time(folder: Path) -> None:
        calls.append(folder)
        if len(calls) == 2:
            (folder / "pretrained_model" / "model.safetensors").write_bytes(b"half")
            raise Killed
        flush(folder)

    monkeypatch.setattr(checkpoint, "_flush", die_the_second_time)
    with pytest.raises(Killed):
        run_train(options(lesson, run, MLP))
    monkeypatch.undo()
    assert os.readlink(run / "checkpoints" / "last") == "000010"
    assert (run / "checkpoints" / ".000020.part").is_dir()
    result, _ = run_train(["--resume=true", f"--config_path={run}"])
    assert result.step == 20
    assert sorted(one.name for one in (run / "checkpoints").iterdir()) == ["000010", "000020", "last"]


@pytest.mark.law
def test_a_full_disk_ends_with_the_checkpoint_before_intact(lesson, tmp_path, monkeypatch):
    save = checkpoint.save_checkpoint

    def full(folder: Path, step: int, *args, **kwargs):
        save(folder, step, *args, **kwargs)
        if step == 20:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_checkpoint", full)
    with pytest.raises(BhdError, match=r"checkpoint of step 20 .* No space left"):
        run_train(options(lesson, tmp_path / "run", MLP))
    assert sorted(one.name for one in (tmp_path / "run" / "checkpoints").iterdir()) == ["000010", "last"]


def test_a_finished_run_names_the_option_to_continue_and_resumes_where_it_was_moved(
    lesson: Path, tmp_path: Path
) -> None:
    run_train(options(lesson, tmp_path / "run", MLP, steps=5))
    with pytest.raises(ConfigError, match=r"5 of 5 steps.*--steps"):
        run_train(["--resume=true", f"--config_path={tmp_path / 'run'}"])
    (tmp_path / "run").rename(tmp_path / "moved")
    result, _ = run_train(["--resume=true", f"--config_path={tmp_path / 'moved'}", "--steps=7"])
    assert (result.step, result.output_dir) == (7, tmp_path / "moved")
    assert not (tmp_path / "run").exists()


def test_a_run_is_resumed_where_a_copy_made_a_folder_of_a_link_or_lost_it(lesson: Path, tmp_path: Path) -> None:
    run_train(options(lesson, tmp_path / "run", MLP, steps=4, save_freq=2))
    followed, lost = (shutil.copytree(tmp_path / "run", tmp_path / name) for name in ("followed", "lost"))
    shutil.rmtree(lost / "checkpoints" / "last")
    for run in (followed, lost):
        result, printed = run_train(["--resume=true", f"--config_path={run}", "--steps=6"])
        assert "after step 4" in printed
        assert result.step == 6
        assert os.readlink(run / "checkpoints" / "last") == "000006"


def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(lesson, tmp_path, monkeypatch):
    def meanwhile(*args: Any, **kwargs: Any) -> TrainingData:
        (tmp_path / "run").mkdir()
        return open_data(*args, **kwargs)

    monkeypatch.setattr(module, "open_data", meanwhile)
    result, printed = run_train(options(lesson, tmp_path / "run", MLP, steps=1))
    assert result.output_dir == tmp_path / "run_2"
    assert str(result.output_dir) in printed
    assert list((tmp_path / "run").iterdir()) == []


def test_only_the_chosen_episodes_and_frames_are_learned_from(lesson: Path, tmp_path: Path) -> None:
    chosen = {"selection__outcome": "[success, collision]", "selection__min_score": 0.2}
    arguments = options(lesson, tmp_path / "run", steps=2, selection__intervention_weight=0, **chosen)
    _, printed = run_train(arguments)
    assert f"4 episodes, {4 * 17} samples in an epoch" in printed
    saved = json.loads((tmp_path / "run" / "train_config.json").read_text())
    assert saved["dataset"]["episodes"] == [2, 3, 4, 5]


def test_cameras_are_learned_from(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "set", episodes=2, frames=6, camera=True)
    extra = {"policy__pretrained_backbone_weights": "null", "steps": 2, "log_freq": 1}
    result, _ = run_train(options(root, tmp_path / "run", **extra))
    assert all(torch.isfinite(torch.tensor(row["loss"])) for row in result.rows)


def test_quantiles_that_are_averages_of_episodes_are_warned_of(tmp_path: Path) -> None:
    """Of episodes that differ, most values lie beyond what the policy takes for nearly all."""
    differing = make_dataset(tmp_path / "d", episodes=3, spread=100.0)
    one = make_dataset(tmp_path / "one", episodes=1, frames=200)
    for mode in ("QUANTILES", "QUANTILE10", "MEAN_STD", "MIN_MAX"):
        mapping = {"STATE": "MEAN_STD", "ENV": "MEAN_STD", "ACTION": mode}
        policy = {**MLP, "policy.normalization_mapping": json.dumps(mapping)}
        _, printed = run_train(options(differing, tmp_path / mode, policy, steps=1))
        assert ("warning: action is normalised by" in printed) == mode.startswith("QUANTILE")
        if mode == "QUANTILES":
            # Around 0, 100 and 200 the average of the quantiles is around 100: at most a third lies between.
            found = re.search(r"by q01 and q99, and up to (\d+) % of the frames lie beyond them, not 2 %", printed)
            assert found is not None
            assert int(found[1]) >= 66
            _, printed = run_train(options(one, tmp_path / "other", policy, steps=1))
            assert "warning: action is normalised by" not in printed


def test_an_input_that_never_changes_is_warned_of_where_it_would_count(tmp_path: Path) -> None:
    """What `bhd_mlp` ignores, other policies divide by nothing: the goals of single episodes do not change."""
    root = make_dataset(tmp_path / "d", episodes=1, frames=40)
    what = "warning: goal_x, goal_y of observation.environment_state never changes in the data. A 'act' divides"
    mapping = {"policy.normalization_mapping": json.dumps(dict.fromkeys(("STATE", "ENV", "ACTION"), "MEAN_STD"))}
    cases = ((ACT | mapping, True), (ACT, False), (MLP, False))  # ACT itself takes the environment state as it is
    for number, (policy, warns) in enumerate(cases):
        _, printed = run_train(options(root, tmp_path / f"run{number}", policy, steps=1))
        assert (what in printed) == warns


@pytest.mark.parametrize("policy", [ACT, MLP], ids=["act", "bhd_mlp"])
def test_a_policy_that_is_pushed_holds_no_path_of_this_machine(lesson, tmp_path, hub, policy):
    run = tmp_path / "run"
    pushed = {"policy.repo_id": "me/p", "policy.push_to_hub": True}
    run_train(options(lesson, run, policy | pushed, steps=5))
    files = {path: blob.content for path, blob in hub.repositories["models/me/p"].files().items()}
    assert {"config.json", "train_config.json", "README.md", "model.safetensors"} <= set(files)
    assert json.loads(files["train_config.json"])["dataset"]["root"] == lesson.name
    for path, content in files.items():
        assert str(tmp_path.parent).encode() not in content, path
        assert str(lesson.parent).encode() not in content, path
    # What stays on this machine can be resumed.
    assert json.loads((run / "train_config.json").read_text())["dataset"]["root"] == str(lesson)
