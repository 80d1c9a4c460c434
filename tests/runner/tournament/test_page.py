"""The page in a real browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from crazyarena.runner.tournament.page import write_pages
from crazyarena.runner.tournament.results import assemble, write_files
from tests.runner.tournament import made_up

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
webdriver = pytest.importorskip("selenium.webdriver")
needs_browser = pytest.mark.skipif(not (BROWSER and DRIVER), reason="no Chromium here")


def written(out: Path, **size: Any) -> Path:
    tournament = made_up.flown(out, **size)
    try:
        results = assemble(tournament)
        write_files(results)
        return write_pages(results)
    finally:
        tournament.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("page") / "out")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        yield driver
    finally:
        driver.quit()


def column(browser: Any, table: str, index: int) -> list[str]:
    script = (
        "return [...document.querySelectorAll(arguments[0] + ' tbody tr')]"
        ".map(r => r.cells[arguments[1]].dataset.v ?? r.cells[arguments[1]].textContent.trim())"
    )
    return browser.execute_script(script, table, index)


@needs_browser
def test_opens_without_a_word_on_the_console(browser, page):
    browser.get(page.as_uri())
    assert browser.title == "Made up"
    assert len(browser.find_elements("css selector", "#board tbody tr")) == 40
    assert browser.get_log("browser") == []
    # Nothing is fetched besides the page.
    names = browser.execute_script("return performance.getEntriesByType('resource').map(e=>e.name)")
    assert [name for name in names if not name.startswith("data:")] == []


@needs_browser
def test_sorts_by_every_column_both_ways(browser, page):
    browser.get(page.as_uri())
    heads = browser.find_elements("css selector", "#board thead th button")
    assert len(heads) == 8
    for index, head in enumerate(heads):
        for _ in range(2):
            head.click()
            way = head.find_element("xpath", "..").get_attribute("aria-sort")
            cells = column(browser, "#board", index)
            known = [cell for cell in cells if cell != ""]
            assert cells[: len(known)] == known, "what has no value comes last"
            try:
                numbers = [float(cell) for cell in known]
                assert numbers == sorted(numbers, reverse=way == "descending")
            except ValueError:
                ordered = sorted(known, key=str.casefold, reverse=way == "descending")
                assert known == ordered
    assert browser.get_log("browser") == []


@needs_browser
def test_every_link_leads_somewhere(browser, page):
    todo, seen, dead = [page.as_uri()], set(), []
    while todo:
        address = todo.pop()
        browser.get(address)
        assert browser.get_log("browser") == []
        ids = set(
            browser.execute_script("return [...document.querySelectorAll('[id]')].map(e=>e.id)")
        )
        links = browser.execute_script("return [...document.links].map(a => a.href)")
        for link in links:
            place, _, anchor = link.partition("#")
            if place == address.partition("#")[0]:
                if anchor and anchor not in ids:
                    dead.append(link)
            elif place not in seen:
                seen.add(place)
                if not Path(place.removeprefix("file://")).is_file():
                    dead.append(place)
                # Three teams stand for all.
                if place.endswith((".html",)) and len([s for s in seen if ".html" in s]) < 4:
                    todo.append(place)
    assert not dead
    assert any(place.endswith(".mcap") for place in seen)
    assert any(place.endswith(".yaml") for place in seen)


@needs_browser
@pytest.mark.parametrize("width", [360, 1280])
def test_fits_a_phone_and_a_screen(browser, page, width):
    size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.get(page.as_uri())
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        size = "return parseFloat(getComputedStyle(document.querySelector('td')).fontSize)"
        assert browser.execute_script(size) >= 14
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@needs_browser
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_stands_out_in_light_and_dark(browser, page, theme):
    media = {"features": [{"name": "prefers-color-scheme", "value": theme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    browser.get(page.as_uri())
    assert contrast(browser, "body", "body") >= 7.0
    for thing in ("td .good", "td .bad", "tr.out td", ".dim", "a", ".points"):
        assert contrast(browser, thing, "body") >= 4.5, thing
    before = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    browser.find_element("id", "theme").click()
    assert (
        browser.execute_script("return getComputedStyle(document.body).backgroundColor") != before
    )


def contrast(browser: Any, text: str, ground: str) -> float:
    """WCAG's contrast ratio of the first ``text`` on ``ground``."""
    script = "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]"
    pair = [browser.execute_script(script, text, "color"),
            browser.execute_script(script, ground, "backgroundColor")]  # fmt: skip
    shades = []
    for colour in pair:
        numbers = [float(x) / 255 for x in colour.partition("(")[2].rstrip(")").split(",")[:3]]
        linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in numbers]
        shades.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])
    return (max(shades) + 0.05) / (min(shades) + 0.05)


@needs_browser
def test_prints_in_black_on_white_with_all_flights(browser, page):
    media = {
        "media": "print",
        "features": [{"name": "prefers-color-scheme", "value": "dark"}],
    }
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        browser.get(page.as_uri())
        style = "return getComputedStyle(document.body)[arguments[0]]"
        assert browser.execute_script(style, "backgroundColor") in (
            "rgb(255, 255, 255)",
            "rgba(0, 0, 0, 0)",
        )
        assert browser.execute_script(style, "color") == "rgb(0, 0, 0)"
        shown = "return getComputedStyle(document.querySelector(arguments[0])).display"
        assert browser.execute_script(shown, "nav") == "none"
        assert browser.execute_script(shown, ".flights svg") != "none"
        pdf = browser.execute_cdp_cmd("Page.printToPDF", {})["data"]
        assert len(pdf) > 10_000
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_words_of_contestants_are_no_markup(tmp_path):
    page = written(tmp_path / "out", teams=2, levels=("level0",), seeds=6)
    texts = [file.read_text() for file in (page.parent / "teams").glob("*.html")]
    assert any("&lt;b&gt;markup &amp; more&lt;/b&gt;" in text for text in texts)
    assert not any("<b>markup" in text for text in texts)
