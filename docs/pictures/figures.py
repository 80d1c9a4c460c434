"""Makes the pictures that need no viewer: figures, a contact sheet, an arena and a report.

    python docs/pictures/figures.py [FOLDER]

The report is photographed by Debian's chromium; without one it is left as it is.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent.parent
_COLOURS = 128
_PATIENCE = 300.0  # s
_REPORT = (1000, 1150)

# Takes off, flies past the first gate and into its side.
MISS = """\
from competition_utils import Command


class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.step = 0

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        self.step += 1
        if self.step == 1:
            return Command.TAKEOFF, [1.0, 1.0]
        if self.step == 60:
            return Command.GOTO, [[1.2, -2.68, 1.0], 0.0, 3.0, False]
        return Command.NONE, []
"""


def crazyarena(*arguments: str | Path) -> None:
    """Run a command of ours; a flight that fails is no failure here."""
    command = [sys.executable, "-m", "crazyarena", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}")


def keep(made: Path, file: Path) -> None:
    """Few colours: pictures in a repository are there for ever."""
    picture = Image.open(made).convert("RGB")
    picture.quantize(_COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)
    print(f"{file}: {file.stat().st_size // 1000} kB")


def photograph(page: Path, made: Path) -> bool:
    """A picture of a page; False without a browser."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print("no chromium: the report is not photographed")
        return False
    width, height = _REPORT
    subprocess.run(
        [
            chromium, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            f"--window-size={width},{height}", f"--screenshot={made}", page.as_uri(),
        ],
        check=True, timeout=_PATIENCE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    return True


def main() -> None:
    """Make all of them."""
    images = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images"
    images.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        crazyarena("dry-run", "--level", "level3", "--episodes", "1", "--out", folder / "level3")
        keep(folder / "level3" / "episode_000.png", images / "level3.png")
        (folder / "miss.py").write_text(MISS)
        crazyarena("dry-run", folder / "miss.py", "--episodes", "1", "--out", folder / "miss")
        keep(folder / "miss" / "episode_000.png", images / "figure_failure.png")
        many = ("--level", "level3", "--episodes", "24", "--no-record")
        crazyarena("dry-run", *many, "--out", folder / "many")
        keep(folder / "many" / "episodes.png", images / "contact_sheet.png")
        crazyarena("arena-check", "sim2real", "--out", folder / "arena.png")
        keep(folder / "arena.png", images / "arena.png")
        crazyarena("report", folder / "miss")
        if photograph(folder / "miss" / "report.html", folder / "report.png"):
            keep(folder / "report.png", images / "report.png")


if __name__ == "__main__":
    main()
