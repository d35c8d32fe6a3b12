"""`bhd_perception`: it learns, knows how much it errs, and refuses what it was not made for."""

import copy
import math

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from bhd_lerobot.bodies.tabletop import COLOURS, SCENE_CAMERA, CameraView
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.manipulation.grasp import read_objects
from bhd_lerobot.policies.manipulation.skills import scene_object
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.policies.perception.configuration_perception import LABELS, PerceptionConfig
from bhd_lerobot.policies.perception.labels import Labels
from bhd_lerobot.policies.perception.modeling_perception import PerceptionPolicy, box_yaw
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.policies.perception.rig import FEATURES, HEIGHT, IMAGE, WIDTH, config, painted, states

STEPS = 120


def batch(count: int = 16) -> dict[str, Tensor]:
    values = states(count)
    return {IMAGE: painted(values), OBS_ENV_STATE: torch.from_numpy(values).float()}


@pytest.fixture(scope="module")
def trained() -> PerceptionPolicy:
    """A small network that learned from painted images, and was calibrated on others."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    policy = PerceptionPolicy(config(channels=16, hidden=16, context=8))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), 1e-2)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    values = states(500, max_objects=2)
    images, labels = painted(values), torch.from_numpy(values).float()
    policy.train()
    for step in range(STEPS):
        rows = torch.arange(step * 8, step * 8 + 8) % 300
        loss, _ = policy.forward({IMAGE: images[rows], OBS_ENV_STATE: labels[rows]})
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 5.0)
        optimizer.step()
        scheduler.step()
    policy.eval()
    with torch.no_grad():
        policy.forward({IMAGE: images[300:400], OBS_ENV_STATE: labels[300:400]})
    return policy


def test_labels_are_what_the_brain_that_knows_the_truth_reads() -> None:
    values = states(20, randomisation=RandomisationConfig(enabled=True))
    labels = Labels.of(torch.from_numpy(values))
    for row, table in enumerate(values):
        true = read_objects(table.reshape(-1, 16))
        assert [one.index for one in true] == labels.present[row].nonzero()[:, 0].tolist()
        for one in true:
            assert labels.position[row, one.index].tolist() == list(one.position)
            assert labels.size[row, one.index].tolist() == list(one.size)
            assert float(labels.yaw[row, one.index]) == pytest.approx(one.yaw)
            assert bool(labels.is_box[row, one.index]) == (one.kind == "box")
            assert list(COLOURS)[int(labels.colour[row, one.index])] == scene_object(one).colour


def test_it_finds_what_it_was_not_shown_and_states_errors_as_large_as_its_errors(trained: PerceptionPolicy) -> None:
    values = states(500, max_objects=2)[400:]
    errors, objects, inside, looked = [], 0, 0, 0
    for table, found in zip(values, trained.detect(painted(values)), strict=True):
        true = np.array([one.position[:2] for one in read_objects(table.reshape(-1, 16))])
        apart = np.hypot(*np.moveaxis(true[:, None] - found.position[:, :2].numpy(), -1, 0))  # (objects, found)
        objects += len(true)
        errors += [row.min() for row in apart if len(row) and row.min() < 0.04]
        looked += apart.shape[1]
        inside += (apart.min(axis=0) <= 3.8897 * found.scale.numpy()).sum()
    assert len(errors) > 0.85 * objects
    assert np.median(errors) < 0.02
    assert inside / looked == pytest.approx(0.9, abs=0.12)


def test_a_new_look_at_held_out_images_replaces_the_calibration(trained: PerceptionPolicy) -> None:
    before = float(trained.factor)
    given = batch(40)
    with torch.no_grad():
        trained.forward(given)
        added = float(trained.factor)
        trained.train()
        trained.forward(given)  # a step of training: what was measured before it is of another network
        trained.eval()
        trained.forward(given)
        alone = float(trained.factor)
        trained.factor.fill_(before)
    assert before > 0
    assert len({before, added, alone}) == 3


def test_a_quarter_of_a_turn_is_all_that_the_yaw_of_a_square_can_be_wrong_by() -> None:
    yaws = torch.linspace(-1.5, 1.5, 61)
    # By how much the double angle is wrong [rad]; how long its cosine and sine are does not matter.
    for off in (-2.9, -1.4, -0.5, 0.0, 0.9, 1.5, 2.5):
        double, fourfold = 2 * yaws + off, 4 * yaws
        answers = torch.stack([0.1 * double.cos(), 0.1 * double.sin(), 2 * fourfold.cos(), 2 * fourfold.sin()], dim=1)
        found = box_yaw(answers)
        assert (found.abs() <= math.pi / 2 + 1e-5).all()
        error = torch.remainder(found - yaws + math.pi / 4, math.pi) - math.pi / 4
        wanted = 0.0 if abs(off) < math.pi / 2 else math.pi / 2
        assert torch.allclose(error, torch.full_like(error, wanted), atol=1e-4)


@pytest.mark.thorough
def test_an_image_without_objects_is_learned_from_and_nothing_is_found_twice(trained: PerceptionPolicy) -> None:
    loss, _ = (
        PerceptionPolicy(config())
        .train()
        .forward({IMAGE: torch.full((2, 3, HEIGHT, WIDTH), 0.6), OBS_ENV_STATE: torch.zeros(2, len(LABELS))})
    )
    assert bool(torch.isfinite(loss))
    for found in trained.detect(painted(states(40))):
        apart = torch.cdist(found.position[:, :2], found.position[:, :2]) + torch.eye(len(found.presence))
        assert not len(apart) or float(apart.min()) > 0.02


def test_images_of_another_size_and_calls_for_actions(trained: PerceptionPolicy) -> None:
    with pytest.raises(ConfigError, match=r"images of 160 x 120 px; .* has the shape \(3, 60, 80\)"):
        trained.detect(torch.zeros(1, 3, 60, 80))
    with pytest.raises(ConfigError, match="not in the batch"):
        trained.forward({OBS_ENV_STATE: torch.zeros(1, 80)})
    with pytest.raises(ConfigError, match=r"gives no actions\. Use it in a brain"):
        trained.select_action({})


def test_a_training_that_goes_on_still_knows_what_it_learns() -> None:
    again = config()
    PerceptionPolicy(again)
    again.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}  # as LeRobot's `make_policy` leaves it
    again.set_dataset_feature_metadata(FEATURES)
    assert set(PerceptionPolicy(again).config.output_features or {}) == {OBS_ENV_STATE}


def test_what_has_other_colours_teaches_shapes_and_places_but_no_colours() -> None:
    policy, samples = PerceptionPolicy(config(recolour=0.999)), batch()
    policy.train()
    _, parts = policy.forward(samples)
    assert parts["colour"] == 0.0
    assert min(parts[name] for name in ("presence", "is_box", "size", "yaw")) > 0
    policy.eval()
    assert policy.forward(samples)[1]["colour"] > 0


def test_other_shades_of_a_colour_still_have_its_name_and_grey_stays_grey() -> None:
    policy = PerceptionPolicy(PerceptionConfig(input_features=config().input_features)).train()
    policy.config.recolour = policy.config.brightness = 0.0
    assert policy.config.tint > 0
    palette = torch.tensor(list(COLOURS.values()))
    own = torch.arange(len(palette)).repeat(500)
    grey = torch.linspace(0, 1, len(own))[:, None].expand(-1, 3)
    pixels = torch.stack([palette[own], grey], dim=1)  # (images, 2, 3)
    image, is_true = policy._varied(pixels.movedim(1, 2)[..., None])
    shades, greys = image[..., 0].movedim(2, 1).unbind(1)
    assert is_true.all()
    assert torch.allclose(greys, grey, atol=1e-5)
    assert (torch.cdist(shades, palette).argmin(1) == own).float().mean() > 0.99
    coloured = palette.std(1)[own] > 0.1
    apart = (shades - palette[own]).abs().max(1).values[coloured]
    assert apart.median() > 0.03
    assert apart.max() < 0.35


def test_a_step_of_training_forgets_how_large_errors_were_before(trained: PerceptionPolicy) -> None:
    policy, samples = copy.deepcopy(trained), batch()
    policy.detect(samples[IMAGE])
    policy.train()
    policy.config.recolour = policy.config.zoom = 0.5
    with torch.autocast("cpu", torch.bfloat16):  # `policy.use_amp`
        policy.forward(samples)[0].backward()
    with pytest.raises(ConfigError, match="has no estimate of its errors"):
        policy.detect(samples[IMAGE])


def test_larger_images_show_objects_where_their_labels_say() -> None:
    policy = PerceptionPolicy(config(zoom=0.5))
    left, top, right, bottom = policy.config.region
    labels = Labels.of(torch.from_numpy(states(64, max_objects=1, min_objects=1)).float().repeat(8, 1))
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)

    def spots(pixels: np.ndarray) -> Tensor:
        apart = (column - pixels[:, :1, None]) ** 2 + (row - pixels[:, 1:, None]) ** 2
        return torch.from_numpy(np.exp(-apart / 8)).float()[:, None].expand(-1, 3, -1, -1)

    def shown(of: Labels) -> np.ndarray:
        at: np.ndarray = policy.config.projection.pixels(of.position[:, 0].numpy().astype(np.float64))
        return at

    close, zoomed, is_placed = policy._zoomed(spots(shown(labels)), labels)
    where = close[:, 0].flatten(1).argmax(1).numpy()
    found = np.stack([left + where % (right - left), top + where // (right - left)], axis=-1) + 0.5
    wanted = shown(zoomed)
    inside = ((wanted > (left + 2, top + 2)) & (wanted < (right - 2, bottom - 2))).all(1)
    assert inside.mean() > 0.6
    assert np.linalg.norm(found - wanted, axis=1)[inside].max() < 2.5
    elsewhere = np.hypot(
        column[top:bottom, left:right] - wanted[:, :1, None], row[top:bottom, left:right] - wanted[:, 1:, None]
    )
    assert close[:, 0][torch.from_numpy(elsewhere > 10)].max() < 0.5  # nothing is shown twice
    larger = zoomed.size[:, 0, 0] / labels.size[:, 0, 0]
    assert torch.equal(is_placed, larger == 1)
    assert 0.4 < float((larger != 1).float().mean()) < 0.8
    assert float(larger.min()) < 0.65
    assert float(larger.max()) > 1.25


def test_what_is_learned_of_colours_is_nothing_of_kinds_and_the_other_way_round() -> None:
    policy, samples = PerceptionPolicy(config()).train(), batch()
    _, answers = policy.look(samples[IMAGE])
    moved = {}
    for name, part in answers.items():
        grads = torch.autograd.grad(part.sum(), list(policy.parameters()), retain_graph=True, allow_unused=True)
        named = zip(policy.named_parameters(), grads, strict=True)
        moved[name] = {one for (one, _), grad in named if grad is not None and grad.abs().sum() > 0}
    others = set().union(*(moved[name] for name in answers if name != "colour"))
    assert moved["colour"]
    assert others
    assert not moved["colour"] & others


MOVED = CameraView((1.24, -0.63, 0.80), (0.42, -0.03, 0.12), SCENE_CAMERA.fovy, 0.04)


def errors(policy: PerceptionPolicy, samples: dict[str, torch.Tensor]) -> float:
    """Return the mean error of what is said near objects [mm]."""
    policy.eval()
    with torch.no_grad():
        return policy.forward(samples)[1]["error_mm"]


@pytest.mark.thorough
def test_tables_before_a_moved_camera_bring_back_what_the_move_cost(trained: PerceptionPolicy) -> None:
    policy, values = copy.deepcopy(trained), states(540, max_objects=2)[500:]
    labels = torch.from_numpy(values).float()
    moved = painted(values, MOVED)
    held_out = {IMAGE: moved[20:], OBS_ENV_STATE: labels[20:]}
    original = errors(policy, {IMAGE: painted(values[20:]), OBS_ENV_STATE: labels[20:]})
    lost = errors(policy, held_out)
    said = policy.fit_camera([{IMAGE: moved[:20], OBS_ENV_STATE: labels[:20]}])
    found = errors(policy, held_out)
    assert lost > 2 * original
    assert (lost - found) / (lost - original) > 0.8
    assert "was moved by" in said
    places = np.random.default_rng(0).uniform((0.35, -0.3, 0.02), (0.65, 0.3, 0.1), (50, 3))
    apart = policy.config.projection.pixels(places) - Projection(MOVED, WIDTH, HEIGHT).pixels(places)
    assert math.sqrt((apart**2).sum(axis=1).mean()) < 2.0
    # What is saved says so, and what is made of it looks from there.
    again = PerceptionPolicy(policy.config)
    assert torch.equal(again._plane, policy._plane)
    assert again.network._region == policy.network._region


def test_too_few_objects_are_no_reason_to_move_a_camera(trained: PerceptionPolicy) -> None:
    policy, values = copy.deepcopy(trained), states(1, max_objects=1)
    before = policy.config.view
    with pytest.raises(ConfigError, match=r"were seen; .* 12 are needed. Record more tables"):
        policy.fit_camera([{IMAGE: painted(values), OBS_ENV_STATE: torch.from_numpy(values).float()}])
    assert policy.config.view == before


def test_images_of_any_size_are_looked_at() -> None:
    for width, height in ((96, 72), (97, 73), (129, 97), (161, 120), (320, 240)):
        one = config()
        one.input_features[IMAGE] = PolicyFeature(FeatureType.VISUAL, (3, height, width))
        features, answers = PerceptionPolicy(one).eval().look(torch.rand(2, 3, height, width))
        assert features.shape[2:] == answers["presence"].shape[1:]
