"""How many episodes are needed: beside the exact test itself, and what is printed."""

import itertools
import json
import math
import os
import signal
import sys

import numpy as np
import pytest
from scipy.stats import multinomial, norm

from bhd_lerobot.cli.evaluate import main
from bhd_lerobot.evaluation.plan import discordant_share, pairs_needed, power_of
from bhd_lerobot.evaluation.statistics import discordance

TWO = ["--robot.type=turtlebot3", "--task.type=avoid", "--brains.old.type=avoidance", "--brains.new.type=gap_follower"]


def test_the_power_is_that_of_the_test_that_is_reported():
    pairs, difference, discordant = 14, 0.3, 0.5
    cells = [(discordant + difference) / 2, (discordant - difference) / 2, 1 - discordant]
    power = 0.0
    for better, worse in itertools.product(range(pairs + 1), repeat=2):
        if better > worse and better + worse <= pairs:
            one = np.repeat([True, False, True], [better, worse, pairs - better - worse])
            two = np.repeat([False, True, True], [better, worse, pairs - better - worse])
            if discordance(one, two).p < 0.05:
                power += multinomial.pmf([better, worse, pairs - better - worse], pairs, cells)
    assert power_of(pairs, difference, discordant) == pytest.approx(power)


def test_the_plan_is_just_enough_and_near_the_normal_approximation():
    for difference, discordant in ((0.1, 0.5), (0.1, 0.2), (0.2, 0.4), (0.1, 0.1), (0.05, 0.3)):
        pairs = pairs_needed(difference, discordant)
        assert power_of(pairs - 1, difference, discordant) < 0.8 <= power_of(pairs, difference, discordant)
        if discordant > difference:
            spread = norm.ppf(0.975) * math.sqrt(discordant) + norm.ppf(0.8) * math.sqrt(discordant - difference**2)
            assert pairs == pytest.approx((spread / difference) ** 2, rel=0.15)
    assert pairs_needed(0.1, 0.5, confidence=0.99) > pairs_needed(0.1, 0.5) > pairs_needed(0.2, 0.5)
    assert pairs_needed(1e-5, 0.5) is None


def test_correlated_brains_differ_on_fewer_episodes_down_to_the_difference_of_their_rates():
    assert discordant_share(0.5, 0.6, 0.0) == pytest.approx(0.5 * 0.4 + 0.5 * 0.6)
    shares = [discordant_share(0.5, 0.6, c) for c in (0.0, 0.3, 0.6)]
    assert shares == sorted(shares, reverse=True)
    assert discordant_share(0.5, 0.5, 1.0) == pytest.approx(0.0)
    assert math.isnan(discordant_share(0.5, 0.9, 0.9))
    assert discordant_share(0.9, 1.0, 0.6) == pytest.approx(0.1)


def test_a_plan_is_printed_and_nothing_is_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*TWO, "--plan=true"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "difference of 10 points" in text
    assert f"50 and 60 {pairs_needed(0.1, 0.5)}" in text
    assert list(tmp_path.iterdir()) == []
    # Three brains: two comparisons, both at once with 95 %; and rates above 100 % are left out.
    assert main([*TWO, "--brains.still.type=noop", "--plan=true", "--plan_points=20"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert f"50 and 70 {pairs_needed(0.2, discordant_share(0.5, 0.7, 0.0), 0.975)}" in text
    assert "85 and" not in text


def test_a_plan_uses_earlier_results(tmp_path, capsys):
    pair = {"baseline": "old", "episodes": 40, "differ": {"better": 6, "worse": 4, "p": 0.7}}
    (tmp_path / "results.json").write_text(json.dumps({"paired": {"new": pair}}))
    assert main([*TWO, "--plan=true", f"--output_dir={tmp_path}"]) == 0
    text = capsys.readouterr().out
    assert "new and old differ in 25.0 % of 40 episodes" in text
    assert f"{pairs_needed(0.1, 0.25)} episodes show 10 points" in text
    (tmp_path / "results.json").write_text("{}")
    assert main([*TWO, "--plan=true", f"--output_dir={tmp_path}"]) == 2
    assert "holds no results of bhd-eval" in capsys.readouterr().err


def test_a_plan_whose_reader_has_gone_ends_with_the_status_of_that(monkeypatch):
    """As of `| head -1`; 1 is that of a brain that missed `fail_below`."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        assert main([*TWO, "--plan=true"]) == 128 + signal.SIGPIPE
