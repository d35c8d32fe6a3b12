"""Our pages in a real browser."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.requirements import not_tested

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
)


def found_browser() -> str:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        not_tested(f"the pages in a browser; none is installed: install one of {', '.join(BROWSERS)}")
    return found


@contextmanager
def opened(
    browser: Any, url: str, place: str = "", *, width: int = 1600, height: int = 900, scheme: str = "light"
) -> Iterator[Any]:
    """Open the page; at the end nothing may have gone wrong in it, and nothing may have been requested of others."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    context.set_default_timeout(0)  # the test's own is enough
    page = context.new_page()
    wrong: list[str] = []
    requested: list[str] = []
    page.on("console", lambda message: wrong.append(message.text) if is_wrong(message) else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda request: requested.append(request.url))
    page.goto(url + place)
    page.wait_for_selector("body[data-ready=yes]")
    page.wrong = wrong
    yield page
    assert [one for one in requested if not one.startswith((url, "data:"))] == []
    assert requested
    assert wrong == []
    context.close()


def is_wrong(message: Any) -> bool:
    """Return whether a line of the console is about our page; drawing without a GPU makes the browser report stalls."""
    return message.type in ("error", "warning") and "GPU stall" not in message.text


def wait_until(page: Any, expression: str, argument: Any = None) -> None:
    """Wait until an expression is true. Playwright's own way needs `eval`, which the page's policy forbids."""
    while not page.evaluate(expression, argument):
        page.wait_for_timeout(20)
