"""`bhd-data view`: what the server tells, whom it tells it, and how the command ends."""

import io
import json
import os
import re
import shutil
import signal
import socket
import threading
import urllib.request
import webbrowser
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest
from matplotlib.image import imread

from bhd_lerobot.apps.view.dataset import stamp_of
from bhd_lerobot.apps.view.guard import TOKEN_HEADER, is_loopback
from bhd_lerobot.apps.view.server import STATIC
from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.errors import DatasetError
from tests.apps.view.support import Served, episode, served
from tests.cases import each_case
from tests.datasets.loader.support import PHOTO, images, length

# -- videos and images ------------------------------------------------------------------------------------------------


def test_a_part_of_a_video_is_that_part(base, base_server) -> None:
    camera = base_server.json("/api/dataset")["cameras"][0]
    path = f"/videos/{camera['key']}/0/0.mp4"
    whole = (base / "videos" / camera["key"] / "chunk-000/file-000.mp4").read_bytes()
    status, headers, content = base_server.ask(path, headers={"Range": "bytes=100-299"})
    assert (status, headers["content-type"]) == (206, "video/mp4")
    assert headers["content-range"] == f"bytes 100-299/{len(whole)}"
    assert content == whole[100:300]
    assert base_server.ask(path)[2] == whole
    assert base_server.ask(path, headers={"Range": f"bytes={len(whole)}-"})[0] == 416
    header, _ = episode(base_server, 1)
    assert header["videos"][0]["from"] == pytest.approx(20 / 10)  # behind the first episode's


def test_an_episode_is_downloaded_as_numbers_and_as_video(base, base_server, arm, tmp_path) -> None:
    """Every number of the episode is in the CSV, and the video has its frames and no other."""
    for root in (base, arm):
        with served(root) as server:
            header, arrays = episode(server, 1)
            status, headers, content = server.ask("/api/episodes/1/episode.csv")
            assert (status, headers["content-type"]) == (200, "text/csv")
            table = pa_csv.read_csv(io.BytesIO(content))
            frames = len(table)
            assert table["frame"].to_pylist() == list(range(frames))
            for name, labels in header["names"].items():
                values = arrays[name].reshape(frames, -1)
                for number, label in enumerate(labels):
                    column = table[name if len(labels) == 1 else f"{name}.{label}"].to_numpy()
                    np.testing.assert_allclose(column.astype(float), values[:, number].astype(float), rtol=1e-6)
    camera = base_server.json("/api/dataset")["cameras"][0]["key"]
    status, headers, content = base_server.ask(f"/api/episodes/1/videos/{camera}.mp4")
    assert (status, headers["content-type"]) == (200, "video/mp4")
    (tmp_path / "episode.mp4").write_bytes(content)
    state = load_state(base)
    row = state.rows[1]
    whole = base / "videos" / camera / "chunk-000/file-000.mp4"
    start = round(row[f"videos/{camera}/from_timestamp"] * state.info["fps"])
    np.testing.assert_array_equal(decoded(tmp_path / "episode.mp4"), decoded(whole)[start : start + row["length"]])


def decoded(path: Path) -> np.ndarray:
    with av.open(str(path)) as video:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)])


def test_a_link_out_of_the_dataset_is_not_served(base: Path, stock: Path, tmp_path: Path) -> None:
    """Any user of this machine may ask the server, for what its owner alone may read."""
    secret = tmp_path / "secret"
    secret.write_text("password")
    root = Path(shutil.copytree(base, tmp_path / "base"))
    video = next((root / "videos").glob("*/*/*.mp4"))
    with served(root) as server:  # the link is made while it runs
        whole = video.read_bytes()
        video.unlink()
        video.symlink_to(secret)
        path = f"/videos/{video.parts[-3]}/0/0.mp4"
        status, _, body = server.ask(path)
        assert (status, b"password" in body, b"is a link to" in body) == (409, False, True)
        (root / "own.mp4").write_bytes(whole)
        video.unlink()
        video.symlink_to("../../../own.mp4")
        assert server.ask(path)[2] == whole
    video.unlink()
    video.symlink_to(secret)
    with pytest.raises(DatasetError, match=r"is a link to .*secret, outside of the dataset"), served(root):
        pass
    root = Path(shutil.copytree(stock, tmp_path / "stock"))
    main = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(main)
    key = next(name for name in table.column_names if name == PHOTO)
    place = table.schema.get_field_index(key)
    for path in (str(secret), "../secret"):
        column = pa.array([{"bytes": None, "path": path}] * table.num_rows, table.schema.field(place).type)
        pq.write_table(table.set_column(place, table.schema.field(place), column), main)
        with served(root) as server:
            status, _, body = server.ask(f"/api/episodes/0/images/{key}/0")
            assert (status, b"password" in body) == (409, False)


@each_case(
    "path",
    [
        "/videos/observation.images.rear/0/0.mp4",
        "/videos/observation.images.front/0/7.mp4",
        "/videos/observation.images.front/0/-1.mp4",
        "/videos/..%2f..%2fmeta/0/0.mp4",
        "/videos/../../../etc/passwd",
        "/static/../server.py",
        "/static/..%2fserver.py",
        "/static/%2e%2e/server.py",
        "/api/episodes/0/images/observation.images.front/0",
        "/api/episodes/x",
        "/api/episodes/x/episode.csv",
        "/api/episodes/0/videos/observation.images.none.mp4",
        "/api/episodes/0/videos/../episode.csv.mp4",
        "/meta/info.json",
    ],
)
def test_nothing_else_is_served(base_server, path) -> None:
    status, _, content = base_server.ask(path)
    assert status in (403, 404), content
    assert b"import" not in content


def test_images_in_the_data_files(stock) -> None:
    with served(stock) as server:
        status, headers, content = server.ask(f"/api/episodes/1/images/{PHOTO}/3")
        assert (status, headers["content-type"]) == (200, "image/png")
        shown = (imread(io.BytesIO(content)) * 255).round().astype(np.uint8)[..., :3]
        np.testing.assert_array_equal(shown, images(1, PHOTO, length(1))[3])
        assert server.ask(f"/api/episodes/1/images/{PHOTO}/{length(1)}")[0] == 404
        assert {one["kind"] for one in server.json("/api/dataset")["cameras"]} == {"video", "image"}


# -- who is served -----------------------------------------------------------------------------------------------------


@pytest.mark.law
@each_case(
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
    files = [
        path
        for path in STATIC.rglob("*")
        if path.suffix in (".html", ".css", ".js", ".svg") and path.name != "three.module.min.js"
    ]
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
    assert len(load_state(root).rows) == 3


def server_stamp(server: Served) -> bytes:
    return json.dumps({"stamp": server.json("/api/stamp")["now"]}).encode()


@each_case(
    ("what", "status", "message"),
    [
        (b"{", 400, "not JSON"),
        ([1], 409, "A mark is an object"),
        ({}, 409, "Give a mark"),
        ({"outcome": "splendid"}, 409, "collision"),
        ({"outcome": 3}, 409, "is no mark"),
        ({"score": 1}, 409, "valid: outcome, intervention"),
        ({"intervention": [1]}, 409, "first and the last"),
        ({"intervention": [True, 2]}, 409, "first and the last"),
        ({"intervention": [5, 99]}, 409, "Frames 5 to 99"),
    ],
)
def test_what_is_no_mark_changes_nothing(base, base_server, what, status, message) -> None:
    before = stamp_of(base)
    found, content = base_server.mark(0, what)
    assert found == status
    assert message in content.decode()
    assert base_server.mark(9, {"outcome": "success"})[0] == 409
    assert stamp_of(base) == before


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_opens_a_browser_and_ends_with_a_signal(base, capsys, monkeypatch, number) -> None:
    seen = []

    def look(url: str) -> bool:
        def visit() -> None:
            with urllib.request.urlopen(url) as answer:
                seen.append((url, answer.status, answer.read()))
            os.kill(os.getpid(), number)

        threading.Thread(target=visit).start()
        return True

    monkeypatch.setattr(webbrowser, "open", look)
    monkeypatch.setenv("DISPLAY", ":7")
    former = signal.getsignal(signal.SIGINT)
    assert main.main(["view", str(base), "--port", "0"]) == 128 + number
    assert signal.getsignal(signal.SIGINT) is former
    ((url, status, page),) = seen
    assert status == 200
    assert b"bhd-data view" in page
    printed = capsys.readouterr().out
    assert f"3 episodes at {url}" in printed
    assert url.startswith("http://127.0.0.1:")


def test_what_cannot_be_shown_is_refused_with_the_remedy(base, tmp_path, capsys) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        for root, number, words in (
            (base, port, (f"--port {port}", "--port 0")),
            (base, "-1", ("between 0 and 65535",)),
            (base, "65536", ("between 0 and 65535",)),
            (tmp_path / "none", "0", ("does not exist",)),
        ):
            assert main.main(["view", str(root), "--no-browser", "--port", number]) == 2
            error = capsys.readouterr().err
            assert all(one in error for one in words), error
