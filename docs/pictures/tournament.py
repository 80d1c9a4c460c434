"""Makes the pictures of docs/tournament.md: the page of a tournament, in the dark, and on a phone.

    python docs/pictures/tournament.py [FOLDER] [--seeds N]

Twelve submissions, half of them hostile, as ``benchmarks/tournament.py`` has them; with ten draws
of each level that takes some minutes. Needs Debian's chromium and chromium-driver, and the extras
``dev``, ``tournament`` and ``viewer``.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from tournament import make_submissions  # noqa: E402

from tests.browser import browser  # noqa: E402

WIDE, DARK, PHONE = (1180, 757), (1180, 657), (390, 844)
_COLOURS = 128
_LOOK = """
document.documentElement.dataset.theme = arguments[0];
document.documentElement.style.scrollbarWidth = "none";
"""
_TO_LEVEL = """
const head = [...document.querySelectorAll("h2")].find(h => h.textContent.trim() === arguments[0]);
scrollTo(0, head.getBoundingClientRect().top + scrollY - 30);
"""


def save(driver: Any, file: Path, width: int, height: int) -> None:
    """Few colours: pictures in a repository are there for ever."""
    picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    picture = picture.crop((0, 0, min(width, picture.width), min(height, picture.height)))
    picture.quantize(_COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)
    print(f"{file}: {file.stat().st_size // 1000} kB")


def main() -> None:
    """Fly and photograph."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument("--seeds", type=int, default=10)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="crazyarena-pictures-") as name:
        scratch = Path(name)
        (scratch / "submissions").mkdir()
        make_submissions(scratch / "submissions")
        line = [
            "tournament",
            str(scratch / "submissions"),
            "--levels",
            "level0,level1,level2,level3",
        ]
        line += ["--seeds", str(arguments.seeds)]
        line += ["--out", str(scratch / "out"), "--no-record"]
        done = subprocess.run([sys.executable, "-m", "crazyarena", *line], cwd=ROOT)
        if done.returncode not in (0, 1):
            raise SystemExit(f"crazyarena {' '.join(line)}: exit code {done.returncode}")
        page = (scratch / "out" / "index.html").as_uri()
        # A window has a frame, which is cut off again.
        with browser(WIDE[0], WIDE[1] + 200) as driver:
            driver.get(page)
            driver.execute_script(_LOOK, "light")
            save(driver, arguments.folder / "tournament.png", *WIDE)
            driver.execute_script(_LOOK, "dark")
            driver.execute_script(_TO_LEVEL, "level3")
            save(driver, arguments.folder / "tournament-dark.png", *DARK)
        with browser(*PHONE, phone=True) as driver:
            driver.get(page)
            driver.execute_script(_LOOK, "light")
            save(driver, arguments.folder / "tournament-phone.png", *PHONE)


if __name__ == "__main__":
    main()
