"""Images: every trajectory gets a panel, whatever their number."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.rollout import plots

pytestmark = pytest.mark.figures


@pytest.mark.parametrize("failed", [set(), {3, 17}, set(range(9)), set(range(20))])
def test_of_many_episodes_the_failures_are_shown_before_others(tmp_path, monkeypatch, failed):
    monkeypatch.setattr(plots, "SHOWN", 5)
    arena = make_arena("turtlebot3_world", 0)
    album = plots.TrajectoryAlbum()
    for i in range(20):
        album.add(plots.Trajectory(str(i), arena, np.array([[-2.0, -0.5], [-1.6, -0.5]]), i not in failed))
    shown = [int(one.title) for one in album.shown]
    assert len(shown) == 5
    assert shown == sorted(shown)
    assert len(failed & set(shown)) == min(5, len(failed))
    headings = []
    monkeypatch.setattr(plots, "draw_trajectories", lambda trajectories, path, heading: headings.append(heading))
    album.draw(tmp_path / "t.png", "20 episodes")
    assert headings == ["20 episodes; 5 of them, failures before others"]


def test_an_instruction_about_dollars_is_text(tmp_path):
    scene = TableScene("empty", (), ())
    one = plots.Trajectory("0", scene, np.array([[0.3, 0.0], [0.4, 0.1]]), None, "put the $5 # note beside the $6 note")
    plots.draw_trajectories([one], tmp_path / "t.png", "one")
    assert (tmp_path / "t.png").is_file()


def test_what_a_larger_arm_reaches_is_within_the_panel() -> None:
    scene = TableScene("reach", (), (), target_pose=(0.87, 0.56, 0.4, 1.0, 0.0, 0.0, 0.0))
    path = np.array([[0.6, -0.7], [0.95, 0.5]])
    axes = Figure().subplots()
    plots.draw_panel(axes, plots.Trajectory("0", scene, path, True))
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    for x, y in (*path, scene.target_pose[:2]):
        assert left < x < right
        assert bottom < y < top
