"""`bhd-data view`: what the server tells, whom it tells it, and how the command ends."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import tomllib
import urllib.request
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from aiohttp import web

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.data.disk import RootLock
from bhd_lerobot.data.read import read_episode
from bhd_lerobot.data.recorder import DatasetRecorder
from bhd_lerobot.data.state import load_state
from bhd_lerobot.errors import DatasetCorruptError, DatasetError, DatasetLockedError
from bhd_lerobot.runs import data, data_view
from bhd_lerobot.runs.view.dataset import ViewedDataset, stamp_of
from bhd_lerobot.runs.view.groups import MAX_LINES, names_of, scan_of, sections, unit_of
from bhd_lerobot.runs.view.guard import TOKEN_HEADER, is_loopback
from bhd_lerobot.runs.view.packing import pack, unpack
from bhd_lerobot.runs.view.server import STATIC
from tests.data.loader_support import FRONT, PHOTO, images, length, record_ours, record_stock
from tests.runs.support import run_record
from tests.runs.view_support import Served, served

COUNTERS = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("view") / "base"
    small = {"robot__camera": "true", "robot__camera_width": 64, "robot__camera_height": 48, "n_envs": 2}
    run_record(root, **small, dataset__num_episodes=2, dataset__episode_time_s=2, seed=4)
    return root


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("view") / "arm"
    kinds = {"robot__type": "ur5", "brain__type": "pick", "task__type": "pick", "robot__beams": None}
    run_record(root, **kinds, dataset__num_episodes=2, dataset__episode_time_s=20, n_envs=2, seed=4)
    return root


@pytest.fixture(scope="module")
def stock(tmp_path_factory) -> Path:
    return record_stock(tmp_path_factory.mktemp("view") / "stock", cameras=True)


@pytest.fixture(scope="module")
def base_server(base):
    with served(base) as server:
        yield server


def episode(server: Served, index: int) -> tuple[dict, dict[str, np.ndarray]]:
    status, _, content = server.ask(f"/api/episodes/{index}")
    assert status == 200, content
    return unpack(content)


# -- what is sent ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "array",
    [
        np.arange(7, dtype=np.float32).reshape(7, 1),
        np.array([[np.nan, np.inf], [-0.0, 1e-300]]),
        np.array([True, False, True]),
        np.array([-(2**31), 2**31 - 1]),
        np.array([2**40, -1]),
        np.zeros((0, 3), np.float32),
        np.arange(24, dtype=np.uint8).reshape(2, 3, 4)[:, ::-1],
        np.arange(5, dtype=">f8"),
    ],
)
def test_arrays_come_back_as_they_were(array) -> None:
    content = pack({"a": 1, "ü": "ä\n"}, {"before": np.ones(3, np.uint8), "x": array})
    header, found = unpack(content)
    assert header == {"a": 1, "ü": "ä\n"}
    np.testing.assert_array_equal(found["x"], array)
    assert found["x"].shape == array.shape
    assert (len(content) - sum(-(-one.nbytes // 8) * 8 for one in found.values())) % 8 == 0


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


def test_a_base_is_where_the_simulator_says(base) -> None:
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
    chain = ur5().chain
    for number, one in enumerate(chain.capsules):
        wanted = np.linalg.norm(np.subtract(one.start, one.end))
        np.testing.assert_allclose(
            np.linalg.norm(np.diff(capsules[:, number], axis=1)[:, 0], axis=1), wanted, atol=1e-5
        )
    names = [one.name for one in chain.capsules]
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


@pytest.mark.parametrize("count", [0, 1, 2, 8, 9, 17, 300])
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


def test_the_language_column_tells_subtasks_where_no_other_does(tmp_path) -> None:
    root = record_ours(tmp_path / "d", 1, language=True)
    dataset = ViewedDataset(root)
    header, _ = unpack(dataset.packed(0))
    assert header["bands"][0]["name"] == "subtask"
    assert len(header["bands"][0]["runs"]) == length(0)  # each frame has its own
    from bhd_lerobot.runs.view.episode import _said

    rows = [
        {"style": "plan", "timestamp": 0.0, "content": "1. a"},
        {"style": "subtask", "timestamp": 0.4, "content": "b"},
        {"style": "subtask", "timestamp": 0.0, "content": "a"},
    ]
    assert _said(rows, 9, 10) == [[0, 4, "a"], [4, 9, "b"]]
    assert _said(None, 9, 10) == []


# -- films and pictures ------------------------------------------------------------------------------------------------


def test_a_part_of_a_film_is_that_part(base, base_server) -> None:
    camera = base_server.json("/api/dataset")["cameras"][0]
    path = f"/films/{camera['key']}/0/0.mp4"
    whole = (base / "videos" / camera["key"] / "chunk-000/file-000.mp4").read_bytes()
    status, headers, content = base_server.ask(path, headers={"Range": "bytes=100-299"})
    assert (status, headers["content-type"]) == (206, "video/mp4")
    assert headers["content-range"] == f"bytes 100-299/{len(whole)}"
    assert content == whole[100:300]
    assert base_server.ask(path)[2] == whole
    assert base_server.ask(path, headers={"Range": f"bytes={len(whole)}-"})[0] == 416
    header, _ = episode(base_server, 1)
    assert header["films"][0]["from"] == pytest.approx(20 / 10)  # behind the first episode's


@pytest.mark.parametrize(
    "path",
    [
        "/films/observation.images.rear/0/0.mp4",
        "/films/observation.images.front/0/7.mp4",
        "/films/observation.images.front/0/-1.mp4",
        "/films/..%2f..%2fmeta/0/0.mp4",
        "/films/../../../etc/passwd",
        "/static/../server.py",
        "/static/..%2fserver.py",
        "/static/%2e%2e/server.py",
        "/api/episodes/0/images/observation.images.front/0",
        "/api/episodes/x",
        "/meta/info.json",
    ],
)
def test_nothing_else_is_served(base_server, path) -> None:
    status, _, content = base_server.ask(path)
    assert status in (403, 404), content
    assert b"import" not in content


def test_pictures_in_the_data_files(stock) -> None:
    import io

    from matplotlib.image import imread

    with served(stock) as server:
        status, headers, content = server.ask(f"/api/episodes/1/images/{PHOTO}/3")
        assert (status, headers["content-type"]) == (200, "image/png")
        shown = (imread(io.BytesIO(content)) * 255).round().astype(np.uint8)[..., :3]
        np.testing.assert_array_equal(shown, images(1, PHOTO, length(1))[3])
        assert server.ask(f"/api/episodes/1/images/{PHOTO}/{length(1)}")[0] == 404
        assert {one["kind"] for one in server.json("/api/dataset")["cameras"]} == {"video", "image"}


# -- who is served -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "is_ours"),
    [
        *((host, True) for host in ("127.0.0.1", "127.0.0.1:8766", "localhost:1", "LOCALHOST", "[::1]:8766")),
        *((host, False) for host in ("", "evil.example", "evil.example:8766", "127.0.0.1.evil.example", "10.0.0.1")),
        *((host, False) for host in ("localhost@evil.example", "evil.example/localhost", "[::1", "localhost.", "0")),
    ],
)
def test_only_names_of_this_machine_are_answered(base_server, host, is_ours) -> None:
    assert is_loopback(host) is is_ours
    status, _, content = base_server.ask("/api/dataset", headers={"Host": host})
    assert (status == 200) is is_ours, content
    assert is_ours or b"frames" not in content


def test_a_change_needs_the_token_and_the_same_origin(base, base_server) -> None:
    before = stamp_of(base)
    path, body = "/api/episodes/0/mark", {"outcome": "success"}
    token = base_server.token()
    refused = [
        {},
        {TOKEN_HEADER: "guess"},
        {TOKEN_HEADER: token, "Origin": "https://evil.example"},
        {TOKEN_HEADER: token, "Origin": f"http://127.0.0.1:{base_server.port + 1}"},
        {TOKEN_HEADER: token, "Origin": "null"},
        {TOKEN_HEADER: token, "Host": "evil.example"},
    ]
    for headers in refused:
        assert base_server.ask(path, method="POST", body=body, headers=headers)[0] == 403, headers
    assert base_server.ask(path)[0] == 405
    assert stamp_of(base) == before
    with served(base) as other:
        assert other.token() != token


def test_the_page_may_load_from_its_own_server_only(base_server) -> None:
    _, headers, _ = base_server.ask("/")
    assert "default-src 'self'" in headers["content-security-policy"]
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "access-control-allow-origin" not in headers


def test_no_file_of_the_page_names_another_host() -> None:
    files = [path for path in STATIC.rglob("*") if path.is_file() and path.suffix in (".html", ".css", ".js", ".svg")]
    assert len(files) > 20
    for path in files:
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        text = re.sub(r"^/\*!.*\*/$", "", text, flags=re.MULTILINE)  # where a library is from
        assert not re.search(r"(https?:)?//[a-z0-9-]+\.[a-z]", text), path
        for name in re.findall(r'from "(\./[^"]+)"', text):
            assert (path.parent / name).is_file(), f"{path}: {name}"
    page = (STATIC / "index.html").read_text(encoding="utf-8")
    for name in re.findall(r'(?:src|href)="/static/([^"]+)"', page):
        assert (STATIC / name).is_file()


def test_no_file_of_the_page_is_left_out_of_the_package() -> None:
    """Hatch packs all of `bhd_lerobot` but what git ignores."""
    root = Path(__file__).resolve().parents[2]
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    assert "/bhd_lerobot" in settings["tool"]["hatch"]["build"]["targets"]["wheel"]["include"]
    if not (root / ".git").exists():
        pytest.skip("not a git checkout, so nothing is ignored")
    files = [path for path in STATIC.rglob("*") if path.is_file()]
    command = ["git", "-c", f"safe.directory={root}", "check-ignore", *map(str, files)]
    found = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert (found.returncode, found.stdout) == (1, ""), found.stderr


def test_every_file_of_the_page_is_served_as_what_it_is(base_server) -> None:
    kinds = {".js": "javascript", ".css": "text/css", ".svg": "image/svg+xml"}
    for path in STATIC.rglob("*.*"):
        if path.suffix in kinds:
            status, headers, content = base_server.ask(f"/static/{path.relative_to(STATIC).as_posix()}")
            assert status == 200
            assert kinds[path.suffix] in headers["content-type"]
            assert content == path.read_bytes()


# -- changes -----------------------------------------------------------------------------------------------------------


def test_what_was_not_changed_is_not_sent_again(base_server) -> None:
    _, headers, _ = base_server.ask("/api/episodes/0")
    assert base_server.ask("/api/episodes/0", headers={"If-None-Match": headers["etag"]})[0] == 304
    assert base_server.ask("/api/episodes/0", headers={"If-None-Match": '"older"'})[0] == 200


def test_marks_are_written_logged_and_shown(base, tmp_path) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    with served(root) as server:
        before = server.json("/api/dataset")
        index = before["episodes"]["outcome"].index("timeout")
        assert server.mark(index, {"outcome": "success", "note": "it is fine"}) == (200, server_stamp(server))
        after = server.json("/api/dataset")
        assert after["episodes"]["outcome"][index] == "success"
        assert after["stamp"] != before["stamp"]
        assert server.mark(index, {"outcome": "failure"})[0] == 200
        assert server.mark(index, {"intervention": [3, 5]})[0] == 200
        header, arrays = episode(server, index)
        assert header["interventions"] == [[3, 6, ""]]
        assert arrays["event"][:, 0].tolist()[3:6] == [5, 5, 5]
        assert header["metadata"]["outcome"] == "failure"
        assert [one.get("outcome") for one in header["marks"]] == [["timeout", "success"], ["success", "failure"], None]
        assert header["marks"][0]["note"] == "it is fine"
        assert server.mark(index, {"intervention": [7, 7], "clear_interventions": True})[0] == 200
        assert episode(server, index)[0]["interventions"] == [[7, 8, ""]]
    assert len(load_state(root).rows) == 2


def server_stamp(server: Served) -> bytes:
    return json.dumps({"stamp": server.json("/api/stamp")["now"]}).encode()


@pytest.mark.parametrize(
    ("what", "status", "told"),
    [
        (b"{", 400, "not JSON"),
        ([1], 409, "A mark is an object"),
        ({}, 409, "Say what to mark"),
        ({"outcome": "splendid"}, 409, "collision"),
        ({"outcome": 3}, 409, "is no mark"),
        ({"score": 1}, 409, "valid: outcome, intervention"),
        ({"intervention": [1]}, 409, "first and the last"),
        ({"intervention": [True, 2]}, 409, "first and the last"),
        ({"intervention": [5, 99]}, 409, "Frames 5 to 99"),
    ],
)
def test_what_is_no_mark_changes_nothing(base, base_server, what, status, told) -> None:
    before = stamp_of(base)
    found, content = base_server.mark(0, what)
    assert found == status
    assert told in content.decode()
    assert base_server.mark(9, {"outcome": "success"})[0] == 409
    assert stamp_of(base) == before


def test_a_dataset_that_changes_is_noticed_and_read_again(tmp_path) -> None:
    root = record_ours(tmp_path / "d", 2)
    with served(root) as server:
        assert (found := server.json("/api/stamp"))["now"] == found["shown"]
        shutil.rmtree(root)
        assert server.json("/api/stamp")["now"] == ""
        status, _, content = server.ask("/api/dataset")
        assert status == 409
        assert "does not exist" in content.decode()
        record_ours(root, 3)
        assert (found := server.json("/api/stamp"))["now"] != found["shown"]
        # An episode may have another number now: what the page shows is neither filled in with it nor marked.
        status, _, content = server.ask("/api/episodes/0")
        assert status == 409
        assert "has changed on disk" in content.decode()
        status, content = server.mark(0, {"outcome": "success"})
        assert status == 409
        assert "has changed on disk" in content.decode()
        assert len(server.json("/api/dataset")["episodes"]["frames"]) == 3
        lock = RootLock(root)
        try:
            status, content = server.mark(0, {"outcome": "success"})
        finally:
            lock.release()
        assert status == 409
        assert "being written" in content.decode()


# -- odd datasets ------------------------------------------------------------------------------------------------------


def test_an_empty_dataset(tmp_path) -> None:
    features = {"action": {"dtype": "float32", "shape": (1,), "names": ["x"]}}
    DatasetRecorder.create("t/none", 10, features, robot_type="toy", root=tmp_path / "d", recording={}).finalize()
    with served(tmp_path / "d") as server:
        assert server.json("/api/dataset")["episodes"]["frames"] == []
        assert server.ask("/api/episodes/0")[0] == 409


def test_one_frame_and_numbers_that_are_none(tmp_path) -> None:
    features = {"action": {"dtype": "float32", "shape": (1,), "names": ["x"]}}
    features["control.age"] = {"dtype": "float32", "shape": (1,), "names": None}
    recorder = DatasetRecorder.create("t/one", 10, features, robot_type="toy", root=tmp_path / "d", recording={})
    for age in (np.nan, np.inf):
        writer = recorder.begin_episode()
        writer.set_columns({"action": np.zeros((1, 1), np.float32), "control.age": np.full(1, age, np.float32)})
        recorder.save(writer, task="stand", metadata={"score": float("nan"), "scene": "{broken"})
    recorder.finalize()
    dataset = ViewedDataset(tmp_path / "d")
    header, arrays = unpack(dataset.packed(1))
    assert header["not_finite"] == {"control.age": 1}
    assert header["scene"] is None
    assert header["metadata"]["score"] is None
    assert np.isinf(arrays["control.age"]).all()
    with pytest.raises(DatasetError, match="no episode 2"):
        dataset.packed(2)


def test_damaged_missing_and_locked_datasets_are_refused(base, tmp_path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        ViewedDataset(tmp_path / "none")
    lock = RootLock(base)
    try:
        with pytest.raises(DatasetLockedError, match="being written"):
            ViewedDataset(base)
    finally:
        lock.release()
    root = Path(shutil.copytree(base, tmp_path / "d"))
    path = next((root / "data").rglob("*.parquet"))
    path.unlink()
    with pytest.raises(DatasetCorruptError, match=path.name):
        ViewedDataset(root)


@pytest.mark.parametrize("change", [{"fps": 0}, {"fps": "fast"}, {"features": 3}, {"features": {"action": {}}}])
def test_a_description_of_another_shape_is_refused(tmp_path, change) -> None:
    root = record_ours(tmp_path / "d", 1)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, **change}))
    with pytest.raises(DatasetCorruptError, match=r"info\.json"):
        ViewedDataset(root)


@pytest.mark.parametrize("at_once", [True, False])
def test_a_film_that_is_not_there_is_missing_and_nothing_else_is(base, tmp_path, at_once: bool) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    film = next(root.rglob("*.mp4"))
    if at_once:
        film.unlink()
    with served(root) as server:
        film.unlink(missing_ok=True)
        assert server.ask(f"/films/{FRONT}/0/0.mp4")[0] == 404
        assert server.ask("/api/episodes/0")[0] == 200
        path = next((root / "data").rglob("*.parquet"))
        path.write_bytes(path.read_bytes()[:-9])
        status, _, content = server.ask("/api/episodes/1")
        assert status == 409
        assert path.name in content.decode()


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_opens_a_browser_and_ends_with_a_signal(base, capsys, monkeypatch, number) -> None:
    seen = []

    def look(url: str) -> bool:
        def visit() -> None:
            with urllib.request.urlopen(url, timeout=20) as answer:
                seen.append((url, answer.status, answer.read()))
            os.kill(os.getpid(), number)

        threading.Thread(target=visit).start()
        return True

    monkeypatch.setattr(webbrowser, "open", look)
    monkeypatch.setenv("DISPLAY", ":7")
    former = signal.getsignal(signal.SIGINT)
    assert data.main(["view", str(base), "--port", "0"]) == 128 + number
    assert signal.getsignal(signal.SIGINT) is former
    ((url, status, page),) = seen
    assert status == 200
    assert b"bhd-data view" in page
    told = capsys.readouterr().out
    assert f"2 episodes at {url}" in told
    assert url.startswith("http://127.0.0.1:")


def test_ctrl_c_before_the_address_ends_in_the_same_way(base, capsys, monkeypatch) -> None:
    start = web.TCPSite.start

    async def interrupted(site: web.TCPSite) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        await start(site)

    monkeypatch.setattr(web.TCPSite, "start", interrupted)
    assert data.main(["view", str(base), "--port", "0", "--no-browser"]) == 130
    monkeypatch.setattr(data_view, "Console", lambda: os.kill(os.getpid(), signal.SIGINT))
    assert data.main(["view", str(base), "--port", "0", "--no-browser"]) == 130
    assert "Stopped" in capsys.readouterr().err


def test_a_port_in_use_is_named_with_the_remedy(base, capsys) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert data.main(["view", str(base), "--no-browser", "--port", str(port)]) == 2
    error = capsys.readouterr().err
    assert f"--port {port}" in error
    assert "--port 0" in error


@pytest.mark.parametrize("port", ["-1", "65536"])
def test_impossible_ports(base, capsys, port) -> None:
    assert data.main(["view", str(base), "--port", port]) == 2
    assert "between 0 and 65535" in capsys.readouterr().err


def test_nothing_to_show(tmp_path, capsys) -> None:
    assert data.main(["view", str(tmp_path / "none"), "--port", "0"]) == 2
    assert "does not exist" in capsys.readouterr().err
