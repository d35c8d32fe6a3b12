"""Datasets that several tests of the runs only look at: recorded once for all of them."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.apps.view.support import Served

# What records is imported by what needs it: the process that deals the tests out to others reads this file as well.


@pytest.fixture(scope="session")
def three_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short episodes of a toy; copy it before it is changed, as the others."""
    return toy(tmp_path_factory, 3)


@pytest.fixture(scope="session")
def six_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six of them."""
    return toy(tmp_path_factory, 6)


@pytest.fixture(scope="session")
def video_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three with a camera."""
    return toy(tmp_path_factory, 3, video=True)


def toy(tmp_path_factory: pytest.TempPathFactory, episodes: int, *, video: bool = False) -> Path:
    from tests.datasets.edit_support import record

    return record(tmp_path_factory.mktemp("toy") / "d", list(range(episodes)), video=video)


@pytest.fixture(scope="session")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A base without a camera: three episodes of 3 s."""
    from tests.recording.support import run_record

    root = tmp_path_factory.mktemp("looked_at") / "drives"
    run_record(root, n_envs=2, seed=4)
    return root


@pytest.fixture(scope="session")
def lesson(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a policy can learn: six episodes in which the action follows from what is observed."""
    from tests.training.support import make_dataset

    return make_dataset(tmp_path_factory.mktemp("lesson") / "set")


@pytest.fixture(scope="session")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A base with a camera: three episodes of 20 frames."""
    from tests.recording.support import run_record

    root = tmp_path_factory.mktemp("looked_at") / "base"
    small = {"robot__camera": "true", "robot__camera_width": 64, "robot__camera_height": 48, "n_envs": 2}
    run_record(root, **small, dataset__num_episodes=3, dataset__episode_time_s=2, seed=4)
    return root


@pytest.fixture(scope="session")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm that picks up what it is told to: two episodes."""
    from tests.recording.support import run_record

    root = tmp_path_factory.mktemp("looked_at") / "arm"
    kinds = {"robot__type": "ur5", "brain__type": "pick", "task__type": "pick", "robot__beams": None}
    run_record(root, **kinds, dataset__num_episodes=2, dataset__episode_time_s=20, n_envs=2, seed=4)
    return root


@pytest.fixture(scope="session")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What LeRobot's own recorder writes, with cameras."""
    from tests.datasets.loader.support import record_stock

    return record_stock(tmp_path_factory.mktemp("looked_at") / "stock", cameras=True)


@pytest.fixture(scope="module")
def base_server(base: Path) -> Iterator["Served"]:
    """The base's dataset, served."""
    from tests.apps.view.support import served

    with served(base) as server:
        yield server
