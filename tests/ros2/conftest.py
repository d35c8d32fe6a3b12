from collections.abc import Iterator

import pytest

from tests.ros2 import peer_env


@pytest.fixture
def domain() -> Iterator[int]:
    with peer_env.free_domain() as number:
        yield number
