"""Real-time privileges: granted, refused, required, given back; with a faked kernel, and for real in a child."""

import errno
import gc
import json
import os
import resource
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.realtime.privileges import (
    CAP_IPC_LOCK,
    CAP_SYS_NICE,
    GRANT_BANDWIDTH,
    GRANT_LATENCY_FILE,
    MCL_CURRENT,
    MCL_FUTURE,
    Privileges,
    RealtimeSettings,
    SystemCalls,
)
from tests.cases import each_case

FIFO = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
NAMES = ["collector", "memory lock", "cpu latency", "timer slack", "scheduler"]
INITIAL = {"scheduler": (os.SCHED_OTHER, 0), "affinity": {0, 1, 2}, "slack": 50_000, "locked": 0, "latency": None}


class FakeKernel(SystemCalls):
    """A kernel that refuses the named requests, and remembers the rest."""

    def __init__(
        self, *refused: str, capabilities: tuple[int, ...] = (CAP_SYS_NICE, CAP_IPC_LOCK), limit: int = 0
    ) -> None:
        self.refused = set(refused)
        self.state: dict[str, Any] = dict(INITIAL)
        self._capabilities = sum(1 << bit for bit in capabilities)
        self._limit = limit

    def _do(self, name: str, key: str, value: object) -> None:
        if name in self.refused:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        self.state[key] = value

    def scheduler(self) -> tuple[int, int]:
        return self.state["scheduler"]

    def set_scheduler(self, policy: int, priority: int) -> None:
        cleared = self.state["scheduler"][0] & ~policy & os.SCHED_RESET_ON_FORK
        if cleared and "clear the flag" in self.refused:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        self._do("scheduler", "scheduler", (policy, priority))

    def affinity(self) -> set[int]:
        return self.state["affinity"]

    def set_affinity(self, processors: set[int]) -> None:
        self._do("affinity", "affinity", processors)

    def timer_slack(self) -> int:
        return self.state["slack"]

    def set_timer_slack(self, slack: int) -> None:
        self._do("timer slack", "slack", slack)

    def lock_memory(self, flags: int) -> None:
        self._do("memory lock", "locked", flags)

    def unlock_memory(self) -> None:
        self.state["locked"] = 0

    def hold_cpu_latency(self, latency_us: int) -> int:
        self._do("cpu latency", "latency", latency_us)
        return 7

    def close(self, handle: int) -> None:
        assert handle == 7
        self.state["latency"] = None

    def limit(self, which: int) -> int:
        return self._limit

    def capabilities(self) -> int:
        return self._capabilities


@pytest.fixture(autouse=True)
def collections(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The collector of the process that tests is real: it must be as before, whatever a test does.

    Only a collection is faked, which takes half a second here; returned is what was frozen at each.
    """
    assert gc.isenabled()
    frozen = gc.get_freeze_count()
    collected: list[int] = []
    monkeypatch.setattr(gc, "collect", lambda: collected.append(gc.get_freeze_count()))
    yield collected
    enabled = gc.isenabled()
    gc.enable()
    assert enabled
    assert gc.get_freeze_count() <= frozen


def one_cpu() -> tuple[int, ...]:
    return (min(os.sched_getaffinity(0)),)


def test_a_priority_or_a_processor_that_there_is_not_is_refused() -> None:
    for priority in (0, 100, -1, True, 80.0):
        with pytest.raises(ConfigError, match=f"{priority!r}; it must be a whole number from 1 to 99"):
            RealtimeSettings(priority=priority)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"processor\(s\) 4096; this process may run on .*Leave the affinity empty"):
        RealtimeSettings(affinity=(*one_cpu(), 4096))


def test_everything_is_granted_and_given_back(collections: list[int]) -> None:
    kernel, frozen = FakeKernel(), gc.get_freeze_count()
    privileges = Privileges(kernel)
    grants = privileges.acquire(RealtimeSettings(priority=81, affinity=one_cpu()))
    assert [grant.name for grant in grants] == ["affinity", *NAMES]
    assert all(grant.granted and grant.detail and not grant.remedy for grant in grants)
    assert kernel.state == {
        "scheduler": (FIFO, 81),
        "affinity": set(one_cpu()),
        "slack": 1,
        "locked": MCL_CURRENT | MCL_FUTURE,
        "latency": 0,
    }
    assert not gc.isenabled()
    assert collections == [frozen]  # once, before the rest was frozen
    assert gc.get_freeze_count() > 1000
    privileges.release()
    assert kernel.state == INITIAL
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    privileges.release()


def test_only_wanted_privileges_are_requested() -> None:
    kernel = FakeKernel()
    settings = RealtimeSettings(lock_memory=False, hold_cpu_latency=False, freeze_collector=False)
    with Privileges(kernel) as privileges:
        assert [grant.name for grant in privileges.acquire(settings)] == ["timer slack", "scheduler"]
        assert kernel.state == {**INITIAL, "slack": 1, "scheduler": (FIFO, 80)}
        assert gc.isenabled()
    assert kernel.state == INITIAL


MEMORY = "memory lock"  # without the right and within a limit, what comes later is not locked: a refusal, too
NO_RIGHT = (
    "Operation not permitted",
    "SCHED_OTHER with a timer slack of 1 ns",
    f"setcap cap_sys_nice,cap_ipc_lock+ep {os.path.realpath(sys.executable)}",
    "@realtime - rtprio 97",  # a limit of 95 would not do for this priority
    "--cap-add=SYS_NICE --cap-add=IPC_LOCK --ulimit rtprio=97 --ulimit memlock=-1",
)
NICE, LOCK, INFINITE = (CAP_SYS_NICE,), (CAP_IPC_LOCK,), resource.RLIM_INFINITY


@each_case(
    ("kernel", "settings", "refused", "parts"),
    [
        (FakeKernel("affinity", capabilities=()), {"affinity": one_cpu()}, {"affinity", MEMORY}, ("not permitted",)),
        (FakeKernel(MEMORY, capabilities=()), {}, {MEMORY}, ("not permitted",)),
        (FakeKernel("cpu latency", capabilities=()), {}, {"cpu latency", MEMORY}, ("not permitted",)),
        (FakeKernel("timer slack", capabilities=()), {}, {"timer slack", MEMORY}, ("not permitted",)),
        (
            FakeKernel("scheduler", capabilities=()),
            {"priority": 97},
            {"scheduler", MEMORY},
            ("not permitted", *NO_RIGHT),
        ),
        (FakeKernel("scheduler", capabilities=LOCK, limit=79), {}, {"scheduler"}, ("setcap",)),  # below the priority
        # With the right: control groups.
        (FakeKernel("scheduler", limit=0), {}, {"scheduler"}, (GRANT_BANDWIDTH,)),
        (FakeKernel("scheduler", capabilities=LOCK, limit=80), {}, {"scheduler"}, (GRANT_BANDWIDTH,)),
        (FakeKernel("scheduler", capabilities=LOCK, limit=95), {}, {"scheduler"}, (GRANT_BANDWIDTH,)),
        (FakeKernel("scheduler", capabilities=(), limit=INFINITE), {}, {"scheduler"}, (GRANT_BANDWIDTH,)),
        # An allocation could fail if future memory was locked within a limit.
        (FakeKernel(capabilities=NICE, limit=8192 * 1024), {}, {MEMORY}, ("8192 KiB", "memlock")),
        (FakeKernel("cpu latency"), {}, {"cpu latency"}, (GRANT_LATENCY_FILE,)),
        (FakeKernel("cpu latency", MEMORY), {"require": True}, {"cpu latency", MEMORY}, ("not permitted",)),
    ],
)
def test_a_refusal_is_reported_with_its_remedy_and_stops_nothing_else(kernel, settings, refused, parts):
    with Privileges(kernel) as privileges:
        grants = privileges.acquire(RealtimeSettings(freeze_collector=False, **settings))
        assert {grant.name for grant in grants if not grant.granted} == refused
        assert all(bool(grant.remedy) != grant.granted for grant in grants)
        said = "\n".join(f"{grant.detail} {grant.remedy}" for grant in grants if not grant.granted)
        assert [part for part in parts if part not in said] == []
        assert kernel.state["locked"] == (MCL_CURRENT if MEMORY in refused - kernel.refused else kernel.state["locked"])
        assert kernel.state["scheduler"] == ((os.SCHED_OTHER, 0) if "scheduler" in refused else (FIFO, 80))
    assert kernel.state == INITIAL


class Broken(FakeKernel):
    def timer_slack(self) -> int:
        raise RuntimeError("planted")


REQUIRED = r"SCHED_FIFO priority 80.*refused.*setcap.*require_realtime = false"


@each_case(
    ("kernel", "error"),
    [(FakeKernel("scheduler", capabilities=()), (RealtimeError, REQUIRED)), (Broken(), (RuntimeError, "planted"))],
)
def test_after_an_error_everything_is_given_back(kernel: FakeKernel, error: tuple[type[Exception], str]) -> None:
    with pytest.raises(error[0], match=error[1]):
        Privileges(kernel).acquire(RealtimeSettings(require=True))
    assert kernel.state == INITIAL


def test_acquiring_twice_is_an_error_and_again_after_a_release_is_not() -> None:
    kernel = FakeKernel("clear the flag")
    with Privileges(kernel) as privileges:
        privileges.acquire(RealtimeSettings())
        with pytest.raises(RealtimeError, match="call release"):
            privileges.acquire(RealtimeSettings())
        privileges.release()
        assert privileges.acquire(RealtimeSettings())[-1].granted
    # Without the right to clear it, a flag stays.
    assert kernel.state["scheduler"] == (os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, 0)


def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        with Privileges(FakeKernel()) as privileges:
            privileges.acquire(RealtimeSettings())
        assert not gc.isenabled()
    finally:
        gc.enable()


REPORT = """
    import gc, json, os, sys
    from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings
    from bhd_lerobot.realtime.privileges import SystemCalls
    calls = SystemCalls()
    before = [calls.scheduler(), calls.timer_slack(), sorted(calls.affinity())]
    privileges = Privileges()
    grants = privileges.acquire(RealtimeSettings(affinity=(min(os.sched_getaffinity(0)),)))
    during = [calls.scheduler(), calls.timer_slack(), sorted(calls.affinity())]
    kilobytes = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmLck:"))
    files = [os.readlink(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")
             if os.path.exists(f"/proc/self/fd/{n}")]
    collecting = gc.isenabled()
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        os.write(writer, json.dumps(calls.scheduler()).encode())
        os._exit(0)
    forked = json.loads(os.read(reader, 100))
    os.waitpid(child, 0)
    privileges.release()
    after = [calls.scheduler(), calls.timer_slack(), sorted(calls.affinity())]
    print(json.dumps(dict(
        before=before, during=during, after=after, forked=forked, kilobytes=kilobytes, files=files,
        collecting=[collecting, gc.isenabled()], grants={g.name: g.as_dict() for g in grants},
        unwanted=sorted({"torch", "lerobot", "mujoco"} & set(sys.modules)),
    )))
"""


def test_a_process_has_what_its_grants_say_and_gives_it_back() -> None:
    root, program = Path(__file__).resolve().parents[2], textwrap.dedent(REPORT)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    grants = result["grants"]
    assert list(grants) == ["affinity", *NAMES]
    assert all(bool(grant["remedy"]) != grant["granted"] for grant in grants.values())
    if grants["scheduler"]["granted"]:
        assert result["during"][0] == [FIFO, 80]
    else:
        assert result["during"][:2] == [result["before"][0], 1]
    assert result["forked"] == [os.SCHED_OTHER, 0]
    assert (result["kilobytes"] > 1000) >= grants["memory lock"]["granted"]
    assert ("/dev/cpu_dma_latency" in result["files"]) == grants["cpu latency"]["granted"]
    assert result["during"][2] == result["before"][2][:1]
    assert result["collecting"] == [False, True]
    # Who has the right by limit alone cannot clear the flag.
    before, after = result["before"], result["after"]
    assert after[0] in (before[0], [before[0][0] | os.SCHED_RESET_ON_FORK, 0])
    assert after[1:] == before[1:]
    assert result["unwanted"] == []
