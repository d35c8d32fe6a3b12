"""`bhd_pixels`: it looks where the instruction points, once, and needs no truth to act."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.policy import load_policy
from bhd_lerobot.policies.perception.modeling_perception import PerceptionPolicy
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig
from bhd_lerobot.policies.pixels.modeling_pixels import PixelsPolicy
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from tests.cases import each_case
from tests.policies.perception.rig import HEIGHT, IMAGE, WIDTH, config, painted, save, states

CHUNK = 4
TABLES, STEPS = 3, 60
NAMES = {OBS_STATE: {"names": [f"joint.{which}" for which in (*"abcdefg", *["vel"] * 7)]}}


def made(**options: Any) -> PixelsConfig:
    own = {"hidden_dims": [32], "chunk_size": CHUNK, "n_action_steps": 2, "ignored_columns": list(range(7, 14))}
    one = config(PixelsConfig, **{**own, **options})
    assert isinstance(one, PixelsConfig)
    return one


def tokens(texts: list[str], of: PixelsConfig | None = None) -> Tensor:
    before, _ = make_pre_post_processors(of or made())
    return before({"task": texts, OBS_STATE: torch.zeros(len(texts), 14)})[OBS_LANGUAGE_TOKENS]


def batch(count: int = 8, **task: Any) -> dict[str, Tensor]:
    """Return samples to learn from: the first frame, and one that shows something else."""
    values = states(count, **task)
    scenes = [PickTask(PickConfig(**task), 1, 25).sample(seed) for seed in range(count)]
    first = painted(values)
    return {
        IMAGE: torch.stack([first, torch.rand_like(first)], dim=1),
        OBS_ENV_STATE: torch.from_numpy(values).float().unsqueeze(1).repeat(1, 2, 1),
        OBS_STATE: torch.randn(count, 2, 14),
        ACTION: torch.randn(count, CHUNK, 7),
        OBS_LANGUAGE_TOKENS: tokens([scene.instruction for scene in scenes]),
    }


def present(samples: dict[str, Tensor], frame: int = 0) -> dict[str, Tensor]:
    """Return what a robot would show: one frame, and no truth."""
    shown = {key: values[:, frame] for key, values in samples.items() if key in (IMAGE, OBS_STATE)}
    return {**shown, OBS_LANGUAGE_TOKENS: samples[OBS_LANGUAGE_TOKENS]}


def test_it_learns_to_look_at_what_is_named() -> None:
    policy = PixelsPolicy(made(freeze=False, pointing_weight=1.0, n_cells=10_000))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), 5e-3)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    task = {"min_objects": 2, "max_objects": 2}
    samples = batch(TABLES, **task)
    other = batch(TABLES, **task, swap=True)  # the same tables, and it is asked for the other object
    assert torch.equal(samples[IMAGE][:, 0].sum((2, 3)), other[IMAGE][:, 0].sum((2, 3)))
    both = {key: torch.cat([samples[key], other[key]]) for key in samples}
    policy.train()
    for _ in range(STEPS):
        loss, parts = policy.forward(both)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
    assert set(parts) == {"perception", "pointing", "action"}
    policy.eval()
    for asked in (samples, other):
        cells, where = policy._cells(asked[IMAGE][:, 0])
        _, attention = policy._see(cells, asked[OBS_LANGUAGE_TOKENS])
        cell = where[torch.arange(TABLES), attention.argmax(1)]
        columns = policy.perception._pixels.shape[1]
        pixel = policy.perception._pixels[cell // columns, cell % columns]
        table = asked[OBS_ENV_STATE][:, 0].reshape(TABLES, 5, 16)
        true = table[torch.arange(TABLES), table[..., 1].argmax(1), 3:6].double().numpy()
        apart = np.linalg.norm(policy.config.projection.pixels(true) - pixel.numpy(), axis=-1)
        assert np.all(apart < 8)


def test_what_is_fixed_is_neither_changed_nor_looked_at_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, samples = PixelsPolicy(made(perception="read before"), initialise=False), batch()
    before = {name: values.clone() for name, values in policy.state_dict().items()}
    looks: list[int] = []
    look = policy._look
    monkeypatch.setattr(policy, "_look", lambda image: looks.append(len(image)) or look(image))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), 1e-2)
    policy.train()
    first = policy.forward(samples)[0]
    again = policy.forward({key: values.flip(0) for key, values in samples.items()})[0]
    assert looks == [1] * 8
    assert torch.allclose(first, again, atol=1e-5)
    again.backward()
    optimizer.step()
    policy.eval()
    policy.forward(samples)
    assert looks == [*[1] * 8, 8], "what is held out is looked at afresh"
    changed = {
        name for name, values in policy.state_dict().items() if not torch.allclose(values, before[name], equal_nan=True)
    }
    assert not [name for name in changed if name.startswith("perception.")]
    assert {"reader.said.weight", "named.key.weight", "others.key.weight", "actor.0.weight"} <= changed
    # Without weights that were read, there is nothing to keep: it learns to see.
    assert all(one.requires_grad for one in PixelsPolicy(made()).perception.parameters())


@pytest.mark.law
def test_actions_behind_the_end_do_not_count() -> None:
    policy, samples = PixelsPolicy(made()).eval(), batch()
    padded = torch.zeros(8, CHUNK, dtype=torch.bool)
    padded[:, 2:] = True
    wild = {**samples, ACTION: samples[ACTION].masked_fill(padded.unsqueeze(-1), 1e6), "action_is_pad": padded}
    mild = {**samples, "action_is_pad": padded}
    assert torch.equal(policy.forward(wild)[0], policy.forward(mild)[0])
    assert policy.forward(samples)[0] != policy.forward(mild)[0]


def test_it_looks_at_the_first_image_only_and_says_what_it_learned_to_say() -> None:
    policy, samples = PixelsPolicy(made()).eval(), batch()
    chunk = policy.predict_action_chunk(present(samples))
    later = {**present(samples), IMAGE: torch.rand(8, 3, HEIGHT, WIDTH)}
    assert torch.equal(policy.predict_action_chunk(later), chunk)
    policy.reset()
    assert not torch.equal(policy.predict_action_chunk(later), chunk)
    # in training: the first image, and the present state
    policy.reset()
    policy.predict_action_chunk(present(samples))
    wanted = policy.predict_action_chunk({**present(samples, 1), IMAGE: later[IMAGE]})
    loss = policy.forward({**samples, ACTION: wanted})[1]
    assert loss["action"] == pytest.approx(0.0, abs=1e-6)


def test_it_acts_on_what_it_saw_alone_where_all_of_the_state_is_ignored() -> None:
    policy, samples = PixelsPolicy(made(ignored_columns=list(range(14)))).eval(), batch(2)
    assert torch.equal(policy.predict_action_chunk(present(samples)), policy.predict_action_chunk(present(samples, 1)))


def test_words_count_and_what_is_ignored_does_not() -> None:
    policy, samples = PixelsPolicy(made()).eval(), present(batch(2))

    def act(**changed: Tensor) -> Tensor:
        policy.reset()
        return policy.predict_action_chunk({**samples, **changed})

    same = {OBS_LANGUAGE_TOKENS: tokens(["take the red cup"] * 2)}
    upper = {OBS_LANGUAGE_TOKENS: tokens(["  Take the RED cup "] * 2)}
    assert torch.equal(act(**same), act(**upper))
    texts = ["take the red cup", "请抓起那个蓝色盒子"]  # the room behind them does not matter
    rooms = [{**samples, OBS_LANGUAGE_TOKENS: tokens(texts, made(longest_instruction=n))} for n in (40, 200)]
    assert torch.allclose(*map(policy.see, rooms), atol=1e-6)
    for other in ("take the red box", "拿起红色杯子", ""):
        assert not torch.equal(act(**same), act(**{OBS_LANGUAGE_TOKENS: tokens([other] * 2)}))
    fast = samples[OBS_STATE].clone()
    fast[:, 7:] += 5
    assert torch.equal(act(), act(**{OBS_STATE: fast}))
    fast[:, 0] += 1
    assert not torch.equal(act(), act(**{OBS_STATE: fast}))


def test_it_begins_with_a_perception_and_needs_it_no_more_afterwards(tmp_path: Path) -> None:
    eyes = PerceptionPolicy(config())
    path = save(tmp_path / "eyes", eyes)
    policy = PixelsPolicy(made(perception=str(path)))
    for name, values in eyes.network.state_dict().items():
        assert torch.equal(policy.perception.network.state_dict()[name], values)
    saved = save(tmp_path / "pixels", policy)
    for file in path.iterdir():
        file.unlink()
    path.rmdir()
    again = load_policy(saved)
    assert again.inputs == (IMAGE, OBS_STATE), "the truth is no input"
    assert again.cameras == {IMAGE: "scene"}
    samples = present(batch(2))
    assert torch.equal(again.policy.predict_action_chunk(samples), policy.eval().predict_action_chunk(samples))
    assert type(again.policy) is get_policy_class("bhd_pixels")


@each_case(
    ("options", "message"),
    [
        ({"camera_fovy": 50.0}, "whose camera_fovy is 48.0; here it is 50.0"),
        ({"hidden": 20}, "whose hidden is 12; here it is 20"),
    ],
)
def test_a_perception_of_something_else_is_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = save(tmp_path / "eyes", PerceptionPolicy(config()))
    with pytest.raises(ConfigError, match=message):
        PixelsPolicy(made(perception=str(path), **options))
    own = save(tmp_path / "pixels", PixelsPolicy(made()))
    with pytest.raises(ConfigError, match=r"is .*, a 'bhd_pixels'; perception is a 'bhd_perception'"):
        PixelsPolicy(made(perception=str(own)))


def test_an_instruction_is_needed_and_never_cut_off() -> None:
    before, _ = make_pre_post_processors(made(longest_instruction=16))
    with pytest.raises(ConfigError, match=r"takes 18 bytes; this bhd_pixels reads 16\. Shorten it"):
        before({"task": ["拿起红色杯"[:3] + "123456789"], OBS_STATE: torch.zeros(1, 14)})
    with pytest.raises(ConfigError, match=r"'\\udcff' is no text that UTF-8 can write"):
        before({"task": ["\udcff"], OBS_STATE: torch.zeros(1, 14)})
    with pytest.raises(ConfigError, match="the batch has none"):
        before({OBS_STATE: torch.zeros(1, 14)})
