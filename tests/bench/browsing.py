"""A headless Chromium for tests of the live page."""

import shutil
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def installed() -> str:
    """Path of an installed browser; the test is skipped if there is none."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"needs a Chromium: none of {', '.join(BROWSERS)} is on the path")
    return path


@contextmanager
def a_browser():
    """One for all tests of a module."""
    path = installed()
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def browse(chromium, url: str, **options):
    """A page of its own; it fails if a script does, or if it asks for anything from elsewhere."""
    context = chromium.new_context(**{"viewport": {"width": 1280, "height": 800}, **options})
    page = context.new_page()
    outside, wrong = [], []

    def let(route):
        if urlsplit(route.request.url).hostname == "127.0.0.1":
            route.continue_()
        else:
            outside.append(route.request.url)
            route.abort()

    def hear(said):
        # What the browser says of itself: a server is gone, drawing without a graphics card is
        # slow, and so is reading pixels, as a test does. All else on the console is the page's.
        of_itself = ("ERR_CONNECTION", "GPU stall", "willReadFrequently")
        of_browser = any(words in said.text for words in of_itself)
        if said.type in {"error", "warning"} and not of_browser:
            wrong.append(said.text)

    context.route("**/*", let)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", hear)
    try:
        page.goto(url)
        page.wait_for_function("() => bench.hellos > 0")  # what is done before, the hello may undo
        yield page
        assert outside == []
        assert wrong + page.evaluate("bench.errors") == []
    finally:
        context.close()
