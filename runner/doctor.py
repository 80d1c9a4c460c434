"""What works on this machine, and what would make the rest work; behind ``crazyarena doctor``."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from crazyarena.errors import CrazyarenaError

_CRAZYRADIO = (0x1915, 0x7777)
_IDLE = """\
class Controller:
    def __init__(self, *arguments, **options):
        pass

    def cmdFirmware(self, *arguments, **options):
        raise NotImplementedError
"""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """works: True, False, or None for in part; found in plain words; remedy, if there is one;
    needed: nothing flies without it."""

    name: str
    works: bool | None
    found: str
    remedy: str = ""
    needed: bool = False


def _python() -> Diagnosis:
    found = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    return Diagnosis(
        "python", sys.version_info >= (3, 11), found, "Use Python 3.11 or newer.", True
    )


def _kernels() -> Diagnosis:
    from crazyarena import jit
    from crazyarena.runner.warm_up import PARTS, missing

    folder = jit.cache_folder()
    cold = missing(list(PARTS))
    if folder.is_relative_to(tempfile.gettempdir()):
        remedy = "Set XDG_CACHE_HOME to a folder that stays and can be written to."
        return Diagnosis("compile cache", None, f"only in {folder}", remedy, True)
    if cold:
        names = ", ".join(PARTS[name].name for name in cold)
        found = f"in {folder}; not compiled yet: {names}"
        return Diagnosis("compile cache", None, found, "Run crazyarena warm-up.", True)
    return Diagnosis("compile cache", True, f"everything is compiled, in {folder}", needed=True)


def _sandbox() -> Diagnosis:
    name, remedy = "sandbox", "Install bubblewrap, or use a kernel with Landlock and seccomp."
    if sys.platform != "linux":
        remedy = "Fly strangers' code on Linux; your own runs here with --no-sandbox."
        return Diagnosis(name, False, "needs Linux", remedy)
    from crazyarena.runner.contestant.sandbox.process import Sandboxed

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "idle.py"
        file.write_text(_IDLE)
        try:
            contestant = Sandboxed(file)
        except CrazyarenaError as error:
            return Diagnosis(name, False, str(error).splitlines()[0], remedy)
        with contextlib.closing(contestant):
            walls = ", ".join(contestant.description["sandbox"])
            missing = contestant.description["missing"]
    if missing:
        return Diagnosis(name, None, f"{walls}; not shut off: {', '.join(missing)}", remedy)
    return Diagnosis(name, True, walls)


def _real_time() -> Diagnosis:
    name = "real time"
    if sys.platform != "linux":
        return Diagnosis(name, False, "needs Linux", "Fly and bench on Linux.")
    from crazyarena.clock import WallClock
    from crazyarena.runner.timing.steady import steady

    with steady(WallClock()) as notes:
        told = list(notes)
    # What is refused says after a colon what it costs, and how to allow it.
    refused = [note for note in told if ": " in note]
    found = "; ".join(note.partition(":")[0] for note in told)
    remedies = " ".join(note.partition(": ")[2] for note in refused)
    return Diagnosis(name, None if refused else True, found, remedies)


def _radio() -> Diagnosis:
    name = "radio"
    try:
        import libusb_package
        import usb.core

        found = list(
            usb.core.find(
                find_all=True,
                idVendor=_CRAZYRADIO[0],
                idProduct=_CRAZYRADIO[1],
                backend=libusb_package.get_libusb1_backend(),
            )
        )
    except Exception as error:  # drivers of foreign packages, whatever they raise
        return Diagnosis(name, False, f"USB cannot be searched ({error})", "Install libusb.")
    if not found:
        remedy = "Plug in a Crazyradio; crazyarena bench flies without one."
        return Diagnosis(name, None, "no Crazyradio is plugged in", remedy)
    return Diagnosis(name, True, f"{len(found)} Crazyradio{'s' if len(found) > 1 else ''}")


def _extra(name: str, package: str, extra: str, gives: str) -> Callable[[], Diagnosis]:
    def look() -> Diagnosis:
        if find_spec(package) is not None:
            return Diagnosis(name, True, gives)
        remedy = f"pip install 'crazyarena[{extra}]'"
        return Diagnosis(name, None, f"not installed: {gives}", remedy)

    return look


def _zenoh() -> Diagnosis:
    try:
        import zenoh  # noqa: F401
    except Exception as error:
        return Diagnosis("zenoh", False, str(error), "pip install eclipse-zenoh", True)
    return Diagnosis("zenoh", True, "poses, gate poses and stops over a network")


def _pictures() -> Diagnosis:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if os.environ.get("DISPLAY") or sys.platform != "linux":
        return Diagnosis("display", True, "windows can be opened")
    found = "none; figures are files" + ("" if chromium is None else ", pages open in a browser")
    return Diagnosis("display", None, found)


def examine() -> Iterator[Diagnosis]:
    """Look at one thing after the other; some take seconds."""
    yield _python()
    yield _kernels()
    yield _sandbox()
    yield _real_time()
    yield _radio()
    yield _zenoh()
    extras = (
        ("cameras", "motioncapture", "mocap", "Vicon, Qualisys, OptiTrack, VRPN and others"),
        ("viewer", "viser", "viewer", "flights in a browser"),
        ("gamepad", "evdev", "gamepad", "emergency stop and dead-man's button"),
        ("video", "imageio_ffmpeg", "video", "films of a viewer"),
        ("symbolic", "casadi", "symbolic", "the symbolic model of the 2022 contract"),
        ("pybullet", "pybullet", "pybullet", "a second physics engine, its window and cameras"),
    )
    for extra in extras:
        yield _extra(*extra)()
    yield _pictures()
