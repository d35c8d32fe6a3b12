"""What a policy was trained on: written, read, found for other people's checkpoints, and checked."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.contract import CONTRACT_FILE, PolicyContract, find_checkpoint
from tests.cases import each_case

CONTRACT = PolicyContract(
    robot_type="turtlebot3",
    fps=10,
    observation_names=("x.vel", "theta.vel", "scan_000.pos"),
    action_names=("x.vel", "theta.vel"),
    environment_names=("goal_x", "goal_y"),
    cameras={"front": (240, 320, 3)},
    units="SI",
    task={"type": "avoid"},
    robot={"type": "turtlebot3", "fps": 10},
    dataset={"repo_id": "a/b", "root": "b", "episodes": 3, "frames": 90},
    trainer="bhd-train",
    versions={"torch": "1"},
)
INFO: dict[str, Any] = {
    "robot_type": "turtlebot3",
    "fps": 10,
    "total_episodes": 3,
    "total_frames": 90,
    "features": {
        "observation.state": {"dtype": "float32", "shape": [3], "names": ["x.vel", "theta.vel", "scan_000.pos"]},
        "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["x.vel", "theta.vel"]}},
        "observation.images.front": {
            "dtype": "video",
            "shape": [3, 240, 320],
            "names": ["channels", "height", "width"],
        },
    },
}


def make_checkpoint(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        (folder / name).write_text("{}")
    return folder


def make_dataset(root: Path) -> Path:
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(INFO))
    return root


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    folder = make_checkpoint(tmp_path / "model")
    file = CONTRACT.save(folder)
    assert file == folder / CONTRACT_FILE
    assert PolicyContract.load(folder) == CONTRACT
    assert CONTRACT.is_known
    assert [one.name for one in folder.iterdir() if one.name.startswith(".")] == []


def test_a_dataset_tells_everything(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data")
    (root / "meta" / "bhd.json").write_text(json.dumps({"recording": {"task": {"type": "avoid", "arena": "random"}}}))
    meta = SimpleNamespace(root=root, repo_id="me/data", info=SimpleNamespace(**INFO))
    contract = PolicyContract.from_dataset(meta, "bhd-train")
    assert replace(contract, versions={}) == PolicyContract(
        robot_type="turtlebot3",
        fps=10,
        observation_names=("x.vel", "theta.vel", "scan_000.pos"),
        action_names=("x.vel", "theta.vel"),
        environment_names=(),
        cameras={"front": (240, 320, 3)},
        units="SI",
        task={"type": "avoid", "arena": "random"},
        dataset={"repo_id": "me/data", "root": "data", "episodes": 3, "frames": 90},
        trainer="bhd-train",
    )
    assert set(contract.versions) == {"bhd_lerobot", "lerobot", "torch", "numpy"}


def test_a_stock_checkpoint_asks_the_dataset_that_it_names(tmp_path: Path) -> None:
    root, folder = make_dataset(tmp_path / "data"), make_checkpoint(tmp_path / "model")
    (folder / "train_config.json").write_text(json.dumps({"dataset": {"repo_id": "me/data", "root": str(root)}}))
    contract = PolicyContract.load(folder)
    assert contract.observation_names == ("x.vel", "theta.vel", "scan_000.pos")
    assert (contract.robot_type, contract.trainer, contract.units) == ("turtlebot3", "lerobot-train", None)


@pytest.mark.parametrize("text", [None, "{", "{}", '{"dataset": {"repo_id": "me/gone", "root": null}}'])
def test_a_stock_checkpoint_without_its_dataset_is_not_known(tmp_path: Path, text: str | None) -> None:
    folder = make_checkpoint(tmp_path / "model")
    if text is not None:
        (folder / "train_config.json").write_text(text)
    assert not PolicyContract.load(folder).is_known


@each_case(
    "text",
    ["", "[]", '{"fps": 10', '{"format": 9}', '{"fps": "ten"}', '{"action_names": "x.vel"}', '{"cameras": {"a": [1]}}'],
)
def test_a_broken_contract_is_refused(tmp_path: Path, text: str) -> None:
    folder = make_checkpoint(tmp_path / "model")
    (folder / CONTRACT_FILE).write_text(text)
    with pytest.raises(ConfigError, match=r"bhd\.json cannot be read.*Copy the checkpoint again"):
        PolicyContract.load(folder)


def test_what_fits_is_accepted() -> None:
    c = CONTRACT
    c.check(c.observation_names, c.action_names, 10, c.environment_names, "turtlebot3", cameras=c.cameras)
    c.check()
    PolicyContract().check(("a",), ("b",), 3, ("c",), "ur5", cameras={})


@pytest.mark.law
@each_case(
    ("here", "parts"),
    [
        ({"robot_type": "ur5"}, ("'turtlebot3'", "'ur5'", "--robot.type=turtlebot3")),
        ({"fps": 25}, ("10 frames a second", "at 25", "--robot.fps=10")),
        (
            {"observation_names": ("theta.vel", "x.vel", "scan_000.pos")},
            ("observation", "another order", "column 0", "'x.vel' there", "'theta.vel' here", "'a/b'"),
        ),
        ({"observation_names": ("x.vel", "theta.vel")}, ("3 there and 2 here", "only there scan_000.pos")),
        ({"action_names": ("x.vel", "y.vel")}, ("action", "only there theta.vel", "only here y.vel")),
        ({"environment_names": ()}, ("environment", "goal_x, goal_y", "the same task")),
        ({"cameras": {}}, ("'front'", "none", "--robot.camera=true")),
        ({"cameras": {"front": (96, 96, 3)}}, ("320 x 240", "96 x 96", "--robot.camera_width=320")),
    ],
)
def test_what_does_not_fit_is_refused_with_both_sides_and_the_remedy(here: Any, parts: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as error:
        CONTRACT.check(**here, who="The policy X")
    assert [part for part in ("The policy X", *parts) if part not in str(error.value)] == []


MOCK = {"type": "mock_arm", "use_degrees": True, "cameras": {"front": {"color_mode": "rgb"}}, "log": ""}


@pytest.mark.parametrize("nested", [False, True])
def test_a_robot_whose_options_give_its_numbers_another_meaning_is_refused(nested: bool) -> None:
    def robot(**values: Any) -> dict[str, Any]:
        changed = {**MOCK, **values}
        return {"type": "two_arms", "left": changed} if nested else changed

    contract = replace(CONTRACT, robot=robot())
    contract.check(robot=robot(log="elsewhere", cameras={"front": {"color_mode": "bgr"}}))
    contract.check(robot={"type": "mock_arm"})
    contract.check(robot={**robot(use_degrees=False), "clock": "lockstep"})  # ours: SI units
    with pytest.raises(ConfigError, match=r"robot.(left.)?use_degrees was true there and is false here.*=true"):
        contract.check(robot=robot(use_degrees=False), who="The policy")


def test_a_checkpoint_is_found_from_every_folder_above_it(tmp_path: Path) -> None:
    run = tmp_path / "run"
    first = make_checkpoint(run / "checkpoints" / "000100" / "pretrained_model")
    second = make_checkpoint(run / "checkpoints" / "000900" / "pretrained_model")
    for path in (first, first.parent):
        assert find_checkpoint(path) == first
    # the newest, where the link is missing or leads nowhere
    assert find_checkpoint(run) == second
    (run / "checkpoints" / "last").symlink_to("004000")
    assert find_checkpoint(str(run)) == second
    (run / "checkpoints" / "last").unlink()
    (run / "checkpoints" / "last").symlink_to("000100")
    assert find_checkpoint(run).resolve() == first
    assert find_checkpoint(run / "checkpoints").resolve() == first


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the folder does not exist"):
        find_checkpoint(tmp_path / "nowhere")
    (tmp_path / "config.yaml").write_text("")
    with pytest.raises(ConfigError, match=r"neither config\.json.*There is: config\.yaml.*has not saved yet"):
        find_checkpoint(tmp_path)
    with pytest.raises(ConfigError, match="is a file; name the folder"):
        find_checkpoint(tmp_path / "config.yaml")
    for missing in ("config.json", "model.safetensors"):
        folder = make_checkpoint(tmp_path / missing / "pretrained_model")
        (folder / missing).unlink()
        with pytest.raises(ConfigError, match=f"not complete: {missing} missing"):
            find_checkpoint(folder.parent)


def test_a_hub_id_without_the_network_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'nobody/nothing'.*no such folder.*Check the name, your login"):
        find_checkpoint("nobody/nothing")
