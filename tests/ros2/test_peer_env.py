import os
from pathlib import Path

import pytest

from tests import requirements
from tests.ros2 import peer_env


def test_what_older_or_interrupted_makers_left_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer_env, "CACHE", tmp_path)
    source = tmp_path / "source.txt"
    for text in ("one", "two"):
        source.write_text(text)
        (tmp_path / "name-0123456789ab.new").mkdir()
        made = peer_env._made("name", [source], Path.mkdir)
        other = peer_env._made("name-messages", [source], Path.mkdir)
        assert sorted(path for path in tmp_path.iterdir() if path.is_dir()) == sorted([made, other])


def test_a_peer_inherits_nothing_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        monkeypatch.setenv(name, "99")
    variables = peer_env.RosEnvironment(Path("python"), None).variables(7)
    assert "99" not in variables.values()
    assert variables["ROS_DOMAIN_ID"] == "7"
    assert variables["PATH"] == os.environ["PATH"]


def test_no_two_get_the_same_domain() -> None:
    with peer_env.free_domain() as one, peer_env.free_domain() as other:
        assert one != other


@pytest.mark.parametrize(("required", "outcome"), [("0", pytest.skip.Exception), ("1", pytest.fail.Exception)])
def test_without_ros_a_test_is_skipped_which_make_test_repeats_and_fails_in_ci(
    required: str, outcome: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons = tmp_path / "reasons"
    reasons.touch()
    monkeypatch.setattr(peer_env, "_environment", lambda: peer_env.UnavailableError("no network"))
    monkeypatch.setenv(requirements.REQUIRE, required)
    monkeypatch.setenv(requirements.REASONS, str(reasons))
    with pytest.raises(outcome, match=r"no ROS 2 kilted .*: no network"):
        peer_env.environment()
    assert len(reasons.read_text().splitlines()) == (required == "0")
