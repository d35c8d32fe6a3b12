import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.realtime import __main__ as program
from benchmarks.realtime.cases import Case, CaseError
from benchmarks.realtime.harness import Run, measure, remarks, turns
from benchmarks.realtime.injections import Drops
from benchmarks.realtime.load import Load, LoadError, cpu_load
from benchmarks.realtime.machine import CpuTimes
from benchmarks.realtime.parts import NAMES, QUICK_SIZES, Experiments, Sizes
from benchmarks.realtime.statistics import Samples, summarise
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[2]


def samples(wake_us: float, notes: tuple[str, ...] = ()) -> Samples:
    wake = np.full(100, wake_us * 1000, np.int64)
    return Samples(wake, wake // 2, 1_000_000, 0, 99_000_000, notes)


class Stage:
    """Fake cases and a fake load that write down what happened in which order."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.loaded = False

    def case(self, name: str, wake_us: float = 20.0, fails_at: int | None = None) -> Case:
        runs = 0

        def run(seconds: float) -> Samples:
            nonlocal runs
            self.events.append(f"{name}{'*' if self.loaded else ''}")
            runs += 1
            if runs == fails_at:
                raise CaseError("it broke")
            return samples(wake_us)

        return Case(name, name.upper(), run)

    @contextmanager
    def load(self, seconds: float) -> Iterator[Load]:
        load = Load(2)
        self.loaded = True
        try:
            yield load
            load.share = 0.9
        finally:
            self.loaded = False


def test_every_case_has_its_blocks_and_goes_first_as_often_as_last() -> None:
    order = list(turns(("a", "b", "c"), ("idle", "load"), 4))
    assert [(number, condition) for number, condition, _ in order] == [
        (k, c) for k in range(4) for c in ("idle", "load")
    ]
    assert [names for _, condition, names in order if condition == "idle"] == [("a", "b", "c"), ("c", "b", "a")] * 2


def test_cases_take_turns_and_the_load_runs_only_in_its_own() -> None:
    stage = Stage()
    cases = [stage.case("a"), stage.case("b")]
    run = measure(cases, ("idle", "load"), 2, 1.0, progress=lambda _: None, load=stage.load)
    assert stage.events == ["a", "b", "a*", "b*", "b", "a", "b*", "a*"]
    assert [(b.case, b.condition, b.round) for b in run.blocks if b.case == "a"] == [
        ("a", "idle", 0),
        ("a", "load", 0),
        ("a", "idle", 1),
        ("a", "load", 1),
    ]
    assert run.load_shares == [0.9, 0.9]
    assert run.missing == {}


def test_a_case_that_fails_is_left_out_loudly_and_the_others_go_on() -> None:
    stage = Stage()
    said: list[str] = []
    cases = [stage.case("a", fails_at=2), stage.case("b")]
    run = measure(cases, ("idle",), 3, 1.0, progress=said.append, load=stage.load)
    assert stage.events == ["a", "b", "b", "a", "b"]
    assert run.missing == {"a": "it broke"}
    assert any(text.startswith("LEFT OUT") and "it broke" in text for text in said)
    assert any("A was NOT MEASURED: it broke" in line for line in remarks(run, {"a": "A", "b": "B"}))


def test_remarks_tell_what_was_refused_once_and_a_load_that_was_none() -> None:
    stage = Stage()
    refused = Case("a", "A", lambda _: samples(20.0, ("SCHED_FIFO: Operation not permitted",)))
    run = measure([refused], ("idle",), 3, 1.0, progress=lambda _: None, load=stage.load)
    assert [line for line in remarks(run, {"a": "A"}) if "SCHED_FIFO" in line] == [
        "A: the system refused SCHED_FIFO: Operation not permitted."
    ]
    assert any("LESS THAN HALF" in line for line in remarks(Run(load_shares=[0.9, 0.3]), {}))
    assert not any("LESS THAN HALF" in line for line in remarks(Run(load_shares=[0.9, 0.8]), {}))


@pytest.mark.parametrize(
    ("busy", "disturbed"),
    [
        ([0.03, 0.55, 0.04, 0.56], False),  # two rounds, in each of them a case that keeps a processor busy
        ([0.03, 0.55, 0.40, 0.95], True),
    ],
)
def test_idle_blocks_that_were_not_idle_are_remarked(busy: list[float], disturbed: bool) -> None:
    blocks = [summarise(samples(20.0), f"case {k % 2}", "idle", k // 2, share) for k, share in enumerate(busy)]
    blocks.append(summarise(samples(20.0), "case 0", "load", 0, 1.0))
    lines = remarks(Run(blocks), {})
    assert any("NOT IDLE" in line for line in lines) == disturbed
    assert any(f"up to {0.4 if disturbed else 0.04:.0%} busy" in line for line in lines)


def test_the_whole_program_on_fake_loops(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stage = Stage()

    wake = {
        "twin": 20.0,
        "bhd": 26.0,
        "python": 22.0,
        "thread": 5000.0,
        "torch": 30.0,
        "running": 26.0,
        "stopped": 26.0,
    }

    class FakeBench:
        def __init__(self, *_: Any) -> None:
            self.reports: list[dict[str, Any]] = []

        def cases(self, names: list[str], absent: dict[str, str]) -> list[Case]:
            absent["cyclictest"] = "cyclictest is not installed"
            return [stage.case(name, wake[name]) for name in names if name in wake]

        def experiments(self, names: list[str], conditions: list[str], sizes: Sizes) -> Experiments:
            assert sizes == QUICK_SIZES
            assert names == ["estop", "brain", "drops", "plant"]
            return Experiments(drops=Drops(100, 90, 10), missing={"plant": "it does not start"})

    monkeypatch.setattr(program, "Bench", FakeBench)
    monkeypatch.setattr(program, "how_busy", lambda: "Nothing else ran.")
    monkeypatch.setattr(program, "measure", lambda *args, progress: measure(*args, progress=progress, load=stage.load))
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    out = tmp_path / "result.json"
    status = program.main(["--quick", "--json", str(out)])
    shown = capsys.readouterr()
    result = json.loads(out.read_text())
    verdicts = {(c["name"], c["condition"]): c["verdict"] for c in result["checks"]}
    assert status == 1
    assert verdicts["bhd-lerobot, UR5: wake-up p99 ÷ C++ twin's", "idle"] == "met"
    assert "MISSED" in shown.out
    assert "not to be quoted" in shown.out
    assert "cyclictest was NOT MEASURED: cyclictest is not installed!" in shown.out
    assert result["quotable"] is False
    assert len(result["blocks"]) == 2 * 2 * len(wake)
    assert result["experiments"]["drops"] == {"published": 100, "taken": 90, "counted": 10}
    missed = [c["name"] for c in result["checks"] if c["verdict"] == "MISSED"]
    assert len(missed) == 2
    assert all("p50" in name for name in missed)  # 26 / 20
    reasons = {c["reason"] for c in result["checks"] if c["verdict"] == "not measured"}
    assert {"cyclictest is not installed", "it does not start", "no block was measured"} <= reasons


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "twin", "pyton"], "Unknown part 'pyton'. Did you mean 'python'?"),
        (["--skip", "estopp"], "Unknown part 'estopp'. Did you mean 'estop'?"),
        (["--only", "plant", "--skip", "plant"], "--skip leaves nothing"),
        (["--blocks", "0"], "--blocks is 0"),
        (["--seconds", "0.01"], "--seconds is 0.01"),
        (["--conditions", "busy"], "invalid choice: 'busy'"),
    ],
)
def test_a_wrong_option_ends_in_a_message(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        program.parse_arguments(arguments)
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_parts_stand_for_what_they_are_made_of() -> None:
    options = program.parse_arguments(["--only", "recording", "loop", "estop", "--skip", "thread", "torch"])
    assert options.only == ["twin", "bhd", "python", "cyclictest", "estop"]
    assert program.parse_arguments([]).only == list(NAMES)
    assert program.parse_arguments(["--skip", "recorder"]).only == [
        name for name in NAMES if name not in ("running", "stopped", "drops")
    ]


def test_only_a_full_run_is_quotable() -> None:
    assert program.quotable(program.parse_arguments([]))
    assert program.quotable(program.parse_arguments(["--blocks", "8", "--seconds", "20"]))
    assert not program.quotable(program.parse_arguments(["--quick"]))
    assert not program.quotable(program.parse_arguments(["--blocks", "5"]))
    quick = program.parse_arguments(["--quick", "--seconds", "3"])
    assert (quick.blocks, quick.seconds) == (program.QUICK["blocks"], 3)


def test_shares_of_the_processors() -> None:
    before = CpuTimes.parse("cpu  100 10 40 800 50 0 0 0 7 7\ncpu0 1 1 1 1 1 1 1 1 1 1\n")
    after = CpuTimes.parse("cpu  140 10 50 830 60 0 0 10 9 9\ncpu0 1 1 1 1 1 1 1 1 1 1\n")
    assert before.total == 1000
    assert after.shares_since(before) == pytest.approx((0.5, 0.1))
    assert after.shares_since(after) == (0.0, 0.0)


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def children_of(pid: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[1]) == pid:
            found.append(int(path.parent.name))
    return found


def test_the_load_ends_with_its_block_also_when_that_fails() -> None:
    before = set(children_of(os.getpid()))
    started: set[int] = set()

    def fail_under_load() -> None:
        with cpu_load(30.0) as load:
            started.update(set(children_of(os.getpid())) - before)
            assert len(started) == load.cores
            raise RuntimeError("a block failed")

    with pytest.raises(RuntimeError, match="a block failed"):
        fail_under_load()
    assert started
    assert not any(alive(pid) for pid in started)


def test_a_load_that_ends_early_is_an_error() -> None:
    before = set(children_of(os.getpid()))

    def lose_one() -> None:
        with cpu_load(30.0):
            one = sorted(set(children_of(os.getpid())) - before)[-1:]
            os.kill(one[0], signal.SIGKILL)
            wait_until_gone(one)

    with pytest.raises(LoadError, match="ended before its time"):
        lose_one()
    assert set(children_of(os.getpid())) == before


def test_the_load_ends_when_its_parent_is_killed() -> None:
    text = (
        "import time\nfrom benchmarks.realtime.load import cpu_load\n"
        "with cpu_load(60.0):\n    print('up', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", text], cwd=ROOT, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"up\n"
        children = children_of(parent.pid)
        assert children
        parent.kill()
    wait_until_gone(children)


def wait_until_gone(pids: list[int]) -> None:
    until(lambda: not any(alive(pid) for pid in pids))
