"""A checkpoint is data: whatever its files name, loading it runs no code of its choice."""

import collections
import fractions
import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.processor import PolicyProcessorPipeline

from bhd_lerobot.cli import evaluate, record, train
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.checkpoint_guard import PROCESSOR_FILES, check_checkpoint
from bhd_lerobot.training.rl.parts import _from_checkpoint
from tests.policies.learned import rig
from tests.training.support import MLP, make_dataset, options, run_train

COUNTER = "collections.Counter"  # a class that is none of LeRobot's; it counts how often it was made
STEPS: list[dict[str, Any]] = [
    {"class": COUNTER, "config": {}},
    {"class": "fractions.Fraction", "config": {"numerator": 1}},
    {"class": "builtins.dict", "config": {}},
    # in LeRobot, but no step; and by way of a module that LeRobot imports
    {"class": "lerobot.utils.utils.cycle", "config": {"iterable": []}},
    {"class": "lerobot.processor.pipeline.Path", "config": {}},
    {"class": "lerobot..processor.pipeline.Path", "config": {}},
    {"class": "lerobot_elsewhere.Counter", "config": {}},
    {"class": "bhd_lerobot.rollout.provenance.Path", "config": {}},
    {"class": "Counter", "config": {}},
    {"class": ["collections", "Counter"], "config": {}},
    {"registry_name": COUNTER, "config": {}},
    {"registry_name": None, "class": COUNTER, "config": {}},
    {"config": {}},
]
"""Steps that are no steps: of Python's own classes, and by names that would be looked up in another way."""


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return what is filled whenever one of the classes is called."""
    calls: list[str] = []

    def call(name: str, **config: Any) -> None:
        calls.append(name)

    for module, name in ((collections, "Counter"), (fractions, "Fraction")):
        monkeypatch.setattr(module, name, partial(call, name))
    return calls


def plant(folder: Path, step: dict[str, Any], name: str = PROCESSOR_FILES[0], place: int = 0) -> None:
    """Insert a step into a checkpoint's processors."""
    pipeline = json.loads((folder / name).read_text())
    pipeline["steps"].insert(place, step)
    (folder / name).write_text(json.dumps(pipeline))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig.save_policy(tmp_path_factory.mktemp("policies") / "mlp")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "policy"))


def test_a_step_that_is_no_step_is_not_called(original: Path, tmp_path: Path, made: list[str]) -> None:
    for number, step in enumerate(STEPS):
        for name in PROCESSOR_FILES if number == 0 else PROCESSOR_FILES[:1]:
            folder = Path(shutil.copytree(original, tmp_path / f"{number}_{name}"))
            plant(folder, step, name, place=-1)
            with pytest.raises(ConfigError) as error:
                rig.make_brain(folder)
            asked = step.get("registry_name") if "registry_name" in step else step.get("class")
            parts = (name, repr(asked), "lerobot", "registered", "lerobot_policy_", "who made it")
            assert [part for part in parts if part not in str(error.value)] == []
            assert not made


def test_lerobots_own_loader_would_have_called_it(folder: Path, made: list[str]) -> None:
    # If this fails, LeRobot checks it itself and the guard may go.
    plant(folder, STEPS[0])
    with pytest.raises(TypeError):  # looked at after the call
        PolicyProcessorPipeline.from_pretrained(folder, PROCESSOR_FILES[0])
    assert made == ["Counter"]


def test_no_command_that_takes_a_checkpoint_calls_it(folder, tmp_path, capfd):
    data, run = make_dataset(tmp_path / "set", episodes=2), tmp_path / "run"
    run_train(options(data, run, MLP, steps=2, save_freq=2))
    plant(run / "checkpoints" / "000002" / "pretrained_model", STEPS[0])
    plant(folder, STEPS[0])
    robot = ["--robot.type=turtlebot3", "--robot.beams=12", "--task.type=navigate"]
    brain = [*robot, "--brain.type=learned", f"--brain.path={folder}"]
    dataset = ["--dataset.repo_id=a/b", f"--dataset.root={tmp_path / 'new'}", "--dataset.num_episodes=1"]
    commands: list[tuple[Any, list[str]]] = [
        (record.main, [*brain, *dataset, f"--output_dir={tmp_path / 'record'}"]),
        (evaluate.main, [*brain, "--n_episodes=1", f"--output_dir={tmp_path / 'eval'}"]),
        (train.main, options(data, tmp_path / "fine", {"fine_tune": run})),
        (train.main, options(data, tmp_path / "path", {"policy.path": run})),
        (train.main, options(data, tmp_path / "pretrained", {**MLP, "policy.pretrained_path": run})),
        (train.main, ["--resume=true", f"--config_path={run}", "--steps=4"]),
    ]
    for main, arguments in commands:
        assert main(arguments) != 0, arguments
        assert f"'{COUNTER}', which is not loaded" in " ".join(capfd.readouterr().err.split())
    with pytest.raises(ConfigError, match=r"collections\.Counter"):
        _from_checkpoint(str(folder), rig.PolicyContract())


def test_files_that_are_no_files_and_names_that_lead_elsewhere(original: Path, tmp_path: Path) -> None:
    def refused(folder: Path) -> str:
        with pytest.raises(ConfigError) as error:
            check_checkpoint(folder)
        return str(error.value)

    for number, name in enumerate(("config.json", *PROCESSOR_FILES)):
        for kind in ("folder", "dangling", "list", "deep"):
            folder = Path(shutil.copytree(original, tmp_path / f"{number}_{kind}"))
            (folder / name).unlink()
            if kind == "folder":
                (folder / name).mkdir()
            elif kind == "dangling":
                (folder / name).symlink_to(tmp_path / "nowhere")
            else:
                (folder / name).write_text("[" * 100_000 if kind == "deep" else "[]")
            assert name in refused(folder)
    for state in ("/elsewhere/state.safetensors", "../outside.safetensors", "", "..", 3, ["x"]):
        folder = Path(shutil.copytree(original, tmp_path / f"state_{state!s:.1}{len(str(state))}", dirs_exist_ok=True))
        plant(folder, {"registry_name": "to_batch_processor", "state_file": state})
        assert repr(state) in refused(folder)


def test_code_beside_a_further_model_is_not_run(original: Path, tmp_path: Path) -> None:
    # LeRobot loads these with trust_remote_code; only the names that it has there itself are let through.
    for key in ("action_tokenizer_name", "paligemma_tokenizer_name", "model_name", "vlm_name", "pretrained_path"):
        folder = Path(shutil.copytree(original, tmp_path / key))
        plant(folder, {"registry_name": "action_tokenizer_processor", "config": {key: "someone/else"}})
        with pytest.raises(ConfigError, match=r"'someone/else'.*who made it"):
            check_checkpoint(folder)
    good = {"action_tokenizer_name": "physical-intelligence/fast"}
    folder = Path(shutil.copytree(original, tmp_path / "good"))
    plant(folder, {"registry_name": "action_tokenizer_processor", "config": good})
    check_checkpoint(folder)
    for kind, key in (("pi0_fast", "text_tokenizer_name"), ("gaussian_actor", "vision_encoder_name")):
        config = json.loads((original / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, "type": kind, key: "./beside"}))
        with pytest.raises(ConfigError, match=rf"\./beside.* as {key}"):
            check_checkpoint(folder)


PLUGIN = {
    "configuration_visitor.py": """
from dataclasses import dataclass
from lerobot.configs import PreTrainedConfig
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig

@PreTrainedConfig.register_subclass("visitor")
@dataclass
class VisitorConfig(MlpConfig):
    pass
""",
    "modeling_visitor.py": """
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy
from lerobot_policy_visitor.configuration_visitor import VisitorConfig

class VisitorPolicy(MlpPolicy):
    config_class = VisitorConfig
    name = "visitor"
""",
    "processor_visitor.py": """
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry

class Plain(ObservationProcessorStep):
    def observation(self, observation): return observation
    def transform_features(self, features): return features

@ProcessorStepRegistry.register("visitor_step")
class Registered(Plain):
    pass
""",
    "__init__.py": "import lerobot_policy_visitor.configuration_visitor",
}


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install a plug-in of LeRobot with a policy and steps of its own."""
    package, told = tmp_path / "site" / "lerobot_policy_visitor", tmp_path / "site" / "lerobot_policy_visitor.dist-info"
    package.mkdir(parents=True)
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_policy_visitor\nVersion: 1.0\n")
    for name, text in PLUGIN.items():
        (package / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    yield
    PreTrainedConfig._choice_registry.pop("visitor", None)


@pytest.mark.usefixtures("plugin")
def test_an_installed_plugin_brings_policies_and_steps(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "type": "visitor"}))
    plant(folder, {"class": "lerobot_policy_visitor.processor_visitor.Plain", "config": {}})
    plant(folder, {"registry_name": "visitor_step", "config": {}})
    plant(folder, {"class": "lerobot.processor.batch_processor.AddBatchDimensionObservationStep", "config": {}})
    brain = rig.make_brain(folder)
    assert brain.loaded.kind == "visitor"
    assert [type(step).__name__ for step in brain.loaded.before.steps[1:3]] == ["Registered", "Plain"]
