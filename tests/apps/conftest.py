"""The browser that the pages are tested in."""

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import sync_playwright

from tests.apps.browser import ARGUMENTS, found_browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found_browser(), args=list(ARGUMENTS))
        yield chromium
        chromium.close()
