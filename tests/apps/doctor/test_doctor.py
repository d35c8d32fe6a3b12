"""bhd-doctor: what each check says about a healthy and about a broken machine; the grid on a virtual clock."""

import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from bhd_lerobot.apps.doctor import checks, latency_test, trials
from bhd_lerobot.apps.doctor.checks import ROWS, Finding, Status
from bhd_lerobot.apps.doctor.robot import RobotDescription
from bhd_lerobot.apps.doctor.trials import Outcome, run_trials
from bhd_lerobot.cli.doctor import main
from bhd_lerobot.realtime.privileges import GRANT_BANDWIDTH
from bhd_lerobot.robots.config_arm import SO101Config
from tests.cases import each_case
from tests.forks import Fork

ROOT = Path(__file__).resolve().parents[3]
GIB = 2**30


def value(of: Any, output: str = "") -> Outcome:
    return Outcome("value", value=of, output=output)


def failed(kind: Any, error: str, output: str = "") -> Outcome:
    return Outcome(kind, error=error, output=output)


def grants(**refused: str) -> Outcome:
    """All is granted but what is named, with its remedy; "_" stands for a space."""
    names = ("collector", "memory lock", "cpu latency", "timer slack", "scheduler")
    remedies = {name: refused.get(name.replace(" ", "_"), "") for name in names}
    return value(
        [
            {"name": n, "wanted": "w", "granted": not remedies[n], "detail": f"{n} now", "remedy": remedies[n]}
            for n in names
        ]
    )


def latency(p99: float) -> Outcome:
    histogram = [1000, *[0] * len(latency_test.BINS_US)]
    numbers = {"rate": 1000, "points": 1000, "missed": 0, "p50": p99 / 2, "p99": p99, "max": 2 * p99}
    bins = {"histogram": histogram, "bins_us": latency_test.BINS_US}
    return value({**numbers, **bins, "grants": grants().value})


PLUGINS = value(
    {
        "robots": ["so101", "turtlebot3", "ur5"],
        "teleoperators": ["bhd_brain", "bhd_keyboard_arm", "bhd_keyboard_base"],
        "bodies": ["turtlebot3", "ur5"],
        "failed": [],
    }
)
IMAGE = value({"spread": 70, "driver": "llvmpipe"})
VIDEO = value({"bytes": 3000, "pyav": "15.1.0", "libavcodec": "61.19.101", "shared": None})


TRIALS = r"""
import os, sys, time
from bhd_lerobot.apps.doctor import trials
from bhd_lerobot.errors import ConfigError

def noisy():
    os.write(1, b"a library prints\n\n")
    os.write(2, "and complains: \xb5s\n".encode("latin-1"))
    return 7

def crash():
    noisy()
    os.abort()

def refuse(rate):
    raise ConfigError(f"The rate is {rate}.")

trials.TRIALS |= {
    "noisy": noisy, "crash": crash, "refuse": refuse, "fail": lambda: int("x"), "exit": lambda: os._exit(3),
    "hang": lambda: time.sleep(3600), "heavy": lambda: sorted({"torch", "lerobot", "mujoco"} & set(sys.modules)),
}
trials.main(sys.argv[1])
"""


@pytest.fixture
def more_trials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the child process know trials of ours."""
    (tmp_path / "doctor_trials.py").write_text(TRIALS)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.setattr(trials, "__name__", "doctor_trials")


def test_whatever_happens_in_a_process_is_an_outcome_and_the_rest_is_tried(more_trials, capfd):
    names = (["noisy"], ["refuse", 0], ["crash"], ["fail"], ["exit"], ["noisy"])
    noisy, refuse, crash, fail, ended, again = run_trials(names)
    assert (noisy.kind, noisy.value, noisy.error) == ("value", 7, "")
    assert noisy.output.startswith("and complains: ")
    assert refuse == failed("error", "The rate is 0.")
    assert (crash.kind, crash.error) == ("crash", "ended by SIGABRT")
    assert crash.output.startswith("and complains: ")
    assert fail == failed("error", "ValueError: invalid literal for int() with base 10: 'x'")
    assert ended == failed("crash", "ended with status 3")
    assert again == noisy
    assert capfd.readouterr() == ("", "")


def test_a_process_that_does_not_answer_is_killed(more_trials: None) -> None:
    assert run_trials([["hang"]], timeout_s=1.0) == [failed("timeout", "no answer in 1 s")]


def test_measuring_for_real_imports_nothing_heavy(more_trials: None) -> None:
    tested, heavy = run_trials([["latency test", 1000, 0.2], ["heavy"]])
    assert tested.kind == "value", tested
    assert heavy.value == []
    measured = tested.value
    assert measured["points"] == 200
    assert sum(measured["histogram"]) + measured["missed"] == 200
    assert 0 <= measured["p50"] <= measured["p99"] <= measured["max"]
    assert measured["grants"][-1]["name"] == "scheduler"


def test_real_trials_are_understood() -> None:
    rights, ffmpeg, opengl = run_trials([["rights"], ["ffmpeg"], ["opengl"]])
    plugins = value(trials.list_plugins())
    assert [one.check for one in checks.check_rights(rights)] == ["scheduler", "memory lock", "cpu latency"]
    assert checks.check_opengl(opengl)[0].status in (Status.OK, Status.WARNING)  # some machines have no OpenGL
    for finding in (*checks.check_ffmpeg(ffmpeg), *checks.check_plugins(plugins)):
        assert finding.status is Status.OK, finding
        assert finding.found


def test_the_summary_counts_in_bins_and_takes_quantiles() -> None:
    summary = latency_test.summarise([5_000] * 98 + [10_000, 10_001], 1000, 100)
    assert summary["histogram"] == [99, 1, *[0] * 9]
    assert (summary["p50"], summary["p99"], summary["max"]) == pytest.approx((5e-6, 10e-6, 10.001e-6))
    assert latency_test.summarise([11_000_000], 1000, 1)["histogram"][-1] == 1


def kernel_folder(folder: Path, runtime: int = 950_000) -> Path:
    (folder / "sched_rt_runtime_us").write_text(f"{runtime}\n")
    (folder / "sched_rt_period_us").write_text("1000000\n")
    return folder


def clock_folder(folder: Path, source: str = "tsc") -> Path:
    (folder / "current_clocksource").write_text(f"{source}\n")
    (folder / "available_clocksource").write_text("tsc hpet acpi_pm \n")
    return folder


def ticking(step: float) -> Callable[[], float]:
    times = iter((0.0, step))
    return lambda: next(times)


HEALTHY: dict[str, Callable[[Path], list[Finding]]] = {
    "Python": lambda _: checks.check_python(),
    "versions": lambda _: checks.check_versions(),
    "plug-ins": lambda _: checks.check_plugins(PLUGINS),
    "OpenGL": lambda _: checks.check_opengl(IMAGE),
    "FFmpeg": lambda _: checks.check_ffmpeg(VIDEO),
    "rights": lambda _: checks.check_rights(grants()),
    "kernel": lambda _: checks.check_kernel("6.12", "#1 SMP PREEMPT_RT Debian"),
    "old kernel": lambda _: checks.check_kernel("4.19", "#1 SMP PREEMPT RT"),
    "RT throttling": lambda folder: checks.check_throttling(kernel_folder(folder)),
    "no RT throttling": lambda folder: checks.check_throttling(folder / "none"),
    "clock source": lambda folder: checks.check_clock(clock_folder(folder)),
    "kvm": lambda folder: checks.check_clock(clock_folder(folder, "kvm-clock")),
    "no clock source": lambda folder: checks.check_clock(folder / "none"),
    "shared memory": lambda folder: checks.check_shared_memory(folder, lambda _: GIB),
    "disk": lambda folder: checks.check_disk(folder / "new", lambda _: 50 * GIB, ticking(0.1)),
    "latency test": lambda _: checks.check_latency(latency(499e-6), {"ur5": 500}, 0.02),
}


@each_case("name", HEALTHY)
def test_nothing_is_wrong_with_a_healthy_machine(name: str, tmp_path: Path) -> None:
    findings = HEALTHY[name](tmp_path)
    assert findings
    for finding in findings:
        assert finding.status is Status.OK, finding
        assert finding.found
        assert finding.symptom == finding.cause == finding.remedy == ""
    assert list(tmp_path.rglob("*bhd-doctor*")) == []


PLUGIN = """
from dataclasses import dataclass
import bhd_lerobot as bhd
from lerobot.robots.config import RobotConfig
import lerobot.robots.so_follower

@RobotConfig.register_subclass("alpha_robot")
@dataclass
class AlphaConfig(RobotConfig):
    pass

@dataclass
class Config(bhd.BrainConfig):
    pass

bhd.BrainConfig.register_subclass("alpha_brain")(Config)
"""


def list_plugins(folder: Path) -> None:
    """List plug-ins in a process of its own, which also finds those of a folder."""
    sys.path.insert(0, str(folder))
    (folder / "found").write_text(json.dumps(trials.list_plugins()))


def test_each_plugin_is_named_with_what_it_registered_or_why_it_failed(tmp_path: Path) -> None:
    modules = {
        "lerobot_robot_alpha": PLUGIN,
        "lerobot_policy_beta": "import lerobot_robot_alpha",  # what that has is not its own
        "lerobot_camera_gamma": "raise ImportError('no driver')",
        "lerobot-robot-delta": "raise AssertionError('LeRobot does not import it')",
    }
    for name, text in modules.items():
        (tmp_path / f"{name.replace('-', '_')}.py").write_text(text, encoding="utf-8")
        about = tmp_path / f"{name.replace('-', '_')}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    assert Fork(list_plugins, tmp_path).wait() == 0
    findings = checks.check_plugins(value(json.loads((tmp_path / "found").read_text())))
    assert [one.found for one in findings if one.status is Status.OK][1:] == [
        "lerobot_policy_beta 1.0: nothing",
        "lerobot_robot_alpha 1.0: robot alpha_robot, brain alpha_brain",
    ]
    causes = [one.cause for one in findings if one.status is not Status.OK]
    assert len(causes) == 2
    assert causes[0].startswith("The plug-in lerobot-robot-delta is not imported: ")
    assert "'lerobot_robot_delta'" in causes[0]
    assert causes[1].startswith("The plug-in lerobot_camera_gamma cannot be imported")
    assert causes[1].endswith("ImportError: no driver")


def installed(**versions: str | None) -> Callable[[str], str]:
    """Return a `version_of` that differs from what is installed here; None is not installed."""

    def version_of(name: str) -> str:
        version = versions[name] if name in versions else metadata.version(name)
        if version is None:
            raise metadata.PackageNotFoundError(name)
        return version

    return version_of


def full(_: Path) -> int:
    raise OSError(28, "No space left on device")


BROKEN: dict[str, tuple[Callable[[Path], list[Finding]], str]] = {
    "python": (lambda _: checks.check_python("3.11.4"), "3.11.4"),
    "package.missing": (lambda _: checks.check_versions(version_of=installed(mujoco=None)), "`mujoco`"),
    "package.version": (
        lambda _: checks.check_versions(version_of=installed(lerobot="0.5.1")),
        "`lerobot` is 0.5.1; required: <0.7,>=0.6.1",
    ),
    "plugins.error": (lambda _: checks.check_plugins(failed("error", "ImportError: no torch")), "no torch"),
    "plugins.missing": (
        lambda _: checks.check_plugins(
            value({"robots": ["ur5"], "teleoperators": list(checks.TELEOPERATORS[1:])}, "ImportError: pin")
        ),
        "the robot turtlebot3, the teleoperator bhd_brain: `lerobot_robot_bhd` is not installed, or its import failed. "
        "ImportError: pin",
    ),
    "plugins.failed": (
        lambda _: checks.check_plugins(value({**PLUGINS.value, "failed": ["The plug-in x cannot be imported."]})),
        "The plug-in x cannot be imported.",
    ),
    "opengl.missing": (lambda _: checks.check_opengl(failed("error", "Tried egl: no display")), "Tried egl"),
    "opengl.crash": (
        lambda _: checks.check_opengl(failed("crash", "ended by SIGSEGV", "libEGL warning")),
        "ended by SIGSEGV (libEGL warning)",
    ),
    "opengl.blank": (lambda _: checks.check_opengl(value({"spread": 0, "driver": "odd"})), "odd"),
    "ffmpeg": (lambda _: checks.check_ffmpeg(failed("error", "ImportError: av")), "ImportError: av"),
    "scheduler.rights": (lambda _: checks.check_rights(grants(scheduler="ask")), "setcap"),
    "scheduler.bandwidth": (lambda _: checks.check_rights(grants(scheduler=GRANT_BANDWIDTH)), "cgroup"),
    "scheduler.error": (lambda _: checks.check_rights(failed("crash", "ended by SIGSYS")), "ended by SIGSYS"),
    "memory": (lambda _: checks.check_rights(grants(memory_lock="ask")), "memlock"),
    "cpu latency": (lambda _: checks.check_rights(grants(cpu_latency="ask")), "udev"),
    "kernel": (lambda _: checks.check_kernel("6.12", "#1 SMP PREEMPT_DYNAMIC Debian"), "PREEMPT_RT"),
    "throttling.off": (lambda folder: checks.check_throttling(kernel_folder(folder, -1)), "-1"),
    "throttling.low": (lambda folder: checks.check_throttling(kernel_folder(folder, 100_000)), "only 10 % of"),
    "clock": (lambda folder: checks.check_clock(clock_folder(folder, "hpet")), "with hpet"),
    "shm.missing": (lambda folder: checks.check_shared_memory(folder / "none"), "No such file or directory"),
    "shm.small": (lambda folder: checks.check_shared_memory(folder, lambda _: 64 * 2**20), "64 MiB"),
    "disk.denied": (lambda folder: checks.check_disk(folder, full), "No space left on device"),
    "disk.full": (lambda folder: checks.check_disk(folder, lambda _: 2**29), "512 MiB"),
    "disk.low": (lambda folder: checks.check_disk(folder, lambda _: 2 * GIB, ticking(0.1)), "2.0 GiB"),
    "disk.slow": (lambda folder: checks.check_disk(folder, lambda _: 50 * GIB, ticking(16.0)), "2 MB/s"),
    "latency.late": (lambda _: checks.check_latency(latency(500e-6), {"ur5": 500}, 0.02), "50 % of the period"),
    "latency.missed": (lambda _: checks.check_latency(latency(1e-3), {"ur5": 500}, 0.02), "at 500 Hz ticks are missed"),
    "latency.stopped": (lambda _: checks.check_latency(latency(9.1e-3), {"ur5": 500}, 0.02), "older than 20 ms"),
    "latency.error": (lambda _: checks.check_latency(failed("timeout", "no answer in 70 s"), {}, 0.02), "no answer"),
}


def test_every_row_has_its_test() -> None:
    assert set(BROKEN) == set(ROWS)


@pytest.mark.law
@each_case("key", ROWS)
def test_what_is_wrong_is_reported_with_symptom_cause_and_remedy(key: str, tmp_path: Path) -> None:
    check, part = BROKEN[key]
    findings = [finding for finding in check(tmp_path) if finding.status is not Status.OK]
    [finding] = findings
    row = ROWS[key]
    assert (finding.check, finding.status) == (row.check, row.status)
    texts = (finding.symptom, finding.cause, finding.remedy)
    for text, pattern in zip(texts, (row.symptom, row.cause, row.remedy), strict=True):
        assert text.startswith(pattern.partition("{")[0])
        assert "{" not in text
        assert text
    assert part in "\n".join(texts)


@pytest.mark.parametrize(
    ("version", "causes"),
    [
        ("1.5", []),
        # A second line of the metadata narrows the first.
        ("0.9", ["`brain` is 0.9; required: <2,>=1"]),
        ("2.0", ["`brain` is 2.0; required: <2,>=1"]),
    ],
)
def test_every_requirement_counts(version: str, causes: list[str], tmp_path: Path, monkeypatch: Any) -> None:
    text = """Metadata-Version: 2.4
Name: fake-hand
Version: 1
Requires-Dist: Brain[fast]<2
Requires-Dist: brain>=1
Requires-Dist: other>=9; python_version < "3"
Requires-Dist: brain<1.2; extra == "exact"
Requires-Dist: brain[slow]; extra == "test"
Requires-Dist: absent>=3; extra == "test"
Provides-Extra: exact
Provides-Extra: test
"""
    (tmp_path / "fake_hand-1.dist-info").mkdir()
    (tmp_path / "fake_hand-1.dist-info" / "METADATA").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(checks, "DISTRIBUTION", "fake-hand")
    findings = checks.check_versions(("brain",), installed(brain=version, absent=None))
    assert [finding.cause for finding in findings if finding.status is not Status.OK] == causes
    if not causes:
        assert [finding.found for finding in findings] == [f"brain {version}, required: <2,>=1"]


def test_the_documentation_has_the_same_table() -> None:
    text = (ROOT / "docs" / "how_to" / "troubleshooting.md").read_text(encoding="utf-8")
    begin, end = text.index("<!-- doctor: begin"), text.index("<!-- doctor: end -->")
    table = text[text.index("\n", begin) + 1 : end]
    wanted = ["| check | | symptom | cause | remedy |", "|---|---|---|---|---|"]
    for row in ROWS.values():
        texts = [re.sub(r"\{\w+\}", "…", text) for text in (row.symptom, row.cause, row.remedy)]
        wanted.append(f"| {row.check} | {row.status} | {' | '.join(texts)} |")
    assert table.splitlines() == wanted, "\n".join(wanted)
    assert all(line.count(" | ") == 4 for line in table.splitlines()[2:])


class FakeTrials:
    def __init__(self, answers: dict[str, Outcome] | None = None) -> None:
        self.answers = {
            "rights": grants(),
            "ffmpeg": VIDEO,
            "opengl": IMAGE,
            "plug-ins": PLUGINS,
            "latency test": latency(50e-6),
            **(answers or {}),
        }
        self.requested: list[str] = []

    def __call__(self, requested: Sequence[Sequence[Any]], timeout_s: float) -> list[Outcome]:
        self.requested += [one[0] for one in requested]
        return [self.answers[one[0]] for one in requested]


def run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, *arguments: str, answers: dict[str, Outcome] | None = None
) -> tuple[int, dict[str, Any]]:
    status = main(["--json", f"--root={tmp_path}", *arguments], FakeTrials(answers))
    return status, json.loads(capsys.readouterr().out)


def test_a_problem_makes_the_exit_status_and_a_warning_does_not(capsys, tmp_path):
    def statuses(report: dict[str, Any], check: str) -> list[str]:
        return [one["status"] for one in report["findings"] if one["check"] == check]

    status, report = run(capsys, tmp_path, answers={"opengl": failed("error", "no EGL")})
    assert statuses(report, "OpenGL") == ["warning"]
    # This machine may have a problem of its own, such as a full disk.
    assert status == int(any(one["status"] == "problem" for one in report["findings"]))
    status, report = run(capsys, tmp_path, answers={"opengl": failed("crash", "ended by SIGSEGV")})
    assert statuses(report, "OpenGL") == ["problem"]
    assert status == 1


@pytest.mark.parametrize(
    ("worst_ms", "statuses"), [(14.9, ["warning"] * 2), (17, ["problem", "warning"]), (18.1, ["problem"] * 2)]
)
def test_one_wake_up_that_is_later_than_the_plant_waits_is_a_problem(capsys, tmp_path, worst_ms, statuses):
    """The plant waits 20 ms for a command, and the last was written a period before."""
    outcome = latency(worst_ms / 2e3)
    status, report = run(capsys, tmp_path, "--realtime", answers={"latency test": outcome})
    assert [one["status"] for one in report["findings"] if one["check"] == "latency test"] == statuses
    assert status == 1 or "problem" not in statuses


def test_the_printed_report_has_findings_histogram_and_remedies(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    fake = FakeTrials({"rights": grants(scheduler="ask"), "opengl": failed("crash", "[E] ended by SIGSEGV")})
    assert main([f"--root={tmp_path}", "--realtime"], fake) == 1
    assert fake.requested == ["latency test", "rights", "ffmpeg", "opengl", "plug-ins"]
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert any("p99 50 µs" in line for line in lines)
    assert any(line.split()[:3] == ["≤", "10", "µs"] and "█" * 40 in line for line in lines)
    assert "problem: OpenGL" in text
    assert "[E] ended by SIGSEGV" in text  # square brackets are not markup
    # All is printed in lines of whole words; a command stands in one line, however narrow the terminal.
    assert all(len(line) <= 80 or "`" in line for line in lines)
    remedy = next(line for line in lines if "setcap" in line)
    assert "setcap cap_sys_nice,cap_ipc_lock+ep " + os.path.realpath(sys.executable) in remedy


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rate=5"], "--rate is 5; it must be from 10 to 10000."),
        (["--seconds=0"], "--seconds is 0.0; it must be above 0 and at most 600."),
        (["--seconds=nan"], "--seconds is nan"),
        (["--rate=100", "--seconds=5"], "5 s at 100 Hz are 500 wake-ups; a 99th percentile needs 1000: --seconds=10"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    fake = FakeTrials()
    assert main(["--realtime", *arguments], fake) == 2
    assert message in capsys.readouterr().err
    assert fake.requested == []


@pytest.mark.parametrize("name", ["robot.foo", "folder"])
def test_a_picture_of_a_robot_that_cannot_be_written_is_named(name: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "folder").mkdir()
    assert main(["--robot.type=so101", f"--picture={tmp_path / name}"]) == 2
    assert re.search(r"picture is .*, which cannot be written", " ".join(capsys.readouterr().err.split()))


def test_a_picture_is_written_into_the_folder_of_the_user() -> None:
    assert RobotDescription(SO101Config(), Path("~/robot.png")).picture == Path.home() / "robot.png"
