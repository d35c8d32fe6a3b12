"""The page of `bhd-data view` in a real browser: what is seen there, and that all of it moves together."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.apps.view.packing import unpack
from bhd_lerobot.datasets.edit.edits import delete
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from tests.apps.browser import ARGUMENTS, found_browser, opened, wait_until
from tests.apps.view.support import Served, served
from tests.datasets.loader.support import FRONT, PHOTO, WRIST, images, length, record_ours


@pytest.fixture(scope="module")
def video_dataset(tmp_path_factory) -> Path:
    return record_ours(tmp_path_factory.mktemp("page") / "video_dataset", 5, (FRONT, WRIST))


def shown_frames(page: Any) -> dict[str, set[int]]:
    """Return the frame that each kind of view says that it shows, once all are drawn."""
    drawn = "[...document.querySelectorAll('.view canvas, .playhead')].every((one) => 'frame' in one.dataset)"
    wait_until(page, drawn)
    found = page.evaluate(
        """() => Object.entries({video: 'video, .video img', drawing: '.view canvas', timeline: '#track',
             plot: '.playhead'}).map(([kind, query]) =>
               [kind, [...document.querySelectorAll(query)].map((one) => Number(one.dataset.frame))])"""
    )
    return {kind: set(frames) for kind, frames in found}


def wait_for_plots(page: Any, count: int) -> None:
    wait_until(page, "(count) => document.querySelectorAll('.playhead').length === count", count)


def numbers(page: Any, query: str = ".row") -> list[int]:
    return page.eval_on_selector_all(query, "rows => rows.map((row) => Number(row.dataset.episode))")


def select(page: Any, index: int) -> None:
    page.click(f"#episode-{index} .number")
    page.wait_for_selector(f".card-a[data-episode='{index}']")


def scrub(page: Any, share: float) -> None:
    box = page.locator("#track").bounding_box()
    page.mouse.click(box["x"] + share * box["width"], box["y"] + 6)


def test_everything_moves_together(browser, base) -> None:
    with served(base) as server, opened(browser, server.url) as page:
        assert page.title().startswith("base")
        assert numbers(page) == [0, 1, 2]
        kinds = page.eval_on_selector_all(".view", "views => views.map((one) => one.dataset.view)")
        assert kinds == ["video", "scan", "top", "scene"]
        wait_for_plots(page, 7)
        assert shown_frames(page) == {"video": {0}, "drawing": {0}, "timeline": {0}, "plot": {0}}
        scrub(page, 0.525)
        assert shown_frames(page) == {"video": {10}, "drawing": {10}, "timeline": {10}, "plot": {10}}
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowLeft")
        assert shown_frames(page)["drawing"] == {11}
        page.keyboard.press("Home")
        assert shown_frames(page)["plot"] == {0}
        page.keyboard.press("End")
        assert shown_frames(page) == {"video": {19}, "drawing": {19}, "timeline": {19}, "plot": {19}}
        # A click into a plot goes there.
        box = page.locator(".plot .u-over").first.bounding_box()
        page.mouse.click(box["x"] + 5 / 19 * box["width"], box["y"] + 20)
        assert shown_frames(page)["video"] <= {4, 5}
        assert len(shown_frames(page)["drawing"]) == 1
        # The mouse over one plot is shown in all, and on the timeline.
        page.mouse.move(box["x"] + 15.2 / 19 * box["width"], box["y"] + 30)
        assert page.locator("#hoverhead").is_visible()
        legends = "plots => plots.map((one) => one.querySelector('.u-legend .u-value').textContent)"
        assert set(page.eval_on_selector_all(".plot", legends)) == {"1.50 s"}


def test_playing_goes_on_to_the_end_and_stops(browser, base) -> None:
    with served(base) as server, opened(browser, server.url) as page:
        page.keyboard.press("1")
        page.keyboard.press(" ")
        assert page.get_attribute("#play", "aria-label") == "Pause"
        page.keyboard.press("3")
        assert page.get_attribute("[data-rate='2']", "aria-pressed") == "true"
        wait_until(page, "document.querySelector('video').currentTime > 0.3")
        wait_until(page, "document.querySelector('#play').getAttribute('aria-label') === 'Play'")
        assert shown_frames(page)["drawing"] == {19}
        # The file goes on with the next episode; the video of this one does not.
        wait_until(page, "!document.querySelector('video').seeking")
        assert page.evaluate("document.querySelector('video').currentTime") == pytest.approx(1.95, abs=0.01)


def test_the_video_shows_the_frame_that_is_chosen(browser, video_dataset) -> None:
    """Pixels that the browser shows are those that were recorded, in episodes in the middle of a file, too."""
    look = """async (camera) => {
      const video = document.querySelector(`video[data-camera='${camera}']`);
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [10, 8];
      const context = canvas.getContext('2d');
      context.imageSmoothingQuality = 'high';
      context.drawImage(video, 0, 0, 10, 8);
      return [...context.getImageData(0, 0, 10, 8).data];
    }"""
    with served(video_dataset) as server, opened(browser, server.url) as page:
        for index, frame in ((0, 0), (3, 4), (1, 2)):
            select(page, index)
            scrub(page, (frame + 0.5) / length(index))
            assert shown_frames(page)["video"] == {frame}
            wait_until(
                page, "[...document.querySelectorAll('video')].every((one) => one.readyState >= 2 && !one.seeking)"
            )
            page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            for camera in (FRONT, WRIST):
                pixels = np.array(page.evaluate(look, camera), float).reshape(8, 10, 4)[..., :3]
                recorded = images(index, camera, length(index))[:, 4::8, 4::8].astype(float)
                distances = np.abs(recorded - pixels).mean(axis=(1, 2, 3))
                assert distances.argmin() == frame, distances
                assert distances[frame] < 30 < np.delete(distances, frame).min()


def test_filters_search_and_sorting(browser, video_dataset) -> None:
    with served(video_dataset) as server, opened(browser, server.url) as page:
        chips = page.eval_on_selector_all(".chip", "chips => chips.map((one) => one.textContent)")
        assert chips == ["success3", "collision1", "timeout1"]
        page.click(".chip[data-outcome=success]")
        assert numbers(page) == [0, 1, 4]
        page.click(".chip[data-outcome=timeout]")
        assert numbers(page) == [0, 1, 3, 4]
        page.fill("#search", "TASK 1")
        assert numbers(page) == [1, 3]
        assert page.text_content("#shown") == "2 of 5"
        page.fill("#search", "")
        page.click(".chip[data-outcome=success]")
        page.click(".chip[data-outcome=timeout]")
        page.select_option("#sort", "late")
        assert numbers(page) == [0, 3, 1, 4, 2]
        page.click("#direction")
        assert numbers(page) == [2, 1, 4, 0, 3]
        page.select_option("#sort", "frames")
        assert numbers(page) == sorted(range(5), key=lambda i: (-length(i), i))
        page.fill("#search", "#3")
        assert numbers(page) == [3]
        page.fill("#search", "nothing of the kind")
        assert numbers(page) == []
        page.keyboard.press("Escape")
        page.fill("#search", "")
        page.keyboard.press("Escape")
        page.select_option("#sort", "index")
        page.click("#direction")
        page.locator("#sort").blur()
        page.keyboard.press("ArrowDown")
        page.wait_for_selector(".card-a[data-episode='1']")
        assert numbers(page, ".row[aria-selected=true]") == [1]
        assert page.get_attribute("#list", "aria-activedescendant") == "episode-1"
        # Keys that come faster than episodes are not lost.
        fire = "(key) => document.dispatchEvent(new KeyboardEvent('keydown', {key}))"
        page.evaluate(
            f"() => {{ for (const key of ['ArrowDown', 'ArrowDown', 'ArrowDown', 'ArrowUp']) ({fire})(key); }}"
        )
        page.wait_for_selector(".card-a[data-episode='3']")


def test_two_episodes_side_by_side(browser, base) -> None:
    with served(base) as server, opened(browser, server.url) as page:
        select(page, 2)
        page.keyboard.press("c")  # with the one before
        page.wait_for_selector(".card-b[data-episode='0']")
        assert page.locator("video").count() == 2
        starts = server_videos(server)
        scrub(page, 0.275)
        wait_until(page, "[...document.querySelectorAll('video')].every((one) => !one.seeking)")
        times = page.eval_on_selector_all("video", "videos => videos.map((one) => one.currentTime)")
        assert times == pytest.approx([starts[2] + 0.55, starts[0] + 0.55], abs=0.01)  # aligned at their starts
        wait_for_plots(page, 7)
        assert "applied #0" in page.text_content(".plot")
        assert page.locator("[data-view=top]").count() == 2  # two arenas
        assert "compare=0" in page.evaluate("location.hash")
        page.hover("#episode-1")
        page.click("#episode-1 .versus")
        page.wait_for_selector(".card-b[data-episode='1']")
        page.keyboard.press("c")
        wait_until(page, "!document.querySelector('.card-b')")
        assert page.locator("video").count() == 1
        assert page.get_attribute("#track", "data-frame") == "5"  # where it was
    with served(base) as server, opened(browser, server.url, "#episode=1&compare=2&t=1") as page:
        assert shown_frames(page)["drawing"] == {10}
        assert numbers(page, ".row.compared") == [2]


def server_videos(server: Served) -> list[float]:
    return [unpack(server.ask(f"/api/episodes/{index}")[2])[0]["videos"][0]["from"] for index in range(3)]


def test_an_arm_its_plan_and_the_requested_action(browser, arm) -> None:
    with served(arm) as server, opened(browser, server.url, scheme="dark") as page:
        kinds = page.eval_on_selector_all(".view", "views => views.map((one) => one.dataset.view)")
        assert kinds == ["arm-above", "arm-side", "scene"]
        assert page.locator("[data-lane=subtask] .run").count() >= 4
        assert page.text_content("#now").startswith("move the gripper")
        page.keyboard.press("End")
        assert page.text_content("#now").startswith("hold")
        titles = page.eval_on_selector_all(
            "[data-section=Action] .plot", "plots => plots.map((one) => one.dataset.plot)"
        )
        assert len(titles) == 7
        # A section that is opened is drawn then, and stays open with the next episode.
        before = page.locator(".uplot").count()
        page.click("[data-section='Simulator state'] summary")
        wait_until(page, "(before) => document.querySelectorAll('.uplot').length > before", before)
        select(page, 1)
        page.wait_for_selector("[data-section='Simulator state'][open] .uplot")
        # Something is drawn in each view, and not the same.
        inks = page.eval_on_selector_all(
            ".view:not([data-view=scene]) canvas",
            """all => all.map((one) => {
              const pixels = one.getContext('2d').getImageData(0, 0, one.width, one.height).data;
              return new Set(new Uint32Array(pixels.buffer)).size;
            })""",
        )
        assert all(count > 20 for count in inks)
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(14, 17, 22)"
        for name in ("light", "dark"):
            page.click("#theme")
            assert page.get_attribute("html", "data-theme") == name
        page.keyboard.press("?")
        assert page.locator("dialog[open] kbd").count() > 8
        page.keyboard.press("Escape")
        assert page.locator("dialog[open]").count() == 0


def test_a_mark_is_shown_and_on_disk(browser, base, tmp_path) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    with served(root) as server, opened(browser, server.url) as page:
        select(page, 1)
        scrub(page, 0.525)
        page.click("#mark-success")
        page.fill("dialog [name=note]", "looked at it")
        page.keyboard.press("Enter")
        page.wait_for_selector("#episode-1[data-outcome=success]")
        wait_until(page, "document.querySelector('.card-a .badge').textContent === 'success'")
        assert page.get_attribute("#track", "data-frame") == "10"  # still there
        assert not page.locator("#banner").is_visible()
        page.click("#mark-failure")
        page.select_option("dialog select", "collision")
        page.click("#mark-send")
        page.wait_for_selector("#episode-1[data-outcome=collision]")
        page.click("#mark-intervention")
        page.fill("dialog [name=first]", "4")
        page.fill("dialog [name=last]", "7")
        page.click("#mark-send")
        page.wait_for_selector("[data-lane=intervention] .run")
        page.click("#mark-success")
        page.keyboard.press("Escape")
        assert server.json("/api/dataset")["episodes"]["outcome"][1] == "collision"
        page.click(".card-a button:has-text('more')")
        assert "looked at it" in page.text_content("dialog")
    edits = [json.loads(line) for line in (root / "meta/edits.jsonl").read_text().splitlines()]
    assert [edit["episodes"][0].get("outcome", [None, None])[1] for edit in edits] == ["success", "collision", None]


def test_changes_on_disk_are_reported(browser, base, tmp_path) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    with served(root) as server, opened(browser, server.url) as page:
        select(page, 2)
        shutil.rmtree(root)
        page.wait_for_selector("#banner:has-text('has changed')")
        page.click("#banner button")
        page.wait_for_selector("#banner:has-text('does not exist')")
        shutil.copytree(base, root)
        page.click("#banner button")
        page.wait_for_selector("#banner", state="hidden")
        assert page.get_attribute(".card-a", "data-episode") == "2"
        page.wrong[:] = [text for text in page.wrong if "409" not in text]  # the browser's own line on the refusal


def test_a_page_marks_nothing_once_another_has_loaded_the_changed_dataset(browser, base, tmp_path) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    with served(root) as server, opened(browser, server.url) as page:
        select(page, 1)
        page.click("#mark-success")
        delete(root, [0])
        outcomes = server.json("/api/dataset")["episodes"]["outcome"]  # as the other page
        page.click("#mark-send")
        page.wait_for_selector("#toast.bad:has-text('has changed')")
        assert server.json("/api/dataset")["episodes"]["outcome"] == outcomes
        page.wrong[:] = [text for text in page.wrong if "409" not in text]


def test_a_missing_video_is_reported_in_its_place(browser, base, tmp_path) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    with served(root) as server:
        next(root.rglob("*.mp4")).unlink()
        with opened(browser, server.url) as page:
            page.wait_for_selector(".video .problem:has-text('missing')")
            wait_for_plots(page, 7)
            scrub(page, 0.525)
            assert shown_frames(page)["drawing"] == {10}
            page.wrong[:] = [text for text in page.wrong if "404" not in text]


@pytest.mark.parametrize(("width", "height"), [(1180, 720), (1600, 1000)])
def test_nothing_is_wider_than_the_window(browser, base, width, height) -> None:
    sizes = (
        "() => ['html', 'main'].map((name) => document.querySelector(name)).map((e) => e.scrollWidth - e.clientWidth)"
    )
    with (
        served(base) as server,
        opened(browser, server.url, "#episode=0&compare=1", width=width, height=height) as page,
    ):
        wait_for_plots(page, 7)
        assert page.evaluate(sizes) == [0, 0]
        boxes = [page.locator(".view").nth(number).bounding_box() for number in range(4)]
        assert all(box["width"] > 150 and box["height"] > 150 for box in boxes)
        assert boxes[-1]["x"] + boxes[-1]["width"] <= width


def test_three_dimensions(browser, base, arm) -> None:
    """What is seen follows the time and the mouse; a browser without WebGL says so."""
    flat = browser.browser_type.launch(executable_path=found_browser(), args=[*ARGUMENTS, "--disable-3d-apis"])
    with served(base) as server, opened(flat, server.url) as page:
        assert "has no WebGL" in page.text_content("[data-view=scene]")
    flat.close()
    for root in (base, arm):
        with served(root) as server, opened(browser, server.url) as page:
            canvas = page.locator("[data-view=scene] canvas")
            at = "(frame) => document.querySelector('[data-view=scene] canvas').dataset.frame === frame"
            wait_until(page, at, "0")
            seen = [canvas.screenshot()]
            page.keyboard.press("End")
            wait_until(page, at, str(page.evaluate("document.querySelector('#track').dataset.frame")))
            seen.append(canvas.screenshot())
            box = canvas.bounding_box()
            page.mouse.move(box["x"] + 50, box["y"] + 50)
            page.mouse.down()
            page.mouse.move(box["x"] + 90, box["y"] + 60)
            page.mouse.up()
            seen.append(canvas.screenshot())
            page.mouse.wheel(0, -300)
            page.mouse.dblclick(box["x"] + 50, box["y"] + 50)
            assert canvas.screenshot() == seen[1]  # as it was
            assert len(set(seen)) == 3


def test_a_phone(browser, base) -> None:
    with (
        served(base) as server,
        opened(browser, server.url, "#episode=1", width=390, height=844, scheme="dark") as page,
    ):
        assert not page.locator("#list").is_visible()
        page.click("#episodes-button")
        assert numbers(page) == [0, 1, 2]
        assert not page.locator("main").is_visible()
        select(page, 2)
        assert not page.locator("#list").is_visible()
        wait_for_plots(page, 7)
        for place in ("0", "document.body.scrollHeight"):  # play is in sight, wherever the page is scrolled to
            page.evaluate(f"scrollTo(0, {place})")
            box = page.locator("#play").bounding_box()
            assert page.locator(".top").bounding_box()["height"] <= box["y"] <= 844 - box["height"]
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        boxes = page.eval_on_selector_all(".view, .plot", "all => all.map((one) => one.getBoundingClientRect().width)")
        assert min(boxes) > 300
        assert max(boxes) <= 390


def test_an_address_that_names_no_episode_says_so(browser, base) -> None:
    with served(base) as server, opened(browser, server.url, "#episode=7") as page:
        assert "There is no episode 7: the dataset has 3, from 0 to 2." in page.text_content("#toast")
        assert page.get_attribute(".card-a", "data-episode") == "0"
        for place, message in (  # an address that is changed by hand
            ("episode=0&compare=9", "There is no episode 9"),
            ("episode=last", "The address names episode last, which is no number"),
        ):
            page.evaluate(f"location.hash = '{place}'")
            page.wait_for_selector(f"#toast:has-text('{message}')")
        page.evaluate("location.hash = 'episode=2'")
        page.wait_for_selector(".card-a[data-episode='2']")


def test_an_episode_is_downloaded(browser, base) -> None:
    with served(base) as server, opened(browser, server.url, "#episode=1") as page:
        page.click(".card-a button:has-text('download')")
        names = page.eval_on_selector_all("dialog a", "links => links.map((one) => one.download)")
        assert names == ["base-episode-1.csv", "base-episode-1-front.mp4"]
        with page.expect_download() as started:
            page.click("dialog a:has-text('csv')")
        assert started.value.suggested_filename == names[0]
        assert Path(started.value.path()).read_text().startswith('"frame","time_s","')


def test_a_dataset_of_stock_lerobot_and_odd_ones(browser, stock, tmp_path) -> None:
    with served(stock) as server, opened(browser, server.url) as page:
        assert page.text_content(".card-a .badge") == "not judged"
        wait_until(page, "document.querySelector('video').readyState >= 2")  # AV1
        scrub(page, 0.59)
        image = f"img[data-camera='{PHOTO}']"
        wait_until(page, f'document.querySelector("{image}").dataset.frame === "3"')
        wait_until(page, f'document.querySelector("{image}").naturalWidth === 80')
        assert page.locator("#mark-intervention").is_disabled()
        assert page.locator("[data-view=top], [data-view=scan]").count() == 0
    features: dict[str, Any] = {"action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}}
    features["control.age"] = {"dtype": "float32", "shape": (1,), "names": None}
    recorder = DatasetRecorder.create("t/one", 10, features, robot_type="toy", root=tmp_path / "one", recording={})
    recorder.finalize()
    with served(tmp_path / "one") as server, opened(browser, server.url) as page:
        assert "no episodes" in page.text_content("#nothing")
    recorder = DatasetRecorder.create("t/one", 10, features, robot_type="toy", root=tmp_path / "two", recording={})
    for frames in (1, 4):
        writer = recorder.begin_episode()
        ages = np.array([np.nan, 1.0, np.inf, 2.0][:frames], np.float32)
        writer.set_columns({"action": np.zeros((frames, 2), np.float32), "control.age": ages})
        recorder.save(writer, task="<b>stand</b>", metadata={"outcome": "<img src=x>"})
    recorder.finalize()
    with served(tmp_path / "two") as server, opened(browser, server.url) as page:
        wait_for_plots(page, 3)
        assert page.text_content(".instruction") == "<b>stand</b>"  # what somebody wrote is text
        assert page.text_content(".card-a .badge") == "<img src=x>"
        assert "1 value is not finite" in page.text_content("[data-section=Timing] summary")
        page.keyboard.press("End")
        page.keyboard.press("ArrowRight")
        assert shown_frames(page)["plot"] == {0}
        page.keyboard.press("ArrowDown")
        page.wait_for_selector(".card-a[data-episode='1']")
        assert re.search(r"2 values are not finite", page.text_content("[data-section=Timing] summary"))
