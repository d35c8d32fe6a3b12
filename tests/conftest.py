"""What every test runs under: no network, no display, no personal caches, the same examples each time.

The environment is set while this file is imported, so before any test module can import LeRobot, torch or matplotlib.
Child processes inherit it.
"""

import contextlib
import gc
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests import shortcuts

if "PYTEST_XDIST_WORKER" in os.environ:
    gc.disable()  # until everything is imported, or it is looked through again and again for what can go
pytest_plugins = [
    "tests.fake_hub.fixtures",
    "tests.datasets.remote.store_fixtures",
    "tests.recorded_datasets",
    "tests.selection",
]

_HF_HOME = Path(tempfile.mkdtemp(prefix="bhd-test-hf-"))

os.environ["HF_HOME"] = str(_HF_HOME)
os.environ["HF_LEROBOT_HOME"] = str(_HF_HOME / "lerobot")
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_DATASETS_DISABLE_PROGRESS_BARS"] = "1"
os.environ["WANDB_MODE"] = "disabled"
os.environ["MPLBACKEND"] = "Agg"
os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112 - the name is Ray's, whose 15 starves it on a busy machine
if "PYTEST_XDIST_WORKER" in os.environ:
    # One thread for each of torch, BLAS and OpenCV: the workers are the parallelism.
    os.environ["OMP_NUM_THREADS"] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell without job control starts a background command with Ctrl-C ignored; the children of a test inherit that,
    # and the tests of Ctrl-C would wait for ever.
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # by nohup; inherited likewise
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

settings.register_profile("bhd", derandomize=True, deadline=None, database=None)
settings.load_profile("bhd")


def pytest_unconfigure() -> None:
    shutil.rmtree(_HF_HOME, ignore_errors=True)


def pytest_collection_finish() -> None:
    shortcuts.install()
    _freeze()
    gc.enable()


def _freeze() -> None:
    """Spare the collector what has been imported; a collection would take a third of a second."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Draw charts for tests marked `figures` only. A hook, because fixtures of any scope train and record."""
    shortcuts.draw(item.get_closest_marker("figures") is not None)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Freeze again what a test has thawed before the tests of the next module."""
    yield
    if nextitem is not None and nextitem.module is not item.module and gc.get_freeze_count() == 0:
        _freeze()


@pytest.fixture(autouse=True)
def _no_realtime_threads() -> Iterator[None]:
    """Take back the real-time priority that stock LeRobot's AV1 encoder gives the thread of a test that runs as root.

    Processes of later tests would inherit it, among them those that are to have no right to it.
    """
    yield
    for thread in map(int, os.listdir("/proc/self/task")):
        with contextlib.suppress(ProcessLookupError):
            if os.sched_getscheduler(thread) != os.SCHED_OTHER:
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
