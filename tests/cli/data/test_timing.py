"""bhd-data timing: what it says of a recording on the wall clock, of one in simulated time, and of what is neither."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.cli.data import main
from bhd_lerobot.control.timing import TimingStatistics
from bhd_lerobot.control.tolerance import FrameTiming, TimingTolerance, late_frames
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.timing import report as timing_report
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetError
from tests.recording.support import data_columns, run_record

RATES = Rates(500, 500, 25)
FRAMES, LATE = 60, (17, 42)
FEATURES = {key: {"dtype": dtype, "shape": (1,), "names": None} for key, (dtype, _) in keys.SCALARS.items()}
GRANTS = [
    {"name": "SCHED_FIFO", "wanted": "priority 80", "granted": True, "detail": "", "remedy": ""},
    {"name": "mlockall", "wanted": "all", "granted": False, "detail": "refused", "remedy": "raise memlock [KiB]"},
]


def make_episode(seed):
    """Return columns and summary of an episode on the wall clock, with as many late frames as LATE."""
    rng = np.random.default_rng(seed)
    per_frame, period = RATES.ticks_per_frame, 10**9 // RATES.control_hz
    statistics = TimingStatistics(period)
    lateness = rng.integers(10_000, 60_000, FRAMES * per_frame)
    lateness[[frame * per_frame + 3 for frame in LATE]] = 1_500_000
    for k, late in enumerate(lateness.tolist()):
        statistics.add(k * period, k * period + late, k * period + late + 300_000)
    columns = {key: np.zeros(FRAMES, dtype) for key, (dtype, _) in keys.SCALARS.items()}
    columns[keys.TIME] = np.arange(FRAMES) / RATES.fps
    columns[keys.AGE] = rng.uniform(0.001, 0.002, FRAMES).astype(np.float32)
    columns[keys.LATENESS] = (lateness.reshape(FRAMES, -1).max(axis=1) / 1e9).astype(np.float32)
    columns[keys.INFERENCE_TIME] = rng.uniform(0.005, 0.01, FRAMES).astype(np.float32)
    measured = FrameTiming(columns[keys.TIME], columns[keys.AGE], columns[keys.LATENESS], columns[keys.SKIPPED])
    columns[keys.LATE] = late_frames(measured, TimingTolerance(), RATES)
    return columns, statistics.summary(
        clock="realtime",
        age=columns[keys.AGE],
        inference_time=columns[keys.INFERENCE_TIME],
        late=columns[keys.LATE],
        drops=3,
        tolerated=TimingTolerance().limits(RATES),
    )


def save(root, episodes, features=FEATURES):
    with DatasetRecorder.create("t/t", RATES.fps, features, robot_type="ur5", root=root) as recorder:
        for columns, metadata in episodes:
            writer = recorder.begin_episode()
            writer.set_columns({key: columns[key] for key in features})
            recorder.save(writer, task="x", metadata=metadata)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    root = tmp_path_factory.mktemp("timing") / "measured"
    episodes = []
    for seed in range(3):
        columns, summary = make_episode(seed)
        grants = GRANTS if seed < 2 else GRANTS[:1]
        episodes.append((columns, {"timing": json.dumps(asdict(summary)), "realtime": json.dumps(grants)}))
    save(root, episodes)
    return root


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    root = tmp_path_factory.mktemp("timing") / "simulated"
    run_record(root, seed=4)
    return root


def test_in_lockstep_the_tolerance_has_no_effect(simulated, tmp_path):
    """A scan is up to 0.2 s old here, and still no frame is late, no episode is bad and no byte is another one."""
    strict = {"timing__max_age_s": 1e-6, "timing__max_late_frames": 0.0, "timing__reject": "true"}
    result, _ = run_record(tmp_path / "strict", seed=4, **strict)
    assert result.recorded == 3
    columns = data_columns(tmp_path / "strict")
    assert max(columns[keys.AGE]) > 0.01
    for key in keys.PUNCTUALITY:
        assert not any(columns[key])
    assert columns == data_columns(simulated)


@pytest.mark.law
def test_all_episodes_together_are_sums_maxima_and_bounds(measured):
    report = timing_report.load_timing(measured)
    parts, total = [episode.summary for episode in report.episodes], report.total.summary
    for name in ("ticks", "skipped", "overruns", "frames", "late_frames", "drops"):
        assert getattr(total, name) == sum(getattr(part, name) for part in parts)
    for name in ("lateness_p99", "lateness_max", "duration_p50", "age_max", "inference_max"):
        assert getattr(total, name) == max(getattr(part, name) for part in parts)
    assert len(report.total.intervals) == 3 * (FRAMES - 1)  # from one episode to the next there is none
    assert total.tolerated == parts[0].tolerated
    changes = ({"rate_error": 0.5}, {"rate_error": -2.0}, {"rate_error": 1.0, "tolerated": {"lateness": 1.0}})
    pairs = zip(report.episodes, changes, strict=True)
    episodes = tuple(replace(one, summary=replace(one.summary, **change)) for one, change in pairs)
    total = replace(report, episodes=episodes).total.summary
    assert (total.rate_error, total.tolerated) == (-2.0, {})  # the largest, and no limit where they differ


@pytest.mark.figures
def test_the_tables_hold_what_was_measured(measured, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "170")
    image = tmp_path / "new" / "t.png"
    assert main.main(["timing", str(measured), "--output", str(image)]) == 0
    text = capsys.readouterr().out
    for part in (
        "wall clock",
        "3600 run",
        "6 of 180 (3.3 %)",
        "max 1.50 ms",
        "tolerated 1.00 ms",
        "9 frames or states",
    ):
        assert part in text
    for part in ("granted, episodes 0-1", "granted, episode 2", "raise memlock [KiB]", "lateness [ms]", "rate"):
        assert part in text
    assert str(image) in text.replace("\n", "")
    assert min(Image.open(image).size) > 500


def test_json_holds_everything_and_draws_only_if_asked(measured, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(["timing", str(measured), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [value["index"] for value in values["episodes"]] == [0, 1, 2]
    assert values["clock"] == "realtime"
    assert values["all"]["late_frames"] == 6
    assert values["episodes"][1]["realtime"] == GRANTS
    assert values["episodes"][0]["interval"]["max"] == pytest.approx(1 / RATES.fps)
    assert list(tmp_path.iterdir()) == []
    assert main.main(["timing", str(measured), "--episode", "1"]) == 0
    assert "2 of 60" in capsys.readouterr().out
    assert (tmp_path / "outputs" / "timing" / "measured_episode_000001.png").exists()
    assert main.main(["timing", str(measured), "--json", "--output", "t.pdf"]) == 0
    json.loads(capsys.readouterr().out)
    assert (tmp_path / "t.pdf").is_file()


def test_a_dataset_from_before_these_columns_loads(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "170")
    columns, _ = make_episode(0)
    old = {"ticks": 1200, "overruns": 0, "lateness_p50": 0.0, "lateness_p99": 0.0, "lateness_max": 0.0}
    old["duration_max"] = 0.0
    features = {k: v for k, v in FEATURES.items() if k not in (keys.SKIPPED, keys.INFERENCE_TIME, keys.LATE)}
    columns[keys.LATENESS][:] = 0
    save(tmp_path / "old", [(columns, {"timing": json.dumps(old)})], features)
    assert main.main(["info", str(tmp_path / "old")]) == 0
    assert "late frames" in capsys.readouterr().out
    assert main.main(["timing", str(tmp_path / "old"), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["clock"], values["all"]["frames"], values["all"]["late_frames"]) == ("lockstep", FRAMES, 0)


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"other": "x"}, "has no timing"),
        ({"timing": "{"}, "not JSON"),
        ({"timing": '{"overruns": 0}'}, "not complete"),
        ({"timing": "[]"}, "not complete"),
    ],
)
def test_a_missing_or_invalid_timing_is_named(tmp_path, metadata, words):
    columns, _ = make_episode(0)
    save(tmp_path / "d", [(columns, metadata)])
    with pytest.raises(DatasetError, match=words):
        timing_report.load_timing(tmp_path / "d")


def test_a_dataset_of_another_program(tmp_path, capsys):
    feature = {"x": {"dtype": "float32", "shape": (1,), "names": None}}
    save(tmp_path / "d", [({"x": np.zeros(5, np.float32)}, {})], feature)
    assert main.main(["info", str(tmp_path / "d")]) == 0
    capsys.readouterr()
    assert main.main(["timing", str(tmp_path / "d")]) == 2
    assert "another program recorded it" in capsys.readouterr().err
