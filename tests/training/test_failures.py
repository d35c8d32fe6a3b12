import errno
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from safetensors.torch import load_file

from bhd_lerobot.datasets.loader.check import fingerprint
from bhd_lerobot.datasets.loader.config import LoaderConfig
from bhd_lerobot.datasets.loader.loader import make_loader
from bhd_lerobot.errors import BhdError, ConfigError, DatasetError, DatasetMismatchError
from bhd_lerobot.policies.learned.policy import load_policy
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy
from bhd_lerobot.training import output
from bhd_lerobot.training.arguments import parse_train
from bhd_lerobot.training.log import MetricsFile
from bhd_lerobot.training.setup import has_bfloat16, refuse_unsupported
from tests.cases import each_case
from tests.training.support import ACT, MLP, curve, make_dataset, options, poison, run_train


@pytest.fixture(scope="module")
def trained(lesson: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "trained"
    run_train(options(lesson, run, MLP, steps=10))
    return run


def refused(arguments: list[str], error: type[BhdError], match: str) -> None:
    """Assert that a command line is refused and leaves nothing behind."""
    folders = [Path(argument.partition("=")[2]) for argument in arguments if argument.startswith("--output_dir=")]
    before = [folder.exists() for folder in folders]
    with pytest.raises(error, match=match):
        run_train(arguments)
    assert [folder.exists() for folder in folders] == before


def test_a_missing_dataset_names_where_it_was_looked_for(tmp_path: Path) -> None:
    refused(
        options(tmp_path / "none", tmp_path / "run"), DatasetError, rf"{tmp_path / 'none'} does not exist.*dataset.root"
    )
    refused(options(tmp_path, tmp_path / "run", dataset__root=None), DatasetError, r"lerobot/t/t does not exist")
    refused(["--policy.type=bhd_mlp"], ConfigError, r"No dataset is given; set --dataset.root=FOLDER, or ")


def test_a_dataset_that_lacks_what_is_needed(trained: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "set", episodes=2, environment=False)
    message = r"'act' cannot be made.*observation.state, action.*environment state"
    refused(options(root, tmp_path / "run"), ConfigError, message)
    arguments = options(root, tmp_path / "run", {}, policy__path=trained)
    refused(arguments, DatasetError, r"needs 'observation.environment_state' of shape \(2,\)")
    (root / "meta" / "stats.json").unlink()
    refused(options(root, tmp_path / "run"), DatasetError, "no statistics.*bhd-data repair")
    info = root / "meta" / "info.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "total_episodes": 0, "total_frames": 0}))
    refused(options(root, tmp_path / "run"), DatasetError, "no episode")


def test_a_selection_that_leaves_nothing_to_learn_from(lesson: Path, tmp_path: Path) -> None:
    for change, error, match in (
        ({"selection__outcome": "dropped"}, DatasetError, r"dropped.*4 success"),
        ({"selection__outcome": "[]"}, ConfigError, "No outcome is given"),
        ({"selection__outcome": "sucess"}, ConfigError, r"sucess.*Did you mean 'success'"),
        ({"dataset__episodes": "[0]", "dataset__eval_split": 0.5}, DatasetError, "no episode to train on"),
        ({"dataset__episodes": "[0, 17]"}, DatasetError, "no episode 17.*0 to 5"),
    ):
        arguments: dict[str, Any] = change
        refused(options(lesson, tmp_path / "run", **arguments), error, match)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_value_that_is_not_finite_is_named(tmp_path: Path, value: float) -> None:
    root = make_dataset(tmp_path / "set", episodes=3)
    poison(root, "observation.state", 27, value)
    message = r"episode 1, frame 7.*'observation.state' \(a\.pos\) is (nan|inf)"
    refused(options(root, tmp_path / "run"), DatasetError, message)
    result, _ = run_train(options(root, tmp_path / "run", dataset__episodes="[0, 2]", steps=2))  # the remedy works
    assert result.step == 2


def test_fine_tuning_on_what_does_not_fit_is_refused(lesson: Path, trained: Path, tmp_path: Path) -> None:
    for number, (change, match) in enumerate(
        (
            ({"robot": "other"}, r"robot 'toy'.*'other'"),
            ({"fps": 20}, r"10 frames a second.*20"),
            ({"environment": False}, r"environment features.*goal_x"),
        )
    ):
        arguments: dict[str, Any] = change
        root = make_dataset(tmp_path / f"set{number}", episodes=2, **arguments)
        refused(options(root, tmp_path / "run", {}, fine_tune=trained), DatasetMismatchError, match)
    other = Path(shutil.copytree(trained, tmp_path / "degrees", symlinks=True))
    file = other / "checkpoints" / "last" / "pretrained_model" / "bhd.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "units": "degrees"}))
    match = r"values are in SI.*trained on values in degrees"
    refused(options(lesson, tmp_path / "run", {}, fine_tune=other), DatasetMismatchError, match)


def test_a_camera_that_a_policy_does_not_look_through_need_not_be_the_same(lesson: Path, tmp_path: Path) -> None:
    run_train(options(lesson, tmp_path / "first", MLP, steps=1))
    contract = tmp_path / "first" / "checkpoints" / "last" / "pretrained_model" / "bhd.json"
    contract.write_text(json.dumps({**json.loads(contract.read_text()), "cameras": {"front": [8, 8, 3]}}))
    root = make_dataset(tmp_path / "set", episodes=2, frames=4, camera=True)
    result, _ = run_train(options(root, tmp_path / "run", {}, fine_tune=tmp_path / "first", steps=1))
    assert result.step == 1


def test_a_policy_whose_actions_begin_where_the_robot_is_does_so_with_whatever_statistics(lesson, tmp_path):
    """What it says nothing about stays as it is observed: by `bhd-train` in all ways.

    LeRobot's programs do not tell the policy which statistics count: it learns where they are the same only.
    """
    first = tmp_path / "first"
    run_train(options(lesson, first, {**MLP, "policy.residual": "['*.pos']"}, steps=1))
    other = make_dataset(tmp_path / "set", episodes=3, shift=5.0)
    folders = [first / "checkpoints" / "last" / "pretrained_model"]
    for statistics in ("checkpoint", "dataset"):
        arguments = options(other, tmp_path / statistics, {}, fine_tune=first, fine_tune_statistics=statistics, steps=1)
        result, _ = run_train(arguments)
        assert result.checkpoint is not None
        folders.append(result.checkpoint / "pretrained_model")
    arguments = options(other, tmp_path / "path", {}, steps=1)
    result, _ = run_train([*arguments, f"--policy.path={folders[0]}"])
    assert result.checkpoint is not None
    folders.append(result.checkpoint / "pretrained_model")
    made = [(one.policy, one.before, one.after) for one in map(load_policy, folders)]
    config = PreTrainedConfig.from_pretrained(folders[0])
    config.pretrained_path = folders[0]
    before, after = make_pre_post_processors(config, pretrained_path=str(folders[0]))
    made.append((make_policy(config, LeRobotDatasetMetadata("t/t", root=lesson)).train(), before, after))
    unlike = make_policy(config, LeRobotDatasetMetadata("t/t", root=other))
    with pytest.raises(ConfigError, match=r"this dataset has others. Fine-tune it by bhd-train"):
        unlike.train()
    made.append((unlike, before, after))  # as it was loaded
    generator = torch.Generator().manual_seed(0)
    state, goal = torch.randn(10, 4, generator=generator), torch.zeros(10, 2)
    for policy, before, after in made:
        for parameter in policy.net.parameters():
            torch.nn.init.zeros_(parameter)
        batch = {"observation.state": state, "observation.environment_state": goal}
        actions = after(policy.predict_action_chunk(before(batch)))
        assert torch.allclose(actions, state[:, None, :2].expand_as(actions), atol=1e-5)


def test_fine_tuning_changes_only_the_parameters_that_are_asked_for(
    lesson: Path, trained: Path, tmp_path: Path
) -> None:
    changes = {"steps": 4, "save_freq": 2, "log_freq": 1, "fine_tune_parameters": "['*.bias']"}
    result, _ = run_train(options(lesson, tmp_path / "run", {}, fine_tune=trained, **changes))
    assert result.checkpoint is not None
    folders = (trained / "checkpoints" / "last", result.checkpoint)
    old, new = (load_file(folder / "pretrained_model" / "model.safetensors") for folder in folders)
    assert set(old) == set(new)
    for name, values in old.items():
        assert bool(torch.equal(values, new[name])) != name.endswith(".bias"), name
    # A run that goes on knows which they were.
    whole = curve(tmp_path / "run")
    again = tmp_path / "run" / "checkpoints" / "000002" / "pretrained_model"
    resumed, _ = run_train([f"--config_path={again / 'train_config.json'}", "--resume=true"])
    assert resumed.checkpoint is not None
    assert curve(tmp_path / "run") == whole
    again_new = load_file(resumed.checkpoint / "pretrained_model" / "model.safetensors")
    assert all(torch.equal(values, again_new[name]) for name, values in new.items())


def test_a_camera_is_found_only_for_a_policy_that_has_one(lesson: Path, trained: Path, tmp_path: Path) -> None:
    arguments = options(lesson, tmp_path / "run", {}, fine_tune=trained, fine_tune_camera="true")
    refused(arguments, ConfigError, r"'bhd_mlp' does not know where its camera stands; a 'bhd_perception' does")
    arguments = options(lesson, tmp_path / "run", MLP, fine_tune_camera="true")
    refused(arguments, ConfigError, r"no checkpoint is given; set --fine_tune")


def test_a_checkpoint_that_is_not_there(lesson: Path, tmp_path: Path) -> None:
    arguments = options(lesson, tmp_path / "run", {}, fine_tune=tmp_path / "none")
    refused(arguments, ConfigError, r"no policy at .*none.*does not exist")
    with pytest.raises(ConfigError, match="No checkpoint to resume at"):
        parse_train(["--resume=true", f"--config_path={tmp_path / 'none'}"])
    with pytest.raises(ConfigError, match="resume needs --config_path"):
        parse_train(["--resume=true"])


def test_a_checkpoint_with_a_damaged_state_or_another_dataset_is_not_resumed(trained: Path, tmp_path: Path) -> None:
    run = shutil.copytree(trained, tmp_path / "run", symlinks=True)
    again = ["--resume=true", f"--config_path={run}", "--steps=12"]
    other = make_dataset(tmp_path / "other", episodes=3)
    with pytest.raises(BhdError, match=r"120 frames.*60.*--fine_tune"):
        run_train([*again, f"--dataset.root={other}"])
    (run / "checkpoints" / "last" / "training_state" / "optimizer_state.safetensors").write_bytes(b"torn")
    with pytest.raises(ConfigError, match="cannot be resumed from"):
        run_train(again)


def test_weights_that_are_damaged_are_named(lesson: Path, trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "damaged", symlinks=True)
    file = tmp_path / "damaged" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"
    file.write_bytes(file.read_bytes()[:200])
    for key in ("fine_tune", "policy.path"):
        arguments = options(lesson, tmp_path / "run", {key: tmp_path / "damaged"})
        refused(arguments, ConfigError, r"'bhd_mlp' cannot be made from .*damaged.*header")
    with pytest.raises(ConfigError, match=r"'bhd_mlp' cannot be made from .*damaged"):
        run_train(["--resume=true", f"--config_path={tmp_path / 'damaged'}", "--steps=12"])


def test_an_environment_of_another_robot(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "set", episodes=2, robot="ur5")
    for namespace in ("", "bhd_lerobot/"):
        env = {"env__type": "bhd", "env__task": f"{namespace}TurtleBot3Avoid-v0", "env_eval_freq": 2}
        message = r"env.task is '.*TurtleBot3Avoid-v0', which is for a turtlebot3; .* Valid: UR5Pick-v0, UR5Reach-v0"
        refused(options(root, tmp_path / "run", MLP, **env), ConfigError, message)


def test_what_a_resumed_run_would_ignore_is_refused(lesson: Path, tmp_path: Path) -> None:
    run_train(options(lesson, tmp_path / "run", MLP, steps=5))
    resume = ["--resume=true", f"--config_path={tmp_path / 'run'}", "--steps=7"]
    for name, value, was in (
        ("policy.optimizer_lr", 0.5, 0.001),
        ("policy.scheduler_warmup_steps", 5, 100),
        ("optimizer.weight_decay", 0.5, 0.0001),
        ("policy.path", "elsewhere", None),
        ("fine_tune", "elsewhere", None),
    ):
        with pytest.raises(ConfigError, match=f"{name} is {value!r}, and a run that is resumed .* {was!r}"):
            run_train([*resume, f"--{name}={value}"])
    run_train([*resume, "--policy.optimizer_lr=1e-3", "--optimizer.grad_clip_norm=2.0"])


def test_what_is_chosen_by_while_training_is_not_what_is_reported(tmp_path, monkeypatch):
    """Beside the episodes of the split that was asked for, an evaluation while training runs none that are held out."""
    root, splits = make_dataset(tmp_path / "set", robot="turtlebot3"), []

    def make(config: Any, **_: Any) -> Any:
        splits.append(config.split)
        raise BhdError("seen")

    monkeypatch.setattr("bhd_lerobot.training.env.make_env", make)
    env = {"env__type": "bhd", "env__task": "TurtleBot3Avoid-v0", "env_eval_freq": 2}
    for number, split in enumerate((None, "train", "validation")):
        asked = {} if split is None else {"env__split": split}
        with pytest.raises(BhdError, match="seen"):
            run_train(options(root, tmp_path / f"run{number}", MLP, **env, **asked))
    assert splits == ["validation", "train", "validation"]


def test_metrics_that_cannot_be_written_leave_the_checkpoint(lesson, tmp_path, monkeypatch):
    append = MetricsFile.append

    def full(self: MetricsFile, row: dict[str, Any]) -> None:
        if row["step"] > 10:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(self, row)

    def no_image(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(MetricsFile, "append", full)
    monkeypatch.setattr(output, "draw_loss", no_image)
    with pytest.raises(BhdError, match=r"metrics of step 15 .*No space left.*000010 is intact.*resume"):
        run_train(options(lesson, tmp_path / "run", MLP))
    monkeypatch.undo()
    result, _ = run_train(["--resume=true", f"--config_path={tmp_path / 'run'}"])
    assert (result.step, [row["step"] for row in curve(tmp_path / "run")]) == (20, [5, 10, 15, 20])


def test_what_is_held_out_stays_so_when_a_run_is_resumed(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "set", episodes=5, instructions=5)
    run = tmp_path / "run"
    held_out = {"dataset__episodes": "[0, 1, 2, 3]", "dataset__eval_split": 0.3, "eval_steps": 5}
    _, printed = run_train(options(root, run, MLP, steps=5, **held_out))
    assert "2 episodes, 2 held out" in printed
    again = ["--resume=true", f"--config_path={run}", "--steps=9"]
    with pytest.raises(BhdError, match=r"2 episodes \(0, 3\) held out, and now it would be 2 episodes \(0, 4\)"):
        run_train([*again, "--dataset.episodes=[0, 1, 2, 4]"])
    own = run / "checkpoints" / "last" / "pretrained_model" / "bhd_train.json"
    values = json.loads(own.read_text())
    assert values["selection"].pop("hold_out") == "episode"
    own.write_text(json.dumps(values))  # as it was written when LeRobot's rule was the only one
    assert parse_train(again).selection.hold_out == "instruction"
    own.unlink()  # a checkpoint of lerobot-train
    assert parse_train(again).selection.hold_out == "instruction"


@pytest.mark.parametrize(
    ("what", "said"),
    [("loss", r"loss is nan at step 10 .*batch of episode:frame \d+:\d+"), ("gradient", "gradient is nan at step 10 ")],
)
def test_what_is_not_a_number_stops_before_it_reaches_weights_that_are_saved(lesson, tmp_path, monkeypatch, what, said):
    calls = []
    forward = MlpPolicy.forward

    def breaks(self: MlpPolicy, batch: dict) -> tuple:
        loss, outputs = forward(self, batch)
        calls.append(None)
        zero = self.net[0].bias[0] * 0  # the slope of a root is infinite there
        wrong = loss * math.nan if what == "loss" else loss + zero.sqrt()
        return (wrong if len(calls) == 10 else loss), outputs

    monkeypatch.setattr(MlpPolicy, "forward", breaks)
    with pytest.raises(BhdError, match=rf"{said}.*step 5 is kept"):
        run_train(options(lesson, tmp_path / "run", MLP, steps=10, save_freq=5))
    monkeypatch.undo()
    assert sorted(one.name for one in (tmp_path / "run" / "checkpoints").iterdir()) == ["000005", "last"]
    result, _ = run_train(["--resume=true", f"--config_path={tmp_path / 'run'}"])
    assert result.step == 10


def test_an_output_folder_that_exists(lesson: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious").touch()
    refused(options(lesson, tmp_path / "run"), ConfigError, r"run exists and holds no run to continue.*--output_dir\.")
    assert [one.name for one in (tmp_path / "run").iterdir()] == ["precious"]
    with pytest.raises(ConfigError, match=r"File name too long.*--output_dir"):
        run_train(options(lesson, tmp_path / ("x" * 300)))
    monkeypatch.setenv("HOME", str(tmp_path))
    refused(options(lesson, Path("~/run")), ConfigError, rf"The output folder {tmp_path / 'run'} exists")


@each_case(
    ("change", "match"),
    [
        ({"policy.type": "akt"}, r"'akt'. Did you mean 'act'\? Valid: .*bhd_mlp.*diffusion"),
        ({"policy.chunk_sise": 3}, r"policy.chunk_sise.*Did you mean 'policy.chunk_size'"),
        ({"stepps": 3}, r"stepps.*Did you mean 'steps'"),
        ({"steps": 0}, "steps is 0; it must be at least 1"),
        ({"steps": 2.5}, "steps is 2.5; it must be a whole number"),
        ({"seed": 2**32}, "seed is 4294967296; it must be from 0 to 4294967295"),
        ({"batch_size": 0}, "batch_size is 0"),
        ({"budget_gib": 0}, "budget_gib is 0"),
        (
            {"fine_tune_parameters": "[model.*,net.9.*]"},
            r"'net\.9\.\*' matches no parameter of the policy, which has model",
        ),
        ({"fine_tune_parameters": "[]"}, r"fine_tune_parameters is \[\]; it matches no parameter .* and \d+ more"),
        ({"dataset.streaming": "true"}, "dataset.streaming is not for bhd-train"),
        ({"peft.r": 4}, "peft"),
        ({"policy.push_to_hub": "true"}, "--policy.repo_id"),
        ({"optimizer.type": "sgd"}, "use_policy_training_preset"),
        ({"eval_steps": 5}, "eval_steps > 0 requires dataset.eval_split"),
        ({"policy.type": None}, "policy.type is missing.*Valid: .*act"),
        ({"policy.n_heads": "[1]"}, r"policy.n_heads is \[1\]"),
        ({"policy.device": "tpu"}, r"(?i)cannot be used: .*tpu"),
        ({"dataset.eval_split": ".nan"}, r"cannot be used: .*eval_split.*nan"),
        ({"dataset.episodes": 3}, "dataset.episodes is 3; it must be a list of whole numbers"),
        ({"log_freq": -1}, "log_freq is -1; it must be at least 0"),
        ({"tolerance_s": ".nan"}, "tolerance_s is nan"),
        ({"env.type": "bhd", "env_eval_freq": 2, "eval.n_episodes": 0}, "eval.n_episodes is 0"),
        ({"policy.optimizer_lr": ".nan"}, r"optimizer cannot be made: .*nan.*policy\.optimizer_"),
    ],
)
def test_a_configuration_that_cannot_be_honoured(lesson, tmp_path, change, match):
    refused(options(lesson, tmp_path / "run", {**ACT, **change}), ConfigError, match)
    arguments = [one for one in options(lesson, tmp_path / "run", {}) if "policy" not in one]
    refused(arguments, ConfigError, "No policy is given.*bhd_mlp")


def test_mixed_precision_that_the_processor_can_only_emulate(lesson, tmp_path, monkeypatch):
    arguments = options(lesson, tmp_path / "run", MLP, steps=2, policy__use_amp="true")
    # A processor that has no such instruction says so, or knows nothing of it.
    for known in ({}, {"avx512_bf16": False, "avx2": True}, {"neon": True}):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda known=known: known)
        refused(arguments, ConfigError, r"no instructions for bfloat16.*--policy\.use_amp=false")
    # Of others only the check is asked: accelerate has one precision in a process, and other tests have another.
    for known in ({"avx512_bf16": False, "amx_bf16": True}, {"neon": True, "bf16": True}):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda known=known: known)
        assert has_bfloat16()
    monkeypatch.delattr(torch.cpu, "get_capabilities")  # an older PyTorch: nothing is known, nothing refused
    assert has_bfloat16()


@each_case("name", ["accelerator", "checkpoint_format", "ema", "parallelism", "peft", "sample_weighting"])
def test_what_only_lerobots_loop_does_is_refused(name: str, tmp_path: Path) -> None:
    """Some of these options came after version 0.6.1 of LeRobot."""
    config = parse_train(options(tmp_path, tmp_path / "run"))
    refuse_unsupported(config)
    for owner, option in ((config, name), (config.dataset, "exclude_episodes")):
        before = vars(owner).get(option)
        setattr(owner, option, [1])
        with pytest.raises(ConfigError, match=f"{option} is not for bhd-train"):
            refuse_unsupported(config)
        setattr(owner, option, before)


@pytest.mark.parametrize("camera", [False, True])
def test_a_run_goes_on_with_its_own_data_only_wherever_they_lie(tmp_path: Path, camera: bool) -> None:
    root, run = make_dataset(tmp_path / "set", camera=camera), tmp_path / "run"
    run_train(options(root, run, MLP, steps=4))
    again = [f"--config_path={run}", "--resume=true"]
    other = make_dataset(tmp_path / "other", shift=0.01, camera=camera)  # as many frames
    renamed = make_dataset(tmp_path / "renamed", instructions=2, camera=camera)
    for wrong in (other, renamed):
        with pytest.raises(BhdError, match=r"was started on other data: as many frames \(120\).*--fine_tune"):
            run_train([*again, "--steps=6", f"--dataset.root={wrong}"])
    shutil.move(root, tmp_path / "moved")
    result, _ = run_train([*again, "--steps=6", f"--dataset.root={tmp_path / 'moved'}"])
    assert result.step == 6


def test_depth_is_served_in_the_unit_that_was_asked_for(lesson, tmp_path, monkeypatch):
    units, make = [], LeRobotDataset.__init__

    def made(self: LeRobotDataset, *args: Any, **options: Any) -> None:
        units.append(options["depth_output_unit"])
        make(self, *args, **options)

    monkeypatch.setattr(LeRobotDataset, "__init__", made)
    arguments = options(lesson, tmp_path / "run", MLP, steps=1, budget_gib=1e-9, dataset__depth_output_unit="m")
    run_train(arguments)  # depth is not kept in memory
    assert units == ["m"]


def test_a_fingerprint_is_the_same_however_the_data_are_served(lesson: Path) -> None:
    meta = LeRobotDatasetMetadata("t/t", root=lesson)
    keys = ["observation.state", "action"]
    served = [
        make_loader("t/t", LoaderConfig(batch_size=4, budget_gib=budget), meta=meta).dataset for budget in (1.0, 1e-9)
    ]
    assert len({type(dataset) for dataset in served}) == 2
    assert len({fingerprint(dataset, keys) for dataset in served}) == 1
