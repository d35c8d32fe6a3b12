"""From a recorded dataset to a checkpoint to a brain that sees with it: every command, and what each refuses."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.tabletop import scene_camera
from bhd_lerobot.bodies.ur import ur
from bhd_lerobot.datasets.edit.edits import merge
from bhd_lerobot.errors import ConfigError, DatasetError, PerceptionError, RenderingError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.evaluate import evaluate
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.policy import load_policy
from bhd_lerobot.policies.perception.perceiver import Perceiver, PerceptionOptions
from bhd_lerobot.registry import make_brain
from tests.cases import each_case
from tests.policies.learned.rig import save_policy
from tests.recording.support import run_record
from tests.training.support import make_dataset, run_train

WIDTH, HEIGHT = 96, 72
ARM = {"robot__type": "ur5", "robot__beams": None, "task__type": "pick", "task__language": "any"}
CAMERA = {"robot__camera": "true", "robot__camera_width": WIDTH, "robot__camera_height": HEIGHT}


def look(root: Path, **options: Any) -> Path:
    """Record tables with images and true poses; return the folder."""
    still = {**ARM, **CAMERA, "brain__type": "noop", "dataset__episode_time_s": 0.04}
    try:
        run_record(root, **{**still, **options})
    except RenderingError as error:
        pytest.skip(f"no image can be rendered on this machine: {error}")
    return root


@pytest.fixture(scope="module")
def looks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return look(tmp_path_factory.mktemp("perception") / "looks", dataset__num_episodes=24, n_envs=4)


def train(root: Path, run: Path, **options: Any) -> Any:
    small = {
        "type": "bhd_perception",
        "channels": 8,
        "hidden": 8,
        "context": 8,
        "device": "cpu",
        "push_to_hub": "false",
    }
    given = {"steps": 8, "batch_size": 8, "log_freq": 4, "eval_steps": 4, "dataset.eval_split": 0.25, **options}
    return run_train(
        [
            f"--dataset.root={root}",
            "--dataset.repo_id=test/looks",
            f"--output_dir={run}",
            "--env_eval_freq=0",
            *(f"--policy.{name}={value}" for name, value in small.items()),
            *(f"--{name}={value}" for name, value in given.items()),
        ]
    )


@pytest.fixture(scope="module")
def run(looks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the training, long enough to write a checkpoint."""
    folder = tmp_path_factory.mktemp("perception") / "run"
    train(looks, folder)
    return folder


def test_it_is_evaluated_by_itself_and_reports_how_well_it_saw(run: Path, tmp_path: Path) -> None:
    saved = json.loads((run / "checkpoints/last/pretrained_model/config.json").read_text())
    assert list(saved["input_features"]) == ["observation.images.scene"]
    assert list(saved["output_features"]) == ["observation.environment_state"]
    arguments = [
        "--config_path=configs/eval/ur5_look.yaml",
        f"--brain.perception.path={run}",
        f"--robot.camera_width={WIDTH}",
        f"--robot.camera_height={HEIGHT}",
        "--n_episodes=3",
        f"--output_dir={tmp_path / 'eval'}",
    ]
    result = evaluate(parse(EvalConfig, arguments))
    assert not result.results.brains["language"].privileged
    saw = result.results.brains["language"].perception
    assert saw is not None
    assert saw.episodes == 3
    assert saw.chosen.value == 0, "after 8 steps it knows nothing yet, and says so"
    assert "What was seen" in result.report.read_text()
    weights = result.results.config["brains"]["language"]["perception"]["weights"]
    assert weights.startswith("sha256:")


def test_where_camera_and_table_are_it_is_told_by_the_arm_that_recorded(run: Path, tmp_path: Path) -> None:
    root = look(tmp_path / "looks", robot__type="ur3e", dataset__num_episodes=8)
    train(root, tmp_path / "run", steps=2, batch_size=4)
    for folder, robot in ((run, "ur5"), (tmp_path / "run", "ur3e")):
        saved = json.loads((folder / "checkpoints/last/pretrained_model/config.json").read_text())
        workspace = ur(robot).need(Arm).workspace
        view = scene_camera(workspace)
        assert saved["camera_position"] == list(view.position)
        assert saved["camera_target"] == list(view.target)
        assert saved["area"] == [*workspace.table[0], *workspace.table[1]]
        assert saved["scale"] == workspace.handling.scale


def test_without_a_task_that_tells_anything_the_brain_is_recorded(run: Path, tmp_path: Path) -> None:
    root = tmp_path / "episodes"
    brain = {"brain__type": "language", "brain__perception__path": str(run)}
    run_record(root, **ARM, **CAMERA, **brain, dataset__num_episodes=2, dataset__episode_time_s=1, n_envs=2)
    info = json.loads((root / "meta/info.json").read_text())
    assert info["total_episodes"] == 2


@each_case(
    ("robot", "message"),
    [
        ({"robot__camera": None}, "There is: none"),
        ({"robot__camera_height": 48}, "images of 96 x 72 px; .* 96 x 48"),
        (
            {"robot__type": "ur3e"},
            "tables of a ur5, where table and camera stand elsewhere than before a ur3e",
        ),
    ],
)
def test_a_recording_that_it_cannot_see_in_makes_no_dataset(run, tmp_path, robot, message):
    root = tmp_path / "episodes"
    brain = {"brain__type": "language", "brain__perception__path": str(run)}
    with pytest.raises(ConfigError, match=message):
        run_record(root, **(ARM | CAMERA | robot), **brain, dataset__num_episodes=1)
    assert not root.exists()


def images(value: Any = None, height: int = HEIGHT, width: int = WIDTH, camera: str = "scene") -> dict[str, np.ndarray]:
    one = np.random.default_rng(0).integers(0, 255, (1, height, width, 3), np.uint8)
    if value is not None:
        one[:] = value
    return {camera: one}


@each_case(
    ("given", "kind", "message"),
    [
        (images(camera="front"), ConfigError, r"looks through the camera 'scene', .* There is: front. Set --robot.cam"),
        (images(0), PerceptionError, "the camera 'scene' shows nothing"),
        (images(200), PerceptionError, "shows nothing"),
        (images((10, 90, 200)), PerceptionError, "shows nothing"),
    ],
)
def test_images_that_it_cannot_use(run: Path, given: dict[str, np.ndarray], kind: type, message: str) -> None:
    with pytest.raises(kind, match=message):
        Perceiver(PerceptionOptions(str(run))).look(given, 0)


def test_checkpoints_that_are_none(run: Path, tmp_path: Path) -> None:
    for options, message in (
        (PerceptionOptions(str(tmp_path / "none")), "does not exist"),
        (PerceptionOptions(str(run), device="cuda:7"), r"brain.perception.device is 'cuda:7'"),
    ):
        with pytest.raises(ConfigError, match=message):
            Perceiver(options)
    with pytest.raises(ConfigError, match=r"a 'bhd_mlp'; perception is a 'bhd_perception'.*--brain.path"):
        Perceiver(PerceptionOptions(str(save_policy(tmp_path / "mlp"))))
    broken = tmp_path / "broken"
    shutil.copytree(run / "checkpoints/last/pretrained_model", broken)
    weights = load_file(broken / "model.safetensors")
    weights["network.stem.0.0.weight"][...] = math.nan
    save_file(weights, broken / "model.safetensors")
    with pytest.raises(ConfigError, match="returns values that are not finite"):
        Perceiver(PerceptionOptions(str(broken))).look(images(), 0)
    (broken / "model.safetensors").rename(broken / "adapter_model.safetensors")
    with pytest.raises(ConfigError, match="cannot be loaded"):
        Perceiver(PerceptionOptions(str(broken)))
    with pytest.raises(ConfigError, match=r"gives no 'action'; it gives observation.environment_state"):
        load_policy(run / "checkpoints/last/pretrained_model")


def test_datasets_that_do_not_show_or_do_not_say_what_is_there(looks: Path, tmp_path: Path) -> None:
    with pytest.raises((ConfigError, DatasetError), match=r"(?s)policy.camera is 'top'.*observation.images.scene"):
        train(looks, tmp_path / "other", **{"policy.camera": "top"})
    root = make_dataset(tmp_path / "data")
    with pytest.raises((ConfigError, DatasetError), match="true poses of objects"):
        train(root, tmp_path / "run")
    for option, value, name in (
        ("task__sensing__noise_m", 0.01, "sensing.noise_m"),
        ("task__randomisation__camera_error_m", "[0.03,0,0]", "randomisation.camera_error_m"),
    ):
        told = tmp_path / name
        wrong = {option: value, "task__randomisation__enabled": "true", "dataset__num_episodes": 1, "n_envs": 1}
        look(told, **wrong)
        with pytest.raises(DatasetError, match=rf"recorded with task\.{name} = .*would learn them"):
            train(told, tmp_path / "run")
    noisy = tmp_path / "sensing.noise_m"
    merge([looks, noisy], tmp_path / "merged")
    with pytest.raises(DatasetError, match=r"recorded with task\.sensing\.noise_m = several values"):
        train(tmp_path / "merged", tmp_path / "run")


def test_without_held_out_episodes_the_checkpoint_refuses_to_see(looks: Path, tmp_path: Path) -> None:
    train(looks, tmp_path / "run", **{"dataset.eval_split": 0.0, "eval_steps": 0, "steps": 2})
    with pytest.raises(ConfigError, match="has no estimate of its errors"):
        Perceiver(PerceptionOptions(str(tmp_path / "run"))).look(images(), 0)


def test_a_brain_is_made_from_its_options(run: Path) -> None:
    brain = parse(
        EvalConfig,
        [
            "--config_path=configs/eval/ur5_pick.yaml",
            f"--brains.language.perception.path={run}",
            "--brains.deaf.type=blanked",
            "--brains.deaf.instruction=true",
            "--brains.deaf.brain.type=language",
            f"--brains.deaf.brain.perception.path={run}",
        ],
    ).brains
    for name in ("language", "deaf"):
        assert make_brain(brain[name]).uses_images
