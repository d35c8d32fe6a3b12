"""bhd-data pull: what is reported about some episodes, and how odd metadata end."""

import shlex
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.options.parse import parse
from bhd_lerobot.training.config import BhdTrainConfig
from tests.fake_hub.hub import FakeHub


def test_some_episodes_by_outcome(hub: FakeHub, lesson: Path, tmp_path: Path, capsys) -> None:
    assert main.main(["push", str(lesson), "me/d"]) == 0
    capsys.readouterr()
    assert main.main(["pull", "me/d", f"--root={tmp_path / 'b'}", "--outcome=success", "--min_score=0.3"]) == 0
    assert "2 episodes of 6: 4-5" in capsys.readouterr().out
    assert main.main(["pull", "me/d", f"--root={tmp_path / 'c'}", "--outcome=fault"]) == 2
    assert "No episode of me/d is left after filtering" in capsys.readouterr().err
    assert not [one for one in tmp_path.iterdir() if "c" in one.name]


def test_the_command_that_is_suggested_is_one_that_works(hub: FakeHub, lesson: Path, tmp_path: Path, capsys) -> None:
    """With the user's own values."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    target = tmp_path / "my copy"
    assert main.main(["push", str(lesson), "me/d", "--no_card"]) == 0
    capsys.readouterr()
    assert main.main(["pull", "me/d", f"--root={target}", "--episodes=1,3-4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{target}: 3 episodes of 6: 1,3-4"
    assert "hold all 6. Select yours when you load them" in lines[-2]
    words = shlex.split(lines[-1])
    assert words[0] == "bhd-train"
    dataset = parse(BhdTrainConfig, [*words[1:], "--policy.type=bhd_mlp", "--policy.push_to_hub=false"]).dataset
    assert (Path(dataset.root), dataset.episodes) == (target, [1, 3, 4])
    loaded = LeRobotDataset(dataset.repo_id, root=dataset.root, episodes=dataset.episodes)
    assert loaded.num_episodes == 3


EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def test_odd_metadata_end_in_a_message(hub: FakeHub, lesson: Path, tmp_path: Path, capsys) -> None:
    """Whatever lies there, no traceback: an error, or all of it as it is there, and that it is not valid."""
    assert main.main(["push", str(lesson), "me/d", "--no_card"]) == 0
    files = hub.dataset("me/d").files()
    for number, (name, broken) in enumerate(
        (
            (layout.INFO, b"[1]"),
            (layout.TASKS, b"PAR1"),
            (layout.STATS, b"[]"),
            (EPISODES, {"episode_index": ["a", "b"]}),
            (EPISODES, {"other": [1]}),
            (EPISODES, {"episode_index": [*range(6)], "length": ["x"] * 6}),
        )
    ):
        whole = files[name]
        sink = pa.BufferOutputStream()
        if isinstance(broken, dict):
            pq.write_table(pa.table(broken), sink)
        damaged = broken if isinstance(broken, bytes) else sink.getvalue().to_pybytes()
        files[name] = type(whole)(damaged, lfs=whole.lfs)
        for options in ([], ["--outcome=success"]):
            capsys.readouterr()
            target = tmp_path / f"e{number}{''.join(options)}"
            status = main.main(["pull", "me/d", f"--root={target}", *options])
            printed = capsys.readouterr()
            assert printed.err.startswith("error: ") == (status == 2) != target.exists()
            if status != 2:
                assert (status == 1) == ("is not valid" in printed.out)
        files[name] = whole
