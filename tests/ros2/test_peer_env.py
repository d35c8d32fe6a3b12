from pathlib import Path

import pytest

from tests import requirements
from tests.ros2 import peer_env


@pytest.mark.parametrize(("required", "outcome"), [("0", pytest.skip.Exception), ("1", pytest.fail.Exception)])
def test_without_ros_a_test_is_skipped_which_make_test_repeats_and_fails_in_ci(
    required: str, outcome: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons = tmp_path / "reasons"
    reasons.touch()
    monkeypatch.setattr(peer_env, "_environment", lambda: peer_env.UnavailableError("no network"))
    monkeypatch.setenv(requirements.REQUIRE, required)
    monkeypatch.setenv(requirements.REASONS, str(reasons))
    with pytest.raises(outcome, match=rf"no ROS 2 {peer_env.DISTRIBUTION} .*: no network"):
        peer_env.environment()
    assert len(reasons.read_text().splitlines()) == (required == "0")
