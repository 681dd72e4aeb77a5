"""A real browser for tests of pages; they are skipped, with the reason, where there is none."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO

import numpy as np
import pytest

_SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


class Tab:
    """A page of the browser, and what went wrong in it."""

    def __init__(self, page) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.requests: list[str] = []
        page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))

    def picture(self, selector: str = "canvas") -> np.ndarray:
        """What an element looks like, RGB."""
        from PIL import Image

        shot = self.page.locator(selector).first.screenshot()
        return np.asarray(Image.open(BytesIO(shot)).convert("RGB")).astype(int)


@contextmanager
def open_tab(address: str, width: int = 900, height: int = 800) -> Iterator[Tab]:
    """A tab of Chromium with an address, drawn by software."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if program is None:
        pytest.skip("there is no chromium on this machine")
    with playwright.sync_playwright() as found:
        browser = found.chromium.launch(executable_path=program, args=list(_SOFTWARE))
        try:
            tab = Tab(browser.new_page(viewport={"width": width, "height": height}))
            tab.page.goto(address)
            yield tab
        finally:
            browser.close()
