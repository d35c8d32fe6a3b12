"""Statistics of stock LeRobot are those of its data, as far as float32 goes; those of other data are not."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from bhd_lerobot.datasets.assembly import assemble
from bhd_lerobot.datasets.edit.edits import delete, merge
from bhd_lerobot.datasets.format.columns import frames_of, read_episode
from bhd_lerobot.datasets.format.statistics import are_possible, column_stats
from bhd_lerobot.datasets.loader.check import check
from bhd_lerobot.datasets.loader.table_dataset import TableDataset
from bhd_lerobot.datasets.recovery.fix import fix
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.validate.findings import Severity
from bhd_lerobot.datasets.validate.statistics import Moments, wrong_statistic
from bhd_lerobot.errors import DatasetError
from tests.cases import each_case
from tests.datasets import foreign

NAMES = ["wrist_2.pos", "offset.pos", "swing.pos", "zero.pos", "steady.pos"]
FEATURES = {"observation.state": {"dtype": "float32", "shape": (5,), "names": NAMES}}
LENGTHS = (60, 240, 600)  # rounding depends on it: it may be up or down, and cancel


def columns(rng: np.random.Generator, episode: int, n: int) -> np.ndarray:
    """Return what a joint that rests, one far from zero, one that swings, a dead one, and an encoder tell, (n, 5)."""
    time = np.arange(n) / 30
    swing = np.sin(2 * time + episode) + 0.3 * episode
    values = [np.full(n, 1.57), 1000 + swing, swing, np.zeros(n), 1e4 + 0.1 * rng.normal(size=n)]
    return np.stack(values, axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("stock") / "d"
    dataset = LeRobotDataset.create("t/t", fps=30, root=root, robot_type="toy", use_videos=False, features=FEATURES)
    rng = np.random.default_rng(0)
    for episode, n in enumerate(LENGTHS):
        for row in columns(rng, episode, n):
            dataset.add_frame({"observation.state": row, "task": "t"})
        dataset.save_episode()
    dataset.finalize()
    return root


def stats_errors(root: Path) -> list[str]:
    found = check_dataset(root).findings
    return [f"{one.where}: {one.what}" for one in found if (one.severity, one.check) == (Severity.ERROR, "stats")]


def test_rounded_statistics_of_stock_lerobot_are_valid(stock: Path) -> None:
    stored = json.loads((stock / "meta/stats.json").read_text())["observation.state"]
    assert abs(stored["mean"][0] - np.float32(1.57)) > 1e-6, "the case that is to pass"
    assert stored["std"][0] > 1e-5
    assert abs(stored["mean"][1] - 1000.3) > 1e-6
    assert stats_errors(stock) == []
    (warning,) = [one for one in check_dataset(stock).findings if one.severity is Severity.WARNING]
    # Far from zero, the deviation is another one than that of the data: valid, but a policy would learn something else.
    assert "the std of offset.pos, steady.pos is not that of the data" in warning.what


def swap(stored: dict[str, Any], name: str) -> None:
    stored[name][2], stored[name][3] = stored[name][3], stored[name][2]


def move(stored: dict[str, Any], name: str, number: int, by: float) -> None:
    stored[name][number] += by


WRONG: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "min of another": (lambda stored: swap(stored, "min"), "min"),
    "max of another": (lambda stored: swap(stored, "max"), "max"),
    "mean of another": (lambda stored: swap(stored, "mean"), "mean"),
    "std of another": (lambda stored: swap(stored, "std"), "std"),
    "a resting joint elsewhere": (lambda stored: move(stored, "mean", 0, 1e-3), "mean"),
    "a resting joint that moves": (lambda stored: move(stored, "std", 0, 0.02), "std"),
    "a dead joint that moves": (lambda stored: move(stored, "std", 3, 1e-3), "std"),
    "an offset": (lambda stored: move(stored, "max", 1, 0.01), "max"),
    "a mean far from zero": (lambda stored: move(stored, "mean", 1, 0.1), "mean"),
    "no number": (lambda stored: move(stored, "mean", 2, float("nan")), "mean"),
    "too few": (lambda stored: stored["std"].pop(), "std"),
}


def test_wrong_statistics_are_found(stock: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(stock, tmp_path / "d"))
    path = root / "meta/stats.json"
    before = path.read_text()
    for case, (change, name) in WRONG.items():
        stats = json.loads(before)
        change(stats["observation.state"])
        path.write_text(json.dumps(stats))
        assert stats_errors(root) == [f"meta/stats.json: observation.state: {name} is not that of the data"], case


@each_case("n", [2, 700, 60_000])
@each_case("value", [1e-7, -3.14159, 123456.7])
def test_the_rounding_of_lerobots_statistics_is_within_the_bounds(n: int, value: float) -> None:
    from lerobot.datasets.compute_stats import compute_episode_stats

    rng = np.random.default_rng(1)
    kinds = [
        np.full(n, value),
        value + rng.normal(size=n),
        value * np.linspace(0.5, 1, n),
        value * (1 + 1e-4 * rng.normal(size=n)),
    ]
    values = np.stack(kinds, axis=1).astype(np.float32)
    stored = compute_episode_stats({"observation.state": values}, FEATURES)["observation.state"]
    assert wrong_statistic(stored, Moments.of(values), n) is None


def far_from_zero(episode: int, values: foreign.Columns) -> None:
    rng = np.random.default_rng([7, episode])
    size = values["observation.state"].shape
    values["observation.state"] = (10_000 + 10 * episode + rng.normal(size=size)).astype(np.float32)


def at_a_power_of_two(episode: int, values: foreign.Columns) -> None:
    rng = np.random.default_rng([5, episode])
    size = values["observation.state"].shape
    values["observation.state"] = (16_384 + rng.uniform(-1, 1, size)).astype(np.float32)


def one_step(episode: int, values: foreign.Columns) -> None:
    """Let a number change by a step of single precision in one frame, and another one nowhere."""
    values["observation.state"][:] = 16_384
    values["observation.state"][3, 0] = np.nextafter(np.float32(16_384), np.float32(20_000))


ROUNDED = [far_from_zero, at_a_power_of_two, one_step]


def rounded(root: Path, change: Callable[[int, foreign.Columns], None]) -> Path:
    return foreign.write(root, (200, 200), change=change, stats_of=foreign.in_single_precision)


def stored(root: Path) -> dict[str, np.ndarray]:
    stats = json.loads((root / "meta/stats.json").read_text())["observation.state"]
    return {name: np.array(values) for name, values in stats.items()}


def true_std(root: Path) -> np.ndarray:
    values = [episode["observation.state"] for episode in (read_episode(root, i) for i in range(len_of(root)))]
    return np.concatenate(values).astype(np.float64).std(axis=0)


def len_of(root: Path) -> int:
    return int(json.loads((root / "meta/info.json").read_text())["total_episodes"])


@each_case("change", ROUNDED)
def test_a_deviation_that_was_rounded_away_is_found_and_computed_again(tmp_path: Path, change: Any) -> None:
    root = rounded(tmp_path / "d", change)
    found = [one for one in foreign.check(root).findings if one.check == "stats"]
    assert [one.where for one in found] == ["meta/stats.json: observation.state"]
    assert "is not that of the data" in found[0].what
    assert found[0].severity is (Severity.ERROR if (stored(root)["std"][0] == 0).any() else Severity.WARNING)
    assert fix(root, found)
    assert [one for one in foreign.check(root).findings if one.check == "stats"] == []
    np.testing.assert_allclose(stored(root)["std"], true_std(root), rtol=0.01, atol=1e-4)


@each_case("change", ROUNDED)
def test_no_edit_passes_on_a_deviation_that_cannot_be(tmp_path: Path, change: Any) -> None:
    root = rounded(tmp_path / "d", change)
    delete(root, [0])
    merge([root, rounded(tmp_path / "e", change)], tmp_path / "all")
    for one in (root, tmp_path / "all"):
        stats = stored(one)
        assert not ((stats["std"] == 0) & (stats["max"] > stats["min"])).any()
        assert are_possible(stats).all()
    np.testing.assert_allclose(stored(root)["std"][:2], true_std(root)[:2], rtol=1.0, atol=1e-6)


def test_all_deviations_of_a_file_cost_reading_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot puts hundreds of episodes into a file; one in which a number is not finite may be kept."""

    def change(episode: int, values: foreign.Columns) -> None:
        far_from_zero(episode, values)
        if episode == 2:
            values["observation.state"][1, 2] = np.nan

    root = foreign.write(tmp_path / "d", (200,) * 4, change=change, stats_of=partly_rounded)
    read: list[Path] = []

    def count(path: Path, *arguments: Any) -> Any:
        read.append(path)
        return frames_of(path, *arguments)

    monkeypatch.setattr(assemble, "frames_of", count)
    delete(root, [0])
    assert len(read) == 1
    assert len_of(root) == 3


def partly_rounded(columns: foreign.Columns) -> dict[str, Any]:
    """Return statistics with an impossible deviation of the first number, as of an episode with a NaN in another."""
    stats = column_stats(columns, finite=False)
    stats["observation.state"]["std"][0] = 0.0
    return stats


@given(arrays(np.float32, st.tuples(st.integers(1, 40), st.just(2)), elements=st.floats(-100, 100, width=32)))
def test_a_true_deviation_is_possible(values: np.ndarray) -> None:
    (stats,) = column_stats({"action": values}).values()
    assert are_possible(stats).all()
    span = stats["max"] - stats["min"]
    assert (are_possible({**stats, "std": 0.51 * span}) == (span == 0)).all()


def test_a_training_does_not_divide_by_zero(tmp_path: Path) -> None:
    root = rounded(tmp_path / "d", one_step)
    dataset = TableDataset("t/t", root)
    check(dataset, ["action"])
    with pytest.raises(DatasetError, match=r"'observation.state' is stored as 0.* check --fix"):
        check(dataset, ["observation.state"])
    fix(root, foreign.check(root).findings)
    check(TableDataset("t/t", root), ["observation.state"])


@each_case("offset", [0.0, 1.7e9, 1e12])
def test_moments_are_those_of_the_data_far_from_zero(offset: float) -> None:
    values = offset + np.random.default_rng(0).normal(size=(40_000, 2)).round(2)
    found = Moments.of(values[:30_000])
    found.add(Moments.of(values[30_000:]))
    np.testing.assert_allclose(found.variance, (values - offset).var(axis=0), rtol=1e-3)
    np.testing.assert_allclose(found.mean, values.mean(axis=0))
