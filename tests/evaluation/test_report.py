"""The report: it is one file that needs no other, it says what the results say, and its charts are there."""

import base64
import errno
import hashlib
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.evaluation import plots, run
from bhd_lerobot.evaluation.metrics import EpisodeMetrics
from bhd_lerobot.evaluation.plots import OUTCOMES, notable_episodes
from bhd_lerobot.evaluation.results import summarise, write_json
from bhd_lerobot.evaluation.statistics import Estimate
from bhd_lerobot.evaluation.text import number, percent, sentences, verdict
from bhd_lerobot.rollout.plots import Trajectory
from bhd_lerobot.tasks.task import Event
from tests.evaluation.test_evaluate import FAILING, run_eval

pytestmark = pytest.mark.figures


def metrics(brain: str, episode: int, score: float, outcome: str = "success") -> EpisodeMetrics:
    return EpisodeMetrics(
        brain=brain, episode=episode, seed=2 * episode + 1, success=outcome == "success", outcome=outcome, score=score,
        reward=score, frames=10, length_s=1.0, path_m=2.0, jerk_mean=0.1, jerk_max=0.2, limits={"velocity": 1},
        watchdogs={"blocked": 0}, estops=0, faults=0, problem="", details={}, initial_state="", digest="",
    )  # fmt: skip


class Page(HTMLParser):
    """Every tag of a page with its attributes, and whether they close as they opened."""

    VOID = ("meta", "img", "br", "link", "input", "hr")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    result, _ = run_eval(folder, brains__still__type="noop", videos=None, n_episodes=4, n_envs=4, **FAILING)
    return result, result.report.read_text(encoding="utf-8")


def test_the_page_needs_nothing_but_itself(page):
    _, text = page
    parsed = Page(text)
    assert parsed.open == []
    for tag, attributes in parsed.tags:
        for name in ("src", "href", "poster"):
            if name in attributes:
                assert attributes[name].startswith(("data:", "#")), (tag, attributes[name][:60])
    assert not re.search(r"@import|url\(|<script|<link|https?://", re.sub(r'"data:[^"]*"', "", text))
    anchors = {attributes["href"][1:] for tag, attributes in parsed.tags if tag == "a"}
    assert anchors == {attributes["id"] for _, attributes in parsed.tags if "id" in attributes}
    assert all(attributes["alt"] for tag, attributes in parsed.tags if tag == "img")


def test_the_page_says_what_the_results_say(page):
    result, text = page
    for brain in result.results.brains.values():
        assert f"{brain.successes} of {brain.episodes}" in text
    for episode in result.results.episodes:
        row = (
            rf"<td>{episode.episode}</td><td>{episode.outcome}</td>.*{episode.seed}"
            rf".*--only=\[{episode.brain}\].*=\[{episode.episode}\]"
        )
        assert bool(re.search(row, text)) == (not episode.success)
    assert "lerobot 0.6" in text
    digest = re.search(r"<code>([0-9a-f]{64})</code>", text)
    assert digest is not None
    assert digest[1] == hashlib.sha256((result.output_dir / "results.json").read_bytes()).hexdigest()


def test_charts_are_well_formed_and_name_every_brain(page):
    result, text = page
    charts = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', text)
    assert len(charts) == 4  # forest, paired forest, outcomes, distributions
    for number_of, chart in enumerate(charts):
        root = ElementTree.fromstring(base64.b64decode(chart))
        words = " ".join(root.itertext())
        assert all(label in words for label in result.results.brains if (number_of, label) != (1, "old"))
    assert re.search(r'src="data:image/png;base64,[^"]{1000,}"', text)


def test_videos_are_h264_in_the_page_or_the_page_says_why_there_are_none(page):
    import av

    result, text = page
    videos = sorted((result.output_dir / "videos").glob("*.mp4"))
    if not videos:
        assert "No videos:" in text
        pytest.skip("no renderer here")
    by_brain = {label: [video for video in videos if video.name.startswith(label)] for label in result.results.brains}
    for label, one in result.results.brains.items():
        failed = one.episodes - one.successes
        assert len(by_brain[label]) == (min(failed, run.VIDEOS) or 1)
    with av.open(str(videos[0])) as container:
        assert container.streams.video[0].codec_context.name == "h264"
    assert text.count("<video") == len(videos) == text.count('poster="data:image/jpeg')


def test_of_one_brain_nothing_is_paired_problems_are_no_markup_and_large_videos_stay_beside_the_page(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("bhd_lerobot.evaluation.report.VIDEO_BYTES", 10)
    monkeypatch.setattr("bhd_lerobot.evaluation.run.measure", _with_problem(run.measure))
    result, _ = run_eval(tmp_path, only="[old]", videos=1, n_episodes=1, task__min_path_m=100)
    text = result.report.read_text()
    assert 'id="summary"' in text
    assert 'id="paired"' not in text
    assert "<video" not in text
    assert "too large for this page" in text or "No videos:" in text
    assert "<b>no</b> cup &" not in text
    assert "&lt;b&gt;no&lt;/b&gt; cup &amp;" in text


def _with_problem(measure):
    return lambda *arguments: replace(measure(*arguments), problem="<b>no</b> cup &")


def test_every_way_to_end_has_a_colour_and_no_two_look_alike():
    assert set(OUTCOMES) == {event.cause for event in Event if event != Event.NOTHING}
    assert len(set(OUTCOMES.values())) == len(OUTCOMES)


def test_notable_episodes_are_the_unusual_ones_and_the_first():
    arena = make_arena("empty", 0)

    def ran(failed: set[int], count: int = 30) -> dict[int, Trajectory]:
        return {n: Trajectory("", arena, np.zeros((2, 2)), n not in failed) for n in range(count)}

    assert notable_episodes({"a": ran(set())}) == [0, 1, 2, 3, 4, 5]
    assert notable_episodes({"a": ran({17, 20, 25, 28}), "b": ran({20}), "never": ran(set(range(30)))}) == [
        0,
        1,
        2,
        17,
        20,
        25,
    ]
    assert notable_episodes({"a": ran(set(), 2)}) == [0, 1]


def test_numbers_in_words():
    assert percent(Estimate(0.5, 0.25, 0.75)) == "50.0 % (25.0 to 75.0)"
    assert percent(Estimate(-0.01, -0.05, 0.03), sign=True) == "−1.0 points (−5.0 to +3.0)"
    assert percent(Estimate(math.nan, 0, 1)) == "–"
    assert number(Estimate(1.0, math.nan, math.nan), 2) == "1.00"


def test_sentences_claim_a_difference_only_where_the_interval_leaves_out_nothing():
    better = [metrics("new", n, 0.9) for n in range(30)]
    worse = [metrics("old", n, 0.3 + 0.01 * (n % 3), "success" if n % 2 else "collision") for n in range(30)]
    same = [metrics("same", n, 0.31, "success" if n % 2 else "stuck") for n in range(30)]
    results = summarise({}, {}, {"old": worse, "new": better, "same": same}, 30, "old")
    text = dict(zip(results.brains, sentences(results), strict=True))
    assert "succeeded in 15 of 30" in text["old"]
    assert "compared with" not in text["old"]
    assert "it succeeds more often (+50.0 points) and it has a higher score, 2.90 times" in text["new"]
    assert "no difference in success is certain" in text["same"]


def test_comparisons_of_several_brains_hold_all_at_once():
    base = [metrics("base", n, 0.5, "success" if n % 2 else "stuck") for n in range(40)]
    same = [metrics("same", n, 0.5) for n in range(40)]
    one = [metrics("one", n, 0.5 + 0.01 * (n % 7), "success" if n % 2 or n < 14 else "stuck") for n in range(40)]
    alone = summarise({}, {}, {"base": base, "one": one}, 40, "base").paired["one"]
    others = {f"same_{number}": same for number in range(4)}
    among = summarise({}, {}, {"base": base, "one": one, **others}, 40, "base").paired["one"]
    assert among.differ.p == pytest.approx(5 * alone.differ.p)
    success, score = ([one.differ.better for one in (alone, among)], [one.episodes for one in (alone, among)])
    assert success == [7, 7]
    assert score == [40, 40]
    for name in ("success", "score", "ratio"):
        narrow, wide = getattr(alone, name), getattr(among, name)
        assert wide.low < narrow.low < narrow.value == wide.value < narrow.high < wide.high, name
    # 7 to 0 is more than chance for one brain, and less than that for one of five.
    assert "succeeds more often" in verdict(alone)
    assert "no difference in success is certain" in verdict(among)


def test_episodes_that_begin_alike_are_counted_and_said_to_be_no_independent_ones():
    for states, words in ((["a", "b", "c"], None), (["a", "a", "b"], "began in 2 different states"), ("aaa", "alike")):
        ran = [replace(metrics("rule", n, 0.5), initial_state=state) for n, state in enumerate(states)]
        results = summarise({}, {}, {"rule": ran}, 3, "rule")
        assert results.brains["rule"].starts == len(set(states))
        said = sentences(results)[0]
        assert ("not independent" in said) == (words is not None)
        assert words is None or words in said


def test_infinity_and_nan_become_null_in_json(tmp_path):
    write_json(tmp_path / "x.json", {"a": math.nan, "b": [math.inf, 1.5], "c": {"d": -math.inf}})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": None, "b": [None, 1.5], "c": {"d": None}}


@pytest.mark.parametrize("step", ["write_text", "replace"])
def test_results_are_written_completely_or_stay_what_they_were(tmp_path, monkeypatch, step):
    """A run that is killed meanwhile, or on a full disk, can be continued by what was written before."""
    path = tmp_path / "results.json"
    write_json(path, {"partial": True})

    def fail(target, *_, **__):
        if step == "write_text":
            target.write_bytes(b"{")
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(Path, step, fail)
    with pytest.raises(OSError, match="full"):
        write_json(path, {"partial": False})
    assert json.loads(path.read_text()) == {"partial": True}


def test_charts_are_the_same_bytes_twice():
    brains = summarise({}, {}, {"a": [metrics("a", n, n / 9) for n in range(9)]}, 9, "a").brains
    assert plots.forest(brains, "a") == plots.forest(brains, "a")
