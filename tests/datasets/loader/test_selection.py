"""Which episodes and frames are learned from, and what a dataset must not lack."""

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from bhd_lerobot.datasets.loader import frame_cache
from bhd_lerobot.datasets.loader.loader import (
    EpisodeFilter,
    LoaderConfig,
    MemoryBudgetError,
    TableDataset,
    check,
    frame_weights,
    make_loader,
    split_episodes,
)
from bhd_lerobot.datasets.loader.table import open_metadata
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetCorruptError, DatasetError
from tests.cases import each_case
from tests.datasets.foreign import edit_json
from tests.datasets.loader import support
from tests.datasets.loader.support import FRONT, WRIST


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five episodes: success, success, collision, timeout, success."""
    return support.record_light(tmp_path_factory.mktemp("plain") / "d")


@pytest.fixture(scope="module")
def video_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return support.record_light(tmp_path_factory.mktemp("video_dataset") / "d", 2, (FRONT, WRIST))


@each_case(
    ("options", "wanted"),
    [
        ({}, [0, 1, 4]),
        ({"outcome": "all"}, [0, 1, 2, 3, 4]),
        ({"outcome": ["collision", "timeout"]}, [2, 3]),
        ({"min_score": 0.5}, [4]),
        ({"outcome": "all", "min_score": 0.25}, [1, 2, 3, 4]),
        ({"outcome": "all", "exclude_late": True}, [0, 1, 3, 4]),
    ],
)
def test_episodes_by_what_is_stored_about_them(plain: Path, options: dict[str, Any], wanted: list[int]) -> None:
    assert EpisodeFilter(**options).select(open_metadata(plain)) == wanted
    chosen = EpisodeFilter(**options).select(open_metadata(plain), [4, 3, 2])
    assert chosen == [episode for episode in wanted if episode >= 2]


def test_filters_of_what_was_not_recorded(stock: Path) -> None:
    meta = open_metadata(stock)
    with pytest.raises(DatasetError, match=r"has no bhd/outcome .* another program .* outcome 'all'"):
        EpisodeFilter().select(meta)
    assert EpisodeFilter("all").select(meta) == [0, 1, 2]


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_the_split_by_instruction_is_that_of_lerobot(plain: Path, share: float) -> None:
    from lerobot.configs.default import DatasetConfig
    from lerobot.datasets.factory import make_train_eval_datasets

    policy = SimpleNamespace(reward_delta_indices=None, action_delta_indices=[0, 1], observation_delta_indices=None)
    dataset = DatasetConfig("t/t", root=str(plain), eval_split=share, video_backend="pyav")
    config: Any = SimpleNamespace(dataset=dataset, trainable_config=policy, tolerance_s=1e-4, rename_map={})
    theirs = make_train_eval_datasets(config)
    ours = split_episodes(open_metadata(plain), None, share, "instruction")
    assert ours == tuple(dataset.episodes for dataset in theirs)
    assert split_episodes(open_metadata(plain), [3, 1], 0.0) == ([3, 1], [])


def described(instructions: list[str]) -> Any:
    """Metadata of a dataset with an episode of each of these instructions."""
    n, episodes = len(instructions), {"tasks": [[instruction] for instruction in instructions]}
    return SimpleNamespace(root=Path("toy"), total_episodes=n, total_frames=n, episodes=episodes)


@each_case("kinds", [1, 2, 7, 100])
@each_case("share", [0.01, 0.1, 0.25, 0.9])
def test_a_share_of_all_episodes_is_held_out(kinds: int, share: float) -> None:
    meta = described([f"pick object {i % kinds}" for i in range(100)])
    train, held_out = split_episodes(meta, None, share)
    assert sorted(train + held_out) == list(range(100))
    assert len(held_out) == math.ceil(100 * share)
    for kind in range(kinds):  # in proportion, and of each the last ones
        ours = [i for i in range(kind, 100, kinds) if i in held_out]
        assert abs(len(ours) - share * len(range(kind, 100, kinds))) < 1
        assert ours == list(range(kind, 100, kinds))[100 // kinds + (kind < 100 % kinds) - len(ours) :]
    assert (train, held_out) == split_episodes(meta, list(range(100)), share)
    if kinds == 1:
        assert (train, held_out) == split_episodes(meta, None, share, "instruction")
    if kinds == 100:  # no segment of the dataset is without
        gaps = np.diff([-1, *held_out, 100])
        assert gaps.max() <= math.ceil(1 / share)


def test_a_split_that_leaves_nothing(plain: Path) -> None:
    with pytest.raises(DatasetError, match=r"2 episodes have 2 different instructions.* hold_out to 'episode'"):
        split_episodes(open_metadata(plain), [0, 1], 0.1, "instruction")
    with pytest.raises(DatasetError, match="there are 1, and at least one is held out"):
        split_episodes(open_metadata(plain), [3], 0.1)


def test_interventions_are_weighted_or_dropped(plain: Path, stock: Path) -> None:
    meta = open_metadata(plain)
    place = sum(support.length(episode) for episode in (0, 1)) + 1
    weights = frame_weights(meta, None, intervention=3.0)
    assert weights is not None
    assert weights.tolist() == [3.0 if i == place else 1.0 for i in range(meta.total_frames)]
    assert frame_weights(meta, None) is None
    assert frame_weights(meta, [0, 1], intervention=0.0) is None  # nobody intervened there
    loader = make_loader("t/t", LoaderConfig(batch_size=8, intervention_weight=0.0), root=plain).train
    drawn = torch.cat([batch["index"] for batch in loader])
    assert sorted(drawn.tolist()) == [i for i in range(meta.total_frames) if i != place]
    with pytest.raises(DatasetError, match="no column 'event'"):
        frame_weights(open_metadata(stock), None, intervention=0.0)


@each_case(("intervention", "learner"), [(0.0, 1.0), (3.0, 1.0), (1.0, 0.5), (2.0, 0.0)])
def test_an_intervention_that_lasts_to_the_end_counts_to_the_end(
    tmp_path: Path, intervention: float, learner: float
) -> None:
    """The event of the last frame is what ended the episode, whoever drove; `bhd/interventions` says who did."""
    events, spans = [0, 0, 5, 5, 1], [[[2, 5, "no progress"]], [], None]
    features = {key: support.FEATURES[key] for key in ("action", "event")}
    with DatasetRecorder.create("t/t", 10, features, root=tmp_path / "d", robot_type="r") as recorder:
        for driven in spans:
            writer = recorder.begin_episode()
            event = np.array(events if driven else [0, 0, 0, 0, 1])
            writer.set_columns({"action": np.zeros((5, 2), np.float32), "event": event})
            stored = "" if driven is None else json.dumps(driven)
            recorder.save(writer, task="t", metadata={"interventions": stored})
    weights = frame_weights(open_metadata(tmp_path / "d"), None, intervention=intervention, learner=learner)
    assert weights is not None
    assert weights.tolist() == [*[learner] * 2, *[intervention] * 3, *[learner] * 5, *[1.0] * 5]


def test_images_without_statistics_are_normalised_by_those_of_imagenet(video_dataset: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(video_dataset, tmp_path / "d"))
    edit_json(root / layout.STATS, lambda stats: stats.pop(FRONT))
    meta = make_loader("t/t", LoaderConfig(batch_size=2), root=root).dataset.meta
    assert meta.stats[FRONT]["mean"].flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])


@pytest.mark.law
def test_what_is_left_out_is_in_no_chunk_and_the_last_frame_of_an_intervention_is_one(tmp_path: Path) -> None:
    root, spans = support.record_light(tmp_path / "set"), {0: [[1, 3, "x"]], 1: [], 3: [[4, 6 + 15 % 7, "x"]]}
    for path in root.glob("meta/episodes/*/*.parquet"):
        table = pq.read_table(path)
        stored = [json.dumps(spans[one]) if one in spans else None for one in table["episode_index"].to_pylist()]
        pq.write_table(table.append_column("bhd/interventions", pa.array(stored, pa.string())), path)
    meta = open_metadata(root)
    place = {one: int(meta.episodes["dataset_from_index"][one]) for one in range(5)}
    driven = {place[one] + frame for one in (0, 3) for first, end, _ in spans[one] for frame in range(first, end)}
    recorded = place[2] + 1  # of a recorder that stored no spans
    weights = frame_weights(meta, None, intervention=3.0)
    assert weights is not None
    assert set((weights == 3.0).nonzero()[:, 0].tolist()) == {*driven, recorded}
    options = {"batch_size": 8, "delta_timestamps": {"action": CHUNK, "observation.state": [-0.1, 0.0]}}
    plain = make_loader("t/t", LoaderConfig(**options), root=root).dataset
    for name in ("learner_weight", "intervention_weight"):
        loader = make_loader("t/t", LoaderConfig(**options, **{name: 0.0}), root=root).train
        weights = frame_weights(meta, None, **{name.removesuffix("_weight"): 0.0})
        assert weights is not None
        kept = set(weights.nonzero()[:, 0].tolist())
        for batch in loader:
            for row, index in enumerate(batch["index"].tolist()):
                whole = plain[index]
                assert torch.equal(batch["observation.state"][row], whole["observation.state"])
                end = next(
                    at for at in range(index, index + len(CHUNK) + 1) if at not in kept or at - index == len(CHUNK)
                )
                ours = ~whole["action_is_pad"] & (torch.arange(len(CHUNK)) < end - index)
                assert torch.equal(~batch["action_is_pad"][row], ours)
                assert torch.equal(batch["action"][row][ours], whole["action"][ours])
                assert (batch["action"][row][~ours] == batch["action"][row][int(ours.sum()) - 1]).all()
    with pytest.raises(ConfigError, match=r"'action' is learned in chunks.* Raise budget_gib"):
        make_loader("t/t", LoaderConfig(**options, learner_weight=0.0, budget_gib=1e-9), root=root)


CHUNK = [0.0, 0.1, 0.2, 0.3]
KEYS = ["observation.state", "action"]


def test_a_policy_can_learn_from_a_valid_dataset(plain: Path, video_dataset: Path) -> None:
    for dataset in (TableDataset("t/t", plain), support.stock(plain), TableDataset("t/t", plain, [2])):
        check(dataset, KEYS)
    check(TableDataset("t/t", video_dataset), ["action", FRONT])
    with pytest.raises(DatasetError, match=r"needs the feature 'actions'.* Did you mean 'action'"):
        check(TableDataset("t/t", plain), ["actions"])


@each_case(
    ("options", "message"),
    [
        ({"episodes": [7]}, "There is no episode 7 .* it has 5, from 0 to 4"),
        ({"episodes": []}, "No episode of .* was asked for"),
        ({"keep": ["actions"]}, "Unknown feature 'actions'. Did you mean 'action'"),
        ({"delta_timestamps": {"acton": [0.0]}}, "Unknown feature 'acton'"),
        ({"delta_timestamps": {"action": [0.0, 0.05]}}, r"must be multiples of 1 / 10 s.* got \[0.05\]"),
        ({"delta_timestamps": {"subtask": [0.0]}}, "'subtask', which is text"),
        ({"delta_timestamps": {"action": [0.0]}, "keep": ["event"]}, "'action', which is not among the features"),
        ({"budget_gib": 0}, "must be positive; got 0"),
    ],
)
def test_wrong_options_are_named(plain: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        TableDataset("t/t", plain, **options)


def test_policies_that_drop_more_than_there_is(plain: Path) -> None:
    with pytest.raises(ConfigError, match="drop_n_last_frames=50 leaves no frame"):
        make_loader("t/t", LoaderConfig(batch_size=4, drop_n_last_frames=50), root=plain)


def test_wrong_fields_of_the_configuration_are_named() -> None:
    for fields, message in (
        ({"batchsize": 4}, "field of LoaderConfig 'batchsize'. Did you mean 'batch_size'.* Valid: .*world_size"),
        ({"batch_size": math.nan}, "batch_size is nan; it must be a whole number, at least 1"),
        ({"rank": 2, "world_size": 2}, "rank is 2; it must be from 0 to world_size - 1 = 1"),
    ):
        values: dict[str, Any] = {"batch_size": 4, **fields}
        with pytest.raises(ConfigError, match=message):
            LoaderConfig(**values)


def test_memory_is_asked_for_before_anything_is_decoded(video_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[Any] = []

    def decode(cache: Any) -> None:
        decoded.append(cache)

    monkeypatch.setattr(frame_cache.FrameCache, "_decode_all", decode)
    frames = support.length(0) + support.length(1)
    images = 2 * frames * support.SIZE[0] * support.SIZE[1] * 3
    with pytest.raises(MemoryBudgetError, match=f"{FRONT}, {WRIST}.* more than the budget"):
        TableDataset("t/t", video_dataset, budget_gib=images / 2**30)  # the columns come on top
    monkeypatch.setattr(frame_cache, "available_memory", lambda: images)
    with pytest.raises(MemoryBudgetError, match="GiB are free"):
        TableDataset("t/t", video_dataset)
    assert decoded == []
    assert TableDataset("t/t", video_dataset, keep=["action", FRONT]).camera_keys == [FRONT]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
@pytest.mark.parametrize("part", ["columns", "images"])
def test_memory_that_runs_out_leads_to_the_fallback(video_dataset, monkeypatch, error, part):
    def fail(*_: Any) -> None:
        raise error if part == "images" else MemoryError

    if part == "images":
        monkeypatch.setattr(frame_cache.FrameCache, "_decode_all", fail)
    else:
        monkeypatch.setattr("bhd_lerobot.datasets.loader.table._read", fail)
    messages: list[str] = []
    loaders = make_loader("t/t", LoaderConfig(batch_size=4), root=video_dataset, report=messages.append)
    assert f"Memory ran out while the {part}" in messages[0]
    assert next(iter(loaders.train))[FRONT].dtype == torch.uint8


def test_available_memory_respects_the_control_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:   4000 kB\n")
    monkeypatch.setattr(frame_cache, "_MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(frame_cache, "_CGROUP", tmp_path)
    monkeypatch.setattr(frame_cache, "_OWN_CGROUP", tmp_path / "self")
    assert frame_cache.available_memory() == 4000 * 1024
    # A container sees its own group as the topmost; that of a batch job is below.
    for own in (tmp_path, tmp_path / "slurm" / "job_1"):
        own.mkdir(parents=True, exist_ok=True)
        (tmp_path / "self").write_text(f"1:name=systemd:/\n0::/{own.relative_to(tmp_path)}\n")
        (own / "memory.current").write_text("1000\n")
        (own / "memory.stat").write_text("anon 200\nfile 800\nshmem 50\ninactive_file 500\nactive_file 250\n")
        for limit, wanted in (("200", 0), ("5000", 4750), ("max", 4000 * 1024)):
            (own / "memory.max").write_text(limit + "\n")
            assert frame_cache.available_memory() == wanted


def test_a_video_that_lacks_frames_is_named(tmp_path: Path) -> None:
    root = support.record_light(tmp_path / "d", 2, (FRONT,))
    other = support.record_light(tmp_path / "other", 1, (FRONT,))
    name = f"videos/{FRONT}/chunk-000/file-000.mp4"
    (root / name).write_bytes((other / name).read_bytes())
    with pytest.raises(DatasetError, match=f"no image of '{FRONT}' for episode 1, frame 0"):
        TableDataset("t/t", root)
    (root / name).write_bytes(b"not a video")
    with pytest.raises(DatasetCorruptError, match=r"file-000\.mp4 is corrupt"):
        TableDataset("t/t", root)


def test_a_data_file_that_does_not_fit_the_metadata(tmp_path: Path) -> None:
    root = support.record_light(tmp_path / "d")
    path = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(0, len(table) - 1), path)
    with pytest.raises(DatasetCorruptError, match="do not match meta/episodes"):
        TableDataset("t/t", root)
    assert len(TableDataset("t/t", root, [0, 1])) == support.length(0) + support.length(1)
    pq.write_table(table.drop_columns(["action"]), path)
    with pytest.raises(DatasetCorruptError, match="has no column 'action'"):
        TableDataset("t/t", root)
    path.write_bytes(np.zeros(100, np.uint8).tobytes())
    with pytest.raises(DatasetCorruptError, match=r"file-000\.parquet is corrupt"):
        TableDataset("t/t", root)
