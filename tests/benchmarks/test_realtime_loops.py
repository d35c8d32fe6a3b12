import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.realtime.cases import (
    PERIOD_NS,
    CaseError,
    cyclictest_case,
    parse_cyclictest,
    python_case,
    run_program,
    run_recorder,
)
from benchmarks.realtime.loops import run_grid
from benchmarks.realtime.stage import settled_robot
from benchmarks.realtime.statistics import Samples
from benchmarks.realtime.twin import build, find_compiler, save_model, twin_case

ROOT = Path(__file__).resolve().parents[2]
PERIOD = 1000


class VirtualClock:
    """Time that passes only when a loop sleeps or works."""

    def __init__(self, late: Callable[[int], int], work: Callable[[int], int]) -> None:
        self.ns = 123
        self.late, self.work = late, work
        self.ticks = self.sleeps = 0

    def now(self) -> int:
        return self.ns

    def sleep(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9) + self.late(self.sleeps)
        self.sleeps += 1

    def tick(self) -> None:
        self.ns += self.work(self.ticks)
        self.ticks += 1

    def run(self, points: int) -> tuple[np.ndarray, int]:
        records = np.zeros((points, 3), np.int64)
        executed, skipped = run_grid(self.tick, PERIOD, records, self.now, self.sleep)
        assert executed == self.ticks
        assert executed + skipped >= points
        return records[:executed], skipped


def test_lateness_does_not_add_up() -> None:
    records, skipped = VirtualClock(lambda _: 70, lambda _: 300).run(50)
    due, woke, ended = records.T
    assert skipped == 0
    assert np.all(np.diff(due) == PERIOD)
    assert np.all(woke - due == 70)
    assert np.all(ended - woke == 300)


@pytest.mark.parametrize(("work", "left_out"), [(999, 0), (1000, 1), (1001, 1), (2500, 2), (7000, 7)])
def test_an_overrun_skips_the_points_that_have_passed_and_keeps_the_phase(work: int, left_out: int) -> None:
    clock = VirtualClock(lambda _: 0, lambda tick: work if tick == 4 else 100)
    records, skipped = clock.run(20)
    due = records[:, 0]
    assert skipped == left_out
    assert np.all((due - due[0]) % PERIOD == 0)
    assert due[5] - due[4] == (left_out + 1) * PERIOD
    assert np.all(records[:, 1] == due)  # and no tick starts late for it


@pytest.mark.parametrize(("work", "left_out"), [(999, 0), (1000, 1), (2100, 2), (50_000, 50)])
def test_what_passes_during_the_last_tick_is_skipped(work: int, left_out: int) -> None:
    records, skipped = VirtualClock(lambda _: 0, lambda tick: work if tick == 19 else 1).run(20)
    assert (len(records), skipped) == (20, left_out)
    error = Samples.from_records(records, PERIOD, skipped).count_error
    assert error is not None
    assert 0 < error <= 1


def test_the_twin_steps_the_same_physics_as_a_world(tmp_path: Path) -> None:
    save_model(tmp_path / "ur5.mjb")
    model = mujoco.MjModel.from_binary_path(str(tmp_path / "ur5.mjb"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    world = settled_robot(1000).world
    assert np.array_equal(data.ctrl, world.ctrl[0])
    assert model.nbody == world.copy_model(0).nbody
    for _ in range(50):
        mujoco.mj_step(model, data)
    world.step(50)
    # Not bit by bit: what the solver starts from is no part of a keyframe.
    assert np.allclose(data.qpos, world.qpos[0], rtol=0, atol=1e-12)
    assert np.allclose(data.qvel, world.qvel[0], rtol=0, atol=1e-12)
    assert data.ncon > 0, "no object stands on the table"


def assert_on_the_grid(program: list[str], out: Path, points: int) -> None:
    said = json.loads(run_program(program, 1.0))
    due, woke, ended = np.fromfile(out, np.int64).reshape(-1, 3).T
    assert len(due) + said["skipped"] == max(points, (ended[-1] - due[0]) // PERIOD_NS + 1)
    assert np.all((due - due[0]) % PERIOD_NS == 0)
    assert np.all(np.diff(due) > 0)
    assert np.all(woke >= due)
    assert np.all(ended > woke)
    assert said["scheduler"] == (
        "SCHED_OTHER" if any("SCHED_FIFO" in note for note in said["refused"]) else "SCHED_FIFO"
    )
    assert said.get("unwanted", []) == []


def test_the_python_loop_in_its_process(tmp_path: Path) -> None:
    out = tmp_path / "records"
    assert_on_the_grid(
        [sys.executable, "-m", "benchmarks.realtime.loops", str(out), "1000000", "60", "5", "80"], out, 60
    )


def test_the_twin(tmp_path: Path) -> None:
    try:
        find_compiler()
    except CaseError as error:
        pytest.skip(str(error))
    samples = twin_case(tmp_path).run(0.06)
    assert samples.count_error is not None
    assert 0 <= samples.count_error <= 1
    model, out = tmp_path / "ur5.mjb", tmp_path / "records"
    assert_on_the_grid([str(tmp_path / "twin"), str(model), str(out), "1000000", "60", "5", "80"], out, 60)


def test_the_twin_names_a_model_that_it_cannot_load(tmp_path: Path) -> None:
    try:
        program = build(tmp_path)
    except CaseError as error:
        pytest.skip(str(error))
    (tmp_path / "broken.xml").write_text("<mujoco><wrong/></mujoco>")
    with pytest.raises(CaseError, match=r"twin failed with exit status 2, saying: .*"):
        run_program([str(program), str(tmp_path / "broken.xml"), str(tmp_path / "out"), "1000000", "5", "0", "80"], 1.0)
    with pytest.raises(CaseError, match="usage: twin MODEL"):
        run_program([str(program)], 1.0)


def test_without_a_compiler_the_reason_and_the_remedy_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CaseError, match=r"no C\+\+ compiler \(.*package g\+\+.*CXX\)"):
        twin_case(tmp_path)
    with pytest.raises(CaseError, match="package rt-tests"):
        cyclictest_case()
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(CaseError, match="CXX names 'no-such-compiler'"):
        find_compiler()


def test_a_compiler_that_fails_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler = tmp_path / "sick"
    compiler.write_text("#!/bin/sh\necho 'twin.cpp:1: error: I am not well' >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(CaseError, match=r"sick does not compile the C\+\+ twin: .*I am not well"):
        build(tmp_path)


def test_cyclictests_histogram() -> None:
    samples = parse_cyclictest(
        "# /dev/cpu_dma_latency set to 0us\n# Histogram\n000014 000003\n000015 000000\n000016 000002\n"
        "# Total: 000000005\n# Min Latencies: 00014\n# Avg Latencies: 00023\n# Max Latencies: 00102\n"
        "# Histogram Overflows: 00001\n# Histogram Overflow at cycle number:\n# Thread 0: 00057\n"
    )
    assert samples.wake_ns.tolist() == [14_000] * 3 + [16_000] * 2 + [102_000]
    assert len(samples.duration_ns) == 0
    assert samples.count_error is None
    with pytest.raises(CaseError, match="no histogram"):
        parse_cyclictest("WARN: unable to change scheduling policy\n")


def test_a_program_that_fails_or_writes_nonsense_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match="does not start"):
        run_program([str(tmp_path / "missing")], 1.0)
    with pytest.raises(CaseError, match=r"exit status 3, saying: the last line"):
        run_program([sys.executable, "-c", "import sys; print('a\\nthe last line', file=sys.stderr); sys.exit(3)"], 1.0)
    out = tmp_path / "records"
    program = f"open({str(out)!r}, 'wb').write(bytes(16)); print('{{\"skipped\": 0, \"refused\": []}}')"
    with pytest.raises(CaseError, match="wrote 2 numbers"):
        run_recorder([sys.executable, "-c", program], out, 1.0)
    program = 'print(\'{"unwanted": ["torch"]}\')'
    with pytest.raises(CaseError, match="has imported torch"):
        run_recorder([sys.executable, "-c", program], out, 1.0)


def test_refused_scheduling_is_reported_and_the_loop_runs_on(tmp_path: Path) -> None:
    out = tmp_path / "records"
    program = (
        "import os, sys; sys.argv = ['loops', sys.argv[1], '1000000', '10', '2', '80']\n"
        "def refuse(pid, policy, param):\n"
        "    if policy != os.SCHED_OTHER: raise PermissionError(1, 'Operation not permitted')\n"
        "os.sched_setscheduler = refuse\n"
        "from benchmarks.realtime.loops import main; main()\n"
    )
    said = json.loads(run_program([sys.executable, "-c", program, str(out)], 1.0))
    assert said["scheduler"] == "SCHED_OTHER"
    assert "SCHED_FIFO: Operation not permitted" in said["refused"]
    records = np.fromfile(out, np.int64).reshape(-1, 3)
    assert 0 <= (Samples.from_records(records, PERIOD_NS, said["skipped"]).count_error or 0.0) <= 1
    assert len(records) + said["skipped"] >= 10


def test_the_cases_have_names_of_their_own(tmp_path: Path) -> None:
    names = [python_case(tmp_path, beside_busy_thread=busy).name for busy in (False, True)]
    assert len(set(names)) == 2


def test_the_loops_module_imports_no_torch() -> None:
    program = "import sys, benchmarks.realtime.loops; print(*{'torch', 'lerobot', 'rich'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []
