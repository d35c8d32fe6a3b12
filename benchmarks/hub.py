"""Speed of `bhd-data push` and `bhd-data pull` beside the bare clients: `python -m benchmarks.hub`.

The same files go to the same server on this machine and come back: to a Hub, beside `upload_folder` and
`snapshot_download`; and to an S3-compatible store and a folder, beside fsspec's `put` and `get`. Ours checks the
dataset before, compares it with a snapshot after, knows what is there already, and verifies the checksum of every file
that comes. Each turn is A B B A, each push in a place of its own; the first turn is not counted. The servers are
processes of their own and keep everything in memory, and files here are in memory, too, where there is room. The
data are large, because each side has a start of some hundredths of a second that says nothing about its speed. Both
clients of the Hub use HTTP, without Xet. Cards are left out: the bare clients make none. A folder on this machine has
no goal: the system copies files within its own memory, faster than anybody reads them for a checksum.
"""

import argparse
import importlib.util
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks._turns import ratios, seconds, shown, spread, status, write
from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

GOAL = 0.9  # of the speed of the bare client
WIDTH = 512  # numbers in a frame

TESTS = Path(__file__).resolve().parents[1] / "tests"

_MOTO = """
import sys
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
print("http://%s:%s" % server.get_host_and_port(), flush=True)
sys.stdin.read()
"""

type Turn = Callable[[Path, str], None]
"""Moves a dataset: its folder here, and a name for a place of its own."""


def record(root: Path, megabytes: int, files: int) -> int:
    """Record random numbers, which no file format makes smaller, into some data files; return the bytes of all."""
    layout.DATA_FILES_SIZE_IN_MB = max(1, megabytes // files)  # type: ignore[misc]
    features = {
        "observation.state": {"dtype": "float32", "shape": (WIDTH,), "names": [f"s{i}.pos" for i in range(WIDTH)]},
    }
    rng = np.random.default_rng(0)
    frames = 1000
    with DatasetRecorder.create("bench/hub", 25, features, robot_type="none", root=root) as recorder:
        for _ in range(max(1, round(megabytes * 1e6 / (frames * WIDTH * 4)))):
            writer = recorder.begin_episode()
            writer.set_columns({"observation.state": rng.random((frames, WIDTH), np.float32)})
            recorder.save(writer, task="none", metadata={"outcome": "success"})
    return sum(path.stat().st_size for path in root.rglob("*") if path.is_file())


@contextmanager
def child(*arguments: str, folder: Path | None = None, **variables: str) -> Iterator[str]:
    """Run a server in a process of its own until the end of the block; yields the first line that it prints."""
    process = subprocess.Popen(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, **variables},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


@contextmanager
def hub() -> Iterator[dict[str, Turn]]:
    """Run a Hub on this machine; yields the moves."""
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.utils import disable_progress_bars

    disable_progress_bars()

    def bare_push(root: Path, name: str) -> None:
        HfApi().create_repo(f"me/{name}", repo_type="dataset")
        HfApi().upload_folder(repo_id=f"me/{name}", repo_type="dataset", folder_path=root)
        HfApi().create_tag(f"me/{name}", tag="v3.0", repo_type="dataset")

    def bare_pull(root: Path, name: str) -> None:
        snapshot_download(f"me/{name}", repo_type="dataset", local_dir=root)

    with child("-m", "hub_server", folder=TESTS) as url, _load_client().real_client(url):
        yield {
            "push": lambda root, name: _nothing(push(root, HubDataset(f"me/{name}", create=True))),
            "bare push": bare_push,
            "pull": lambda root, name: _nothing(pull(HubDataset(f"me/{name}"), root)),
            "bare pull": bare_pull,
            "forget": lambda _, name: HfApi().delete_repo(f"me/{name}", repo_type="dataset"),
        }


@contextmanager
def store(base: str) -> Iterator[dict[str, Turn]]:
    """Move below a URL; yields the moves."""
    from fsspec.core import url_to_fs  # type: ignore[import-untyped]

    fs, path = url_to_fs(base)

    def bare_push(root: Path, name: str) -> None:
        fs.put(f"{root}/", f"{path}/{name}/", recursive=True)

    def bare_pull(root: Path, name: str) -> None:
        fs.get(f"{path}/{name}/", f"{root}/", recursive=True)

    yield {
        "push": lambda root, name: _nothing(push(root, StoreDataset(f"{base}/{name}"))),
        "bare push": bare_push,
        "pull": lambda root, name: _nothing(pull(StoreDataset(f"{base}/{name}"), root)),
        "bare pull": bare_pull,
        "forget": lambda _, name: fs.rm(f"{path}/{name}", recursive=True),
    }


@contextmanager
def s3() -> Iterator[dict[str, Turn]]:
    """Run an S3-compatible store on this machine; yields the moves."""
    import fsspec  # type: ignore[import-untyped]

    memory = {"MOTO_S3_DEFAULT_KEY_BUFFER_SIZE": str(1 << 30)}  # else it puts large objects into temporary files
    with child("-c", _MOTO, **memory) as url:
        os.environ |= {
            "AWS_ENDPOINT_URL": url,
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        fsspec.filesystem("s3").mkdir("bench")
        with store("s3://bench") as moves:
            yield moves


def measure(moves: dict[str, Turn], root: Path, folder: Path, turns: int) -> dict[str, list[float]]:
    """Return how long the moves took, turn by turn [s].

    In a turn each of two moves twice, in the order A B B A, so that what grows steadily, such as the server's memory,
    weighs on both alike; who is A alternates. The first turn is not counted.
    """
    times: dict[str, list[float]] = {"push": [], "bare push": [], "pull": [], "bare pull": []}
    for turn in range(turns + 1):
        one, other = ("", "bare ") if turn % 2 else ("bare ", "")
        for way in ("push", "pull"):
            spent = {"": 0.0, "bare ": 0.0}
            for number, who in enumerate((one, other, other, one)):
                place = f"{who.strip() or 'ours'}{turn}"
                here = root if way == "push" else folder / "here"
                if way == "push" and number >= 2:
                    moves["forget"](root, place)  # what it pushed before, so that all of it is sent again
                os.sync()  # what was written before is not paid for now
                spent[who] += seconds(partial(moves[f"{who}{way}"], here, place))
                if way == "pull":
                    _same(root, here)
                    shutil.rmtree(here)
            for who, both in spent.items():
                times[f"{who}{way}"].append(both / 2)
        for who in ("ours", "bare"):
            moves["forget"](root, f"{who}{turn}")
    return {name: values[1:] for name, values in times.items()}


def _same(root: Path, here: Path) -> None:
    for path in root.rglob("*.parquet"):
        if (here / path.relative_to(root)).stat().st_size != path.stat().st_size:
            raise AssertionError(f"{path} did not come whole")


def _nothing(_: Any) -> None:
    """Drop a result."""


def _load_client() -> ModuleType:
    # By its path: another distribution installs a package with the name `tests`.
    spec = importlib.util.spec_from_file_location("hub_client", TESTS / "hub_server" / "client.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _shelf(megabytes: int) -> Path | None:
    """Return a folder in memory, so that no disk is measured; None for the usual place."""
    memory = Path("/dev/shm")
    has_room = memory.is_dir() and shutil.disk_usage(memory).free > 5e6 * megabytes
    return memory if has_room else None


def main() -> int:
    """Print what was measured; return 3 if the goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megabytes", type=int, default=400)
    parser.add_argument("--files", type=int, default=16, help="about so many data files")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--folder", type=Path, help="where files lie here; in memory, if there is room for them")
    parser.add_argument("--json", type=Path, help="write the numbers to this file as well")
    options = parser.parse_args()
    results: dict[str, Any] = {"goal": GOAL}
    met = True
    with tempfile.TemporaryDirectory(dir=options.folder or _shelf(options.megabytes)) as name, ExitStack() as stack:
        folder = Path(name)
        size = record(folder / "data", options.megabytes, options.files)
        results["bytes"] = size
        for place in ("hub", "s3", "folder"):
            moves = stack.enter_context(
                {"hub": hub, "s3": s3, "folder": lambda: store(f"file://{folder}/shelf")}[place]()
            )
            times = measure(moves, folder / "data", folder, options.turns)
            for way in ("push", "pull"):
                ours, bare = ([size / 1e6 / time_ for time_ in times[key]] for key in (way, f"bare {way}"))
                share = spread(ratios(ours, bare))
                results[f"{place}_{way}"] = {"mb_per_s": spread(ours), "bare_mb_per_s": spread(bare), "ratio": share}
                has_goal = place != "folder"
                met = met and (not has_goal or share["median"] >= GOAL)
                print(
                    f"{place:>6} {way}: {statistics.median(ours):6.0f} MB/s, the bare client "
                    f"{statistics.median(bare):6.0f} MB/s; ratio {shown(share)}{f', goal {GOAL}' if has_goal else ''}",
                    flush=True,
                )
    results["met"] = met
    write(options.json, results)
    return status(met=met)


if __name__ == "__main__":
    sys.exit(main())
