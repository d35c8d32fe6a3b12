"""Datasets that several tests of the runs only look at: recorded once for all of them."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.apps.view.support import Served, served
from tests.datasets.loader.support import record_stock
from tests.recording.support import run_record


@pytest.fixture(scope="session")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A base with a camera: three episodes of 20 frames."""
    root = tmp_path_factory.mktemp("looked_at") / "base"
    small = {"robot__camera": "true", "robot__camera_width": 64, "robot__camera_height": 48, "n_envs": 2}
    run_record(root, **small, dataset__num_episodes=3, dataset__episode_time_s=2, seed=4)
    return root


@pytest.fixture(scope="session")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm that picks up what it is told to: two episodes."""
    root = tmp_path_factory.mktemp("looked_at") / "arm"
    kinds = {"robot__type": "ur5", "brain__type": "pick", "task__type": "pick", "robot__beams": None}
    run_record(root, **kinds, dataset__num_episodes=2, dataset__episode_time_s=20, n_envs=2, seed=4)
    return root


@pytest.fixture(scope="session")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What LeRobot's own recorder writes, with cameras."""
    return record_stock(tmp_path_factory.mktemp("looked_at") / "stock", cameras=True)


@pytest.fixture(scope="module")
def base_server(base: Path) -> Iterator[Served]:
    """The base's dataset, served."""
    with served(base) as server:
        yield server
