"""URLs that are cannot hold a dataset, each with a sentence that says why."""

from pathlib import Path

import pytest

from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.errors import BhdError, ConfigError, TransferError


def test_a_path_that_is_not_whole_is_refused_with_the_one_that_is(tmp_path: Path, monkeypatch) -> None:
    """It would be another place from another working folder."""
    monkeypatch.chdir(tmp_path)
    for url in ("file://rel/d", "local://rel/d", "file://./rel/d"):
        with pytest.raises(ConfigError, match=f"not a whole path.*://{tmp_path}/rel/d"):
            StoreDataset(url)
    with pytest.raises(ConfigError, match=f"this folder is file://{Path.home()}/d"):
        StoreDataset("file://~/d")
    with pytest.raises(ConfigError, match="write file:///tmp/d"):
        StoreDataset("file://localhost/tmp/d")
    assert StoreDataset(f"file://{tmp_path}/d").folder == tmp_path / "d"


def test_an_unreachable_place_ends_without_a_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(TransferError, match="cannot be reached"):
        StoreDataset("ftp://127.0.0.1:9/d")
    with pytest.raises(BhdError, match=r"cannot be used|not installed|cannot be reached"):
        StoreDataset("hdfs://127.0.0.1:9/d")
    assert "Traceback" not in capfd.readouterr().err


def test_options_that_a_file_system_does_not_know(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--storage_options"):
        StoreDataset("ftp://127.0.0.1:9/d", {"nonsense": 1, "port": "x"})


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("memory://user:pass/wo@rd@host/d", "memory://host/d"),
        ("memory://bucket/a@b/d", "memory://bucket/a@b/d"),
        ("memory://bucket/d/", "memory://bucket/d"),
    ],
)
def test_a_password_is_not_shown(url: str, shown: str) -> None:
    assert StoreDataset(url).name == shown
    with pytest.raises(ConfigError) as caught:
        StoreDataset(url.replace("memory", "foo"))
    assert "pass" not in str(caught.value)
