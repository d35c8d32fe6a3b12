"""Batches from memory are LeRobot's, key by key and bit by bit."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from torch.utils.data import DataLoader
from torchvision.transforms import v2

from bhd_lerobot.datasets.format.video import VideoSettings
from bhd_lerobot.datasets.loader import frame_cache
from bhd_lerobot.datasets.loader.loader import FrameTable, LoaderConfig, TableDataset, make_loader
from bhd_lerobot.errors import DatasetError
from tests.cases import each_case
from tests.datasets.loader import support
from tests.datasets.loader.support import FPS, FRONT, PHOTO, WRIST

CHUNK = [i / FPS for i in range(8)]  # longer than the shortest episode
WINDOW = [-0.2, 0.0, 0.1]
AV1 = VideoSettings(vcodec="libsvtav1", preset=12, crf=30)
B_FRAMES = VideoSettings(g=30, extra_options={"bf": 2})


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without cameras, by our recorder."""
    return support.record_light(tmp_path_factory.mktemp("plain") / "d")


@pytest.fixture(scope="module")
def video_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With two cameras."""
    return support.record_light(tmp_path_factory.mktemp("video_dataset") / "d", 4, (FRONT, WRIST))


def both(root: Path, **options: Any) -> tuple[TableDataset, Any]:
    return TableDataset("t/t", root, **options), support.stock(root, **options)


def assert_equal_datasets(root: Path, **options: Any) -> TableDataset:
    ours, theirs = both(root, **options)
    for name in ("num_frames", "num_episodes", "fps", "features", "episodes", "root", "absolute_to_relative_idx"):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert len(ours) == len(theirs)
    indices = torch.randperm(len(theirs), generator=torch.Generator().manual_seed(0))
    support.assert_same(ours.batch(indices), support.collated(theirs, indices.tolist()))
    for index in (0, len(theirs) // 2, -1):
        support.assert_same(ours[index], theirs[index])
    return ours


@pytest.mark.law
@each_case(
    ("episodes", "deltas"),
    [(None, None), ([0], {"action": [0.0]}), ([4, 1], {"action": CHUNK, "observation.state": WINDOW, "event": WINDOW})],
)
def test_tables_are_those_of_lerobot(plain: Path, episodes: list[int] | None, deltas: dict[str, list[float]]) -> None:
    assert_equal_datasets(plain, episodes=episodes, delta_timestamps=deltas)


@each_case(
    ("return_uint8", "deltas"),
    [(True, None), (False, {"action": CHUNK, FRONT: WINDOW}), (True, {FRONT: [0.0], WRIST: [-0.1]})],
)
def test_frames_of_our_recorder_are_those_of_lerobot(video_dataset, return_uint8, deltas):
    assert_equal_datasets(video_dataset, episodes=[1, 3], delta_timestamps=deltas, return_uint8=return_uint8)


@each_case(("video", "cores"), [(AV1, 8), (B_FRAMES, 1)])
def test_frames_of_other_codecs_are_those_of_lerobot_with_any_number_of_threads(tmp_path, video, cores, monkeypatch):
    root = support.record_light(tmp_path / "d", 3, (FRONT,), video)
    monkeypatch.setattr(frame_cache.os, "cpu_count", lambda: cores)
    assert_equal_datasets(root, delta_timestamps={"action": CHUNK}, return_uint8=True)


@each_case(
    ("episodes", "deltas"), [(None, None), ([2, 0], {"action": CHUNK, "grid": WINDOW, FRONT: WINDOW, PHOTO: [0.0]})]
)
def test_a_dataset_that_stock_lerobot_recorded(stock, episodes, deltas):
    assert_equal_datasets(stock, episodes=episodes, delta_timestamps=deltas)


def test_images_beside_the_table_are_read_and_none_outside_of_the_dataset(stock: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(stock, tmp_path / "d"))
    (root / "images").mkdir(exist_ok=True)
    (file,) = root.glob("data/*/*.parquet")
    table = pq.read_table(file)
    column = table.column_names.index(PHOTO)
    names = [f"images/{row}.png" for row in range(len(table))]
    for name, image in zip(names, table[PHOTO].to_pylist(), strict=True):
        (root / name).write_bytes(image["bytes"])

    def name_images(names: list[str]) -> None:
        images = pa.array([{"bytes": None, "path": name} for name in names], table.schema.field(PHOTO).type)
        pq.write_table(table.set_column(column, table.schema.field(PHOTO), images), file)

    name_images(names)
    rows = torch.arange(len(table))
    assert torch.equal(TableDataset("t/t", root).batch(rows)[PHOTO], TableDataset("t/t", stock).batch(rows)[PHOTO])
    (root / names[0]).rename(tmp_path / "mine.png")
    name_images(["../mine.png", *names[1:]])
    with pytest.raises(DatasetError, match="outside of the dataset"):
        TableDataset("t/t", root)


def test_random_transforms_draw_as_in_lerobot(video_dataset: Path) -> None:
    transform = v2.Compose([v2.RandomHorizontalFlip(), v2.ColorJitter(brightness=0.5)])
    ours, theirs = both(video_dataset, image_transforms=transform)
    torch.manual_seed(3)
    wanted = support.collated(theirs, [5, 1, 9])
    torch.manual_seed(3)
    support.assert_same(ours.batch(torch.tensor([5, 1, 9])), wanted)
    ours.set_image_transforms(None)
    assert not torch.equal(ours.batch(torch.tensor([5, 1, 9]))[FRONT], wanted[FRONT])


def test_other_decoders_run_through_lerobot(video_dataset: Path) -> None:
    ours = TableDataset("t/t", video_dataset, video_backend="video_reader", return_uint8=True)
    cache = frame_cache.FrameCache(ours.table, [FRONT], 1e-4)
    slow = frame_cache.FrameCache.__new__(frame_cache.FrameCache)
    slow.__dict__.update(cache.__dict__, _backend="pyav", images={FRONT: torch.zeros_like(cache.images[FRONT])})
    for job in slow._jobs():
        slow._decode_lerobot(job)
    assert torch.equal(slow.images[FRONT], cache.images[FRONT])


def test_a_language_column_is_in_samples_and_in_batches_where_lerobot_has_it(tmp_path: Path) -> None:
    root = support.record_light(tmp_path / "d", 2, language=True)
    ours = assert_equal_datasets(root, delta_timestamps={"action": CHUNK})
    assert ours[0]["language_persistent"][0]["content"] == "pick it up"
    kept = "language_persistent" in support.collated(support.stock(root), [0])  # of version 0.6.1 it is not
    assert ("language_persistent" in ours.batch(torch.tensor([0]))) is kept
    loader = make_loader("t/t", LoaderConfig(batch_size=4, budget_gib=1e-9), root=root, report=lambda _: None).train
    assert ("language_persistent" in next(iter(loader))) is kept


def test_a_subset_shares_memory_and_is_what_lerobot_selects(video_dataset: Path) -> None:
    whole = TableDataset("t/t", video_dataset, delta_timestamps={"action": CHUNK}, return_uint8=True)
    part = whole.subset([3, 1])
    theirs = support.stock(video_dataset, episodes=[3, 1], delta_timestamps={"action": CHUNK}, return_uint8=True)
    assert part.table is whole.table
    assert part.episodes == theirs.episodes
    indices = list(range(len(theirs)))
    assert len(part) == len(theirs)
    support.assert_same(part.batch(torch.tensor(indices)), support.collated(theirs, indices))
    assert part.subset([1]).num_frames == support.length(1)
    with pytest.raises(DatasetError, match="Episode 0 is not among the 2"):
        part.subset([0])


def test_batches_do_not_share_memory_with_the_dataset_or_each_other(video_dataset: Path) -> None:
    dataset = TableDataset("t/t", video_dataset, delta_timestamps={"action": [0.0], "event": [0.0]}, return_uint8=True)
    wanted = dataset.batch(torch.arange(3))
    spoiled = dataset.batch(torch.arange(3))
    for key, value in spoiled.items():
        if isinstance(value, torch.Tensor):
            before = {k: v.clone() for k, v in spoiled.items() if isinstance(v, torch.Tensor) and k != key}
            value.fill_(1)
            assert all(torch.equal(spoiled[k], v) for k, v in before.items()), key
    support.assert_same(dataset.batch(torch.arange(3)), wanted)


def test_keep_limits_what_is_read_and_decoded(video_dataset: Path) -> None:
    keep = ["action", WRIST]
    dataset = TableDataset("t/t", video_dataset, keep=keep, delta_timestamps={"action": CHUNK})
    theirs = support.stock(video_dataset, delta_timestamps={"action": CHUNK})
    batch, wanted = dataset.batch(torch.tensor([4])), support.collated(theirs, [4])
    index = ["timestamp", "frame_index", "episode_index", "index", "task_index"]
    assert set(batch) == {*keep, *index, "action_is_pad", "task"}
    support.assert_same(batch, {key: wanted[key] for key in wanted if key in batch})
    assert dataset.camera_keys == [WRIST]
    assert dataset.nbytes < TableDataset("t/t", video_dataset).nbytes


def test_pytorch_data_loader_and_slices(plain: Path) -> None:
    ours, theirs = both(plain, delta_timestamps={"action": CHUNK})
    for mine, other in zip(DataLoader(ours, 7), DataLoader(theirs, 7), strict=True):
        support.assert_same(mine, other)
    assert [our["index"].item() for our in ours[3:6]] == [3, 4, 5]
    with pytest.raises(IndexError, match=f"Sample {len(ours)}"):
        ours[len(ours)]


def test_the_table_by_episode(plain: Path) -> None:
    table = FrameTable.open(plain, [3, 1], ["action"])
    assert table.episodes == [1, 3]
    assert len(table) == support.length(1) + support.length(3)
    for episode in (1, 3):
        assert np.array_equal(table.columns["action"][table.rows(episode)].numpy(), support.columns(episode)["action"])
    assert "observation.state" not in table.columns
    assert table.place(table.rows(3).start + 2) == "episode 3, frame 2"
    with pytest.raises(DatasetError, match="episode 0 is not among 1, 3"):
        table.rows(0)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize(
    "workers",
    [{}, {"num_workers": 1}, {"num_workers": 1, "persistent_workers": False, "prefetch_factor": 1}],
    ids=["no worker", "one that stays", "one an epoch"],
)
def test_the_fallback_serves_the_same_batches_and_reports_it_once(video_dataset: Path, workers: dict[str, Any]) -> None:
    messages: list[str] = []
    options: dict[str, Any] = {
        "batch_size": 6,
        "seed": 5,
        "eval_split": 0.5,
        "max_eval_samples": 6,
        "delta_timestamps": {"action": CHUNK},
        "drop_n_last_frames": 1,
        "intervention_weight": 0.0,
    }
    memory = make_loader("t/t", LoaderConfig(**options), root=video_dataset, report=messages.append)
    assert (messages, memory.message) == ([], "")
    small = LoaderConfig(**options, budget_gib=1e-4, **workers)
    stock = make_loader("t/t", small, root=video_dataset, report=messages.append)
    assert messages == [stock.message]
    assert "more than the budget of 0.0001 GiB" in stock.message
    assert "LeRobot's own loader" in stock.message
    assert type(stock.dataset).__name__ == "LeRobotDataset"
    assert len(memory.train) == len(stock.train) == 3
    for _ in range(2):
        for mine, other in zip(memory.train, stock.train, strict=True):
            support.assert_same(mine, other)
            assert memory.train.state_dict() == stock.train.state_dict()
    assert memory.held_out is not None
    assert stock.held_out is not None
    held_out = list(memory.held_out)
    for mine, other in zip(held_out, stock.held_out, strict=True):
        support.assert_same(mine, other)
    assert torch.cat([batch["episode_index"] for batch in held_out]).tolist() == [2, 2, 2, 3, 3, 3]
    assert np.allclose(memory.dataset.meta.stats[FRONT]["mean"].squeeze(), [0.485, 0.456, 0.406])
