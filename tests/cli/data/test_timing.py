"""The timing in `bhd-data info`: of a recording on the wall clock, of one in simulated time, and of what is neither."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.rollout.tolerance import FrameTiming, TimingTolerance, late_frames
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


def test_in_lockstep_the_tolerance_has_no_effect(drives, tmp_path):
    """A scan is up to 0.2 s old here, and still no frame is late, no episode is bad and no byte is another one."""
    strict = {"timing__max_age_s": 1e-6, "timing__max_late_frames": 0.0, "timing__reject": "true"}
    result, _ = run_record(tmp_path / "strict", seed=4, **strict)
    assert result.recorded == 3
    columns = data_columns(tmp_path / "strict")
    assert max(columns[keys.AGE]) > 0.01
    for key in keys.PUNCTUALITY:
        assert not any(columns[key])
    assert columns == data_columns(drives)


def test_info_holds_what_was_measured(measured, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main.main(["info", str(measured)]) == 0
    text = capsys.readouterr().out
    for part in (
        *("wall clock: 6 of 180 frames (3.3 %)", "3600 run, 0 skipped, 0 overran; 9 frames or states lost"),
        *("max 1.50 ms, tolerated 1.00 ms", "the period is 2.00 ms", "granted, episodes 0-1", "granted, episode 2"),
        *("raise memlock [KiB]", "rate error / ticks"),
    ):
        assert part in text
    assert main.main(["info", str(measured), "--json"]) == 0
    stored = [json.loads(one["metadata"]["timing"]) for one in json.loads(capsys.readouterr().out)["episodes"]]
    assert [one["late_frames"] for one in stored] == [2, 2, 2]


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


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"timing": "{"}, "not JSON"),
        ({"timing": '{"overruns": 0}'}, "not complete"),
        ({"timing": "[]"}, "not complete"),
        ({"realtime": "{}"}, "no list of grants"),
    ],
)
def test_an_invalid_timing_is_named(tmp_path, capsys, metadata, words):
    columns, _ = make_episode(0)
    save(tmp_path / "d", [(columns, metadata)])
    assert main.main(["info", str(tmp_path / "d")]) == 2
    assert words in capsys.readouterr().err
