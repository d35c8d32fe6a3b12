"""The learned brain: LeRobot's own actions to the bit, and episodes that do not feel each other."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Chunk
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.learned.brain import LearnedBrain
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.learned.inference import StockInference
from tests.policies.learned.rig import (
    ACTIONS,
    ENVIRONMENT,
    FPS,
    IMAGE,
    INSTRUCTION,
    KINDS,
    STATE,
    Stock,
    make_brain,
    observations,
    save_policy,
)

FRAMES = 11


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("policies")
    return {kind: save_policy(folder / kind, kind) for kind in KINDS}


def drive(brain: LearnedBrain, seen: list[Observation], seeds: list[int]) -> NDArray[np.float64]:
    """Return the actions of one episode of every simulation, shape (frames, n, actions)."""
    brain.reset(np.arange(len(seeds)), seeds, len(seeds), [INSTRUCTION] * len(seeds))
    actions = []
    for one in seen:
        action = brain.act(one)
        assert isinstance(action, np.ndarray)
        actions.append(action)
    return np.array(actions)


@pytest.mark.parametrize("kind", ["mlp_history", "act_average", "diffusion", "mlp_sample", "pixels_image", "cnn_image"])
def test_any_policy_runs_as_copies_with_the_actions_of_lerobot(checkpoints: dict[str, Path], kind: str) -> None:
    brain, stock = make_brain(checkpoints[kind]), Stock(checkpoints[kind])
    brain.inference = StockInference(brain.loaded, threads=None)
    brain._history_length = 1
    seeds = [3, 4, 5]
    seen = list(observations(3, FRAMES))
    actions = drive(brain, seen, seeds)
    for sim, seed in enumerate(seeds):
        stock.reset(seed)
        wanted = np.array([stock.act(one, sim) for one in seen])
        assert np.array_equal(actions[:, sim], wanted.astype(np.float64))
    own, copy = brain.loaded.policy, brain.inference._policies[0]
    assert own is not copy
    assert all(a is b for a, b in zip(own.parameters(), copy.parameters(), strict=True))


def lacking(*arguments: Any) -> Any:
    raise NotImplementedError("It has chunks only.")


def test_the_chunks_of_a_policy_without_single_actions_are_carried_out(checkpoints: dict[str, Path]) -> None:
    brain, stock = make_brain(checkpoints["act"]), Stock(checkpoints["act"])
    brain.loaded.policy.select_action = lacking
    brain.inference = StockInference(brain.loaded, threads=None)
    for seeds in ([3, 4], [5, 6]):  # a second episode begins in the middle of the first one's chunk
        seen = list(observations(2, FRAMES, seeds[0]))
        actions = drive(brain, seen, seeds)
        for sim, seed in enumerate(seeds):
            stock.reset(seed)
            wanted = np.array([stock.act(one, sim) for one in seen])
            assert np.array_equal(actions[:, sim], wanted.astype(np.float64))


def test_a_policy_whose_chunks_need_more_than_an_observation_is_refused(checkpoints: dict[str, Path]) -> None:
    brain = make_brain(checkpoints["act"])
    brain.loaded.policy.select_action = lacking
    brain.loaded.policy.predict_action_chunk = lambda batch: batch["inference_action"]
    brain.inference = StockInference(brain.loaded, threads=None)
    with pytest.raises(ConfigError) as raised:
        drive(brain, list(observations(1, 1)), [0])
    for part in ("'act'", "It has chunks only.", "KeyError: 'inference_action'"):
        assert part in str(raised.value)


@pytest.mark.thorough(but=4)
@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_does_not_feel_the_others(checkpoints: dict[str, Path], kind: str) -> None:
    n, sim = 8, 5
    brain = make_brain(checkpoints[kind])
    together = drive(brain, list(observations(n, FRAMES)), list(range(n)))[:, sim]
    # the others see something else, begin anew in between, pause, and it is one of six
    mine = [(one.state[sim], one.environment_state[sim], one.images["front"][sim]) for one in observations(n, FRAMES)]
    brain.reset(np.arange(6), [90, sim, 92, 93, 94, 95], 6, [INSTRUCTION] * 6)
    other = []
    for frame, one in enumerate(observations(6, FRAMES, seed=99)):
        if frame in (2, 7):
            brain.reset(np.array([0, 3]), [100 + frame, 200 + frame], 6)
        one.state[1], one.environment_state[1], one.images["front"][1] = mine[frame]
        running = np.array([True, True, frame % 3 > 0, True, frame < 4, True])
        seen = Observation(one.names, one.state, one.images, one.environment_state, running=running)
        action = brain.act(seen)
        assert isinstance(action, np.ndarray)
        other.append(action[1])
    assert np.array_equal(together, np.array(other))


@pytest.mark.parametrize("kind", ["mlp_history", "act", "diffusion"])
def test_exact_means_the_same_bits_as_alone(checkpoints: dict[str, Path], kind: str) -> None:
    seen = list(observations(5, FRAMES))
    exact = drive(make_brain(checkpoints[kind], exact=True), seen, [0, 1, 2, 3, 4])
    batched = drive(make_brain(checkpoints[kind]), seen, [0, 1, 2, 3, 4])
    stock = Stock(checkpoints[kind])
    for sim in range(5):
        stock.reset(sim)
        assert np.array_equal(exact[:, sim], np.array([stock.act(one, sim) for one in seen], np.float64))
    assert batched == pytest.approx(exact, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("kind", ["mlp_sample", "diffusion"])
def test_what_is_random_follows_from_the_seed(checkpoints: dict[str, Path], kind: str) -> None:
    brain, seen = make_brain(checkpoints[kind]), list(observations(2, 4))
    first = drive(brain, seen, [1, 2])
    torch.manual_seed(12345)
    assert np.array_equal(first, drive(brain, seen, [1, 2]))
    state = torch.get_rng_state()
    assert not np.array_equal(first[:, 0], drive(brain, seen, [3, 2])[:, 0])
    assert torch.equal(state, torch.get_rng_state())  # nobody else's random numbers are used up


def test_sampling_is_off_unless_it_is_asked_for(tmp_path: Path) -> None:
    folder = save_policy(tmp_path / "gaussian", "mlp", gaussian=True)
    seen = list(observations(1, 4))
    mean = drive(make_brain(folder), seen, [1])
    assert np.array_equal(mean, drive(make_brain(folder), seen, [2]))
    sampled = drive(make_brain(folder, sample=True), seen, [1])
    assert not np.allclose(mean, sampled, atol=1e-3)


@pytest.mark.parametrize(("kind", "own"), [("mlp", 3), ("act", 3), ("diffusion", 3)])
def test_it_looks_again_after_n_action_steps(checkpoints: dict[str, Path], kind: str, own: int) -> None:
    for asked, steps in ((None, own), (2, 2), (1, 1)):
        brain, calls = make_brain(checkpoints[kind], n_action_steps=asked), []
        infer = brain.inference.infer
        brain.inference.infer = lambda ids, rows, f=infer, c=calls: c.append(len(ids)) or f(ids, rows)  # type: ignore
        drive(brain, list(observations(4, 7)), [0, 1, 2, 3])
        assert calls == [4] * len(range(0, 7, steps))


def test_a_stream_is_the_same_actions_in_whole_chunks(checkpoints: dict[str, Path]) -> None:
    seen = list(observations(2, 9))
    single = drive(make_brain(checkpoints["mlp"]), seen, [0, 1])
    brain = make_brain(checkpoints["mlp"], stream=True)
    brain.reset(np.arange(2), [0, 1], 2)
    for frame, one in enumerate(seen):
        chunk = brain.act(one)
        if frame % 3:
            assert chunk is None
            continue
        assert isinstance(chunk, Chunk)
        assert chunk.actions.shape == (6, 2, len(ACTIONS))  # all that was predicted, in case that thinking takes long
        assert np.array_equal(chunk.actions[:3], single[frame : frame + 3])


def test_a_new_episode_beside_others_renews_what_is_left_of_their_chunks(checkpoints: dict[str, Path]) -> None:
    brain = make_brain(checkpoints["mlp"], stream=True)
    brain.reset(np.arange(2), [0, 1], 2)
    seen = list(observations(2, 2))
    first = brain.act(seen[0])
    brain.reset(np.array([1]), [7], 2)
    second = brain.act(seen[1])
    assert isinstance(first, Chunk)
    assert isinstance(second, Chunk)
    assert np.array_equal(second.actions[:5, 0], first.actions[1:, 0])
    assert not np.array_equal(second.actions[:5, 1], first.actions[1:, 1])


def test_torch_gets_its_threads_back(checkpoints: dict[str, Path]) -> None:
    torch.set_num_threads(2)
    drive(make_brain(checkpoints["mlp"]), list(observations(1, 2)), [0])
    assert torch.get_num_threads() == 2


def test_what_is_recorded_names_the_weights(checkpoints: dict[str, Path]) -> None:
    parameters = make_brain(checkpoints["mlp"]).parameters()
    assert parameters["weights"].startswith("sha256:")
    assert (parameters["type"], parameters["policy"], parameters["n_action_steps"]) == ("learned", "bhd_mlp", 3)
    assert parameters["weights"] != make_brain(checkpoints["act"]).parameters()["weights"]


@pytest.mark.parametrize(
    ("kind", "frames"), [("pixels_image", {0}), ("act_image", {0, 3, 6}), ("diffusion_image", set(range(8)))]
)
def test_images_that_it_does_not_look_at_need_not_be_there(checkpoints, kind, frames):
    brain, seen = make_brain(checkpoints[kind]), list(observations(3, 8))
    wanted = drive(brain, seen, [0, 1, 2])
    brain.reset(np.arange(3), [0, 1, 2], 3, [INSTRUCTION] * 3)
    running = np.array([True, True, False])  # the third begins later
    for frame, one in enumerate(seen):
        looks = brain.needs_images({})
        assert looks.tolist() == [frame in frames, frame in frames, True]
        images = one.images if frame in frames else {}
        action = brain.act(Observation(one.names, one.state, images, one.environment_state, running=running))
        assert np.array_equal(np.asarray(action)[:2], wanted[frame, :2])


@pytest.mark.law
@pytest.mark.parametrize("is_known", [True, False])
def test_images_of_cameras_that_its_training_data_lacked_are_not_asked_for(checkpoints, is_known):
    """LeRobot's vision-language-action policies make them up, as many as their `empty_cameras` says."""
    wanted = drive(make_brain(checkpoints["act_image"]), seen := list(observations(1, 4)), [0])
    brain = make_brain(checkpoints["act_image"])
    empty, brain.loaded.config.empty_cameras = "observation.images.empty_camera_0", 1
    cameras = {**brain.loaded.cameras, empty: "empty_camera_0"}
    brain.loaded = replace(brain.loaded, inputs=(*brain.loaded.inputs, empty), cameras=cameras)
    if not is_known:
        brain.contract = PolicyContract()
    brain.bind(RobotFeatures(STATE, ACTIONS, FPS, ENVIRONMENT, cameras={"front": IMAGE}))
    assert np.array_equal(drive(brain, seen, [0]), wanted)
    with pytest.raises(ConfigError, match="uses the camera 'front'"):
        brain.bind(RobotFeatures(STATE, ACTIONS, FPS, ENVIRONMENT, cameras={}))
