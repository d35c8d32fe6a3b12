"""What the page is sent of an episode: every number once, the bodies where they were, plots that can be read."""

import numpy as np
import pytest

from bhd_lerobot.apps.view.dataset import ViewedDataset
from bhd_lerobot.apps.view.geometry import scene_of, views_of
from bhd_lerobot.apps.view.groups import MAX_LINES, names_of, scan_of, sections, unit_of
from bhd_lerobot.apps.view.packing import pack, unpack
from bhd_lerobot.bodies.fetch_scene import make_fetch_scene
from bhd_lerobot.bodies.scenes import scene_to_json
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.features import PHYSICS_STATE
from tests.cases import each_case
from tests.datasets.loader.support import length, record_ours

COUNTERS = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def test_the_header_is_json_for_every_reader() -> None:
    content = pack({"worst": float("inf"), "list": [float("nan"), 1.5]}, {})
    header, _ = unpack(content)
    assert header == {"worst": None, "list": [None, 1.5]}
    with pytest.raises(ValueError, match="BHDV"):
        unpack(b"<html>")


@pytest.mark.parametrize("name", ["base", "arm", "stock"])
def test_every_number_of_an_episode_is_sent_once(name, request) -> None:
    root = request.getfixturevalue(name)
    content = ViewedDataset(root).packed(1)
    header, arrays = unpack(content)
    columns = {k: v for k, v in read_episode(root, 1).items() if v.dtype != object and k not in COUNTERS}
    sent = {key for key in arrays if not key.startswith("view.")}
    assert sent == set(columns)
    for key, values in columns.items():
        np.testing.assert_array_equal(arrays[key].reshape(values.shape), values, err_msg=key)
    assert header["frames"] == len(columns["action"])
    drawn = {(line["column"], line["number"]) for s in header["sections"] for p in s["plots"] for line in p["lines"]}
    scan = header["views"].get("scan", {"first": 0, "beams": 0})
    beams = range(scan["first"], scan["first"] + scan["beams"])
    state = arrays["observation.state"].shape[1]
    assert {number for key, number in drawn if key == "observation.state"} == set(range(state)) - set(beams)
    assert {number for key, number in drawn if key == "action"} == set(range(arrays["action"].shape[1]))


def test_a_base_is_where_the_simulator_had_it(base) -> None:
    header, arrays = unpack(ViewedDataset(base).packed(0))
    physics = read_episode(base, 0)["simulation.state"]
    np.testing.assert_allclose(arrays["view.base"][:, :2], physics[:, :2], atol=1e-6)
    ahead = np.stack([np.cos(arrays["view.base"][:, 2]), np.sin(arrays["view.base"][:, 2])], axis=1)
    w, _, _, z = physics[:, 3:7].T
    np.testing.assert_allclose(ahead, np.stack([w * w - z * z, 2 * w * z], axis=1), atol=1e-3)  # it stands upright
    assert header["scene"]["kind"] == "arena"
    assert header["views"]["scan"]["beams"] == 36
    assert header["events"][-1][0] == header["frames"] - 1


def test_an_arm_is_rigid_its_fingers_are_as_far_apart_as_its_opening(arm) -> None:
    header, arrays = unpack(ViewedDataset(arm).packed(0))
    physics = read_episode(arm, 0)["simulation.state"]
    capsules = arrays["view.capsules"].reshape(header["frames"], -1, 2, 3).astype(np.float64)
    chain = ur5().arm.chain
    for number, one in enumerate(chain.capsules):
        wanted = np.linalg.norm(np.subtract(one.start, one.end))
        np.testing.assert_allclose(
            np.linalg.norm(np.diff(capsules[:, number], axis=1)[:, 0], axis=1), wanted, atol=1e-5
        )
    names = [capsule.name for capsule in chain.capsules]
    left, right = capsules[:, names.index("finger_left"), 0], capsules[:, names.index("finger_right"), 0]
    gap = np.linalg.norm(left - right, axis=1) - 2 * chain.capsules[names.index("finger_left")].radius
    np.testing.assert_allclose(gap, physics[:, 6:8].sum(axis=1), atol=1e-5)
    # What it holds at the end is where its tool is.
    target = arrays["view.objects"][-1, header["scene"]["target_object"], :3]
    assert np.linalg.norm(arrays["view.tool"][-1] - target) < 0.05
    there = np.isfinite(arrays["view.objects"][0]).all(axis=1).sum()
    assert there == len(header["scene"]["objects"])
    words = [text for _, _, text in header["bands"][0]["runs"]]
    assert words[0].startswith("move the gripper")
    assert [run[0] for run in header["bands"][0]["runs"][1:]] == [run[1] for run in header["bands"][0]["runs"][:-1]]


@each_case("count", [0, 1, 2, 8, 9, 17, 300])
def test_plots_have_few_lines_and_every_number(count) -> None:
    found = sections({"x": {"names": None}}, {"x": count}, None)
    lines = [line["number"] for one in found for plot in one["plots"] for line in plot["lines"]]
    assert lines == list(range(count))
    assert all(0 < len(plot["lines"]) <= MAX_LINES for one in found for plot in one["plots"])


def test_names_and_units() -> None:
    assert names_of({"names": {"motors": ["a", "b"]}}, 2) == ["a", "b"]
    assert names_of({"names": ["a"]}, 2) == ["0", "1"]
    assert scan_of(["x.vel", "scan_000.pos", "scan_001.pos", "scan_002.pos", "y.vel"]) == (1, 3)
    assert scan_of(["scan_000.pos", "x.vel", "scan_001.pos", "scan_002.pos"]) is None
    assert unit_of("gripper.vel", "ur5") == "m/s"
    assert unit_of("elbow.pos", "ur5") == "rad"
    assert unit_of("elbow.pos", "so101") == ""  # degrees, or a share of its range: it does not say


def test_subtasks_come_from_the_language_column_where_no_other_has_them(tmp_path) -> None:
    root = record_ours(tmp_path / "d", 1, language=True)
    dataset = ViewedDataset(root)
    header, _ = unpack(dataset.packed(0))
    assert header["bands"][0]["name"] == "subtask"
    assert len(header["bands"][0]["runs"]) == length(0)  # each frame has its own


def test_an_arm_on_a_base_is_shown_in_its_arena() -> None:
    scene = make_fetch_scene(0, turtlebot3_manipulation())
    shown = scene_of({"bhd/scene": scene_to_json(scene)})
    assert shown is not None
    assert shown["kind"] == "arena"
    assert len(shown["shapes"]) == len(scene.arena.shapes)
    assert shown["goal"] == [scene.place.x, scene.place.y, scene.place.yaw]
    physics = np.zeros((2, 94))
    physics[:, :7] = 0.5, -1.0, 0.0, np.cos(0.35), 0.0, 0.0, np.sin(0.35)
    about, arrays = views_of("turtlebot3_manipulation", {}, {PHYSICS_STATE: physics})
    assert about["base"]["from"] == "simulator"
    np.testing.assert_allclose(arrays["base"], [(0.5, -1.0, 0.7)] * 2, atol=1e-6)
