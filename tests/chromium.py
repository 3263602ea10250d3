"""Chromium without a window, driven by Selenium, for tests of pages."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service


@contextlib.contextmanager
def opened(profile: Path, *flags: str) -> Iterator[webdriver.Chrome]:
    """Yield a browser with a new profile; without Chromium skip the test, or fail in CI."""
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (binary and driver):
        lacking = "there is no Chromium: run `apt-get install -y chromium chromium-driver`"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(lacking)
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in ("--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}", *flags):
        options.add_argument(flag)
    with webdriver.Chrome(options=options, service=Service(driver)) as browser:
        yield browser
