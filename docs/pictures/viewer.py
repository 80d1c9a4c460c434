"""Makes the pictures of docs/viewer.md: a replay and an operator's page, wide and as on a phone.

    python docs/pictures/viewer.py [FOLDER]

Needs Debian's chromium and chromium-driver, and the extras ``dev`` and ``viewer``.
"""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))

from tests.browser import browser, open_tab, press, text  # noqa: E402

WIDE, PHONE = (1000, 680), (390, 780)
_PATIENCE = 400.0  # s; browsers that render in software are slow beside others
_COLOURS = 128
_ATTEMPTS = 4
_SOFTWARE = "Software WebGL rendering detected"


@contextlib.contextmanager
def running(*arguments: str) -> Iterator[str]:
    """Run a command of ours that opens a viewer; gives the viewer's address."""
    command = [sys.executable, "-u", "-m", "crazyarena", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if found := re.search(r"http://\S+", line):
                yield found.group()
                break
        else:
            raise SystemExit(f"{' '.join(arguments)}: opened no viewer")
    finally:
        process.terminate()
        process.wait()


def until(holds: Any) -> None:
    end = time.monotonic() + _PATIENCE
    while not holds():
        if time.monotonic() > end:
            raise SystemExit("the page did not come in time")
        time.sleep(0.1)


def settle(driver: Any) -> None:
    """Close what the browser says of itself, and let it draw."""
    driver.execute_script(
        "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
    )
    until(lambda: _SOFTWARE not in text(driver))
    time.sleep(2.0)


def save(driver: Any, file: Path) -> None:
    """Few colours: pictures in a repository are there for ever."""
    picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    picture.quantize(_COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)
    print(f"{file}: {file.stat().st_size // 1000} kB")


def replay(folder: Path, runs: str) -> None:
    with running("replay", runs, "--view-port", "0") as url:
        for name, (width, height) in (("wide", WIDE), ("phone", PHONE)):
            with browser(width, height, phone=name == "phone") as driver:
                driver.get(url)
                until(lambda driver=driver: "to the fence" in text(driver))
                if name == "wide":
                    press(driver, "Play")
                    time.sleep(4.0)
                    press(driver, "Pause")
                settle(driver)
                save(driver, folder / f"viewer_replay_{name}.png")


def operator(folder: Path, runs: str, name: str, size: tuple[int, int]) -> None:
    for attempt in range(_ATTEMPTS):
        if _operator(folder, f"{runs}-{attempt}", name, size):
            return
    raise SystemExit("the flights were over before their page was drawn: too busy a machine")


def _operator(folder: Path, runs: str, name: str, size: tuple[int, int]) -> bool:
    """Photograph the page of a flight; False if that was over meanwhile."""
    with browser(*size, phone=name == "phone") as driver:
        # Simulated, at the pace of time: the page is that of a flight.
        line = ("fly", "--backend", "sim", "--view", "--view-port", "0", "--no-figure")
        # Two browsers that render in software must not count as the contestant's thinking.
        with running(*line, "--compute", "free", "--out", runs) as url:
            driver.get(url)
            until(lambda: "Operator" in text(driver))
            open_tab(driver, "Operator")
            until(lambda: "gate passed" in text(driver))
            settle(driver)
            file = folder / f"viewer_operator_{name}.png"
            # Beside the others, until it is known to show what it should.
            made = folder / f".{file.name}"
            save(driver, made)
            flies = "STOP" in text(driver)
            made.replace(file) if flies else made.unlink()
            return flies


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="crazyarena-pictures-") as scratch:
        runs = str(Path(scratch) / "runs")
        line = ("dry-run", "--level", "level3", "--episodes", "3", "--seed", "7", "--no-figure")
        subprocess.run([sys.executable, "-m", "crazyarena", *line, "--out", runs], check=True)
        replay(folder, runs)
        operator(folder, str(Path(scratch) / "wide"), "wide", WIDE)
        operator(folder, str(Path(scratch) / "phone"), "phone", PHONE)


if __name__ == "__main__":
    main()
