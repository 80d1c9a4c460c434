"""A browser without a screen, for tests of pages; they are skipped where there is none."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest

_CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
_DRIVER = shutil.which("chromedriver")

needs_browser = pytest.mark.skipif(
    not (_CHROMIUM and _DRIVER and find_spec("selenium") and find_spec("viser")),
    reason="needs chromium, chromedriver, and the packages selenium and viser",
)
needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="needs the extra 'viewer'")


@contextlib.contextmanager
def browser(width: int = 1280, height: int = 800, phone: bool = False) -> Iterator[Any]:
    """A Chromium that renders in software; ``phone``: a window narrower than Chromium's least."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(_CHROMIUM)
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        f"--window-size={width},{height}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    if phone:
        metrics = {"width": width, "height": height, "pixelRatio": 1.0}
        options.add_experimental_option("mobileEmulation", {"deviceMetrics": metrics})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(_DRIVER)))
    try:
        driver.set_script_timeout(110)
        yield driver
    finally:
        driver.quit()


def errors(driver: Any) -> list[str]:
    """What the page has complained of on its console since the last call."""
    return [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]


def text(driver: Any) -> str:
    """Everything that is to be read on the page."""
    return str(driver.execute_script("return document.body.innerText"))


def open_tab(driver: Any, name: str) -> None:
    """Bring a tab of the panel to the front."""
    from selenium.webdriver.common.by import By

    for tab in driver.find_elements(By.CSS_SELECTOR, "[role=tab]"):
        if tab.text.strip() == name:
            tab.click()
            return
    raise AssertionError(f"no tab {name!r}")


def press(driver: Any, label: str) -> bool:
    """Click the button with this label; False while there is none."""
    script = """
        const button = [...document.querySelectorAll('button')].find(
            b => b.innerText.trim() === arguments[0] && !b.disabled);
        if (button) button.click();
        return Boolean(button);
    """
    return bool(driver.execute_script(script, label))
