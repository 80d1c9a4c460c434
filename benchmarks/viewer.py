"""What the viewer costs a flight, and how long its STOP takes.

    python benchmarks/viewer.py --minutes 10 [--only off|on] [--noise]
    python benchmarks/viewer.py --stops 10

The first hovers through the whole bench pipeline (see ``scheduler.py``), once with nobody looking
and once with two browsers open, one on the flight and one on the operator's page; both browsers run
here, without a graphics processor, which is more load than any real one is. Told is how late the
30 Hz ticks were, ms. With --noise nobody looks once more at the end: what differs between these two
is the machine's.

The second presses STOP on the operator's page of so many bench flights. Told are the times, ms,
from the click in the browser to the vehicle's own word that its motors are off, as the flight shows
it: the way of the telemetry back (log packets every 20 ms, pictures every 33 ms) is in it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from scheduler import fly, shown

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from crazyarena.clock import WallClock
from crazyarena.live import Watched
from crazyarena.viewer_process import View, ViewOptions
from tests.browser import browser, open_tab, press, text

STOP = "STOP – cut the motors"
_OPENING = 120.0  # s


def until(holds: Any, seconds: float = _OPENING) -> None:
    """Wait until ``holds()``."""
    clock = WallClock()
    end = clock.now() + seconds
    while not holds():
        if clock.now() > end:
            raise SystemExit("it did not happen in time")
        clock.sleep_until(clock.now() + 0.002)


def opened() -> tuple[View, str]:
    """A view and its address."""
    said: list[str] = []
    view = View(ViewOptions(port=0), said.append)
    return view, said[0].split()[-1]


def lateness(seconds: float, looked_at: bool) -> dict[str, Any]:
    """Ticks of one flight."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="crazyarena-viewer-"))
        view = None
        if looked_at:
            view, url = opened()
            stack.callback(view.close)
            for name in ("Flight", "Operator"):
                driver = stack.enter_context(browser(800, 600))
                driver.get(url)
                until(lambda driver=driver: "Operator" in text(driver))
                open_tab(driver, name)
        episode = fly(seconds, Path(folder), view)
        browsers = None if view is None else view.live.reply().get("browsers")
    return {
        "browsers": browsers,
        "ticks": episode["steps"],
        "late": shown(episode["late_ms"]),
        "ours": shown(episode["late_own_ms"]),
        "machine": shown(episode["late_machine_ms"]),
        "skipped": episode["skipped_steps"],
        "missed_by_contestant": episode["missed_ticks"],
        "termination": episode["termination"],
        "error": episode["error"],
        "load_average": os.getloadavg()[0],
    }


def stop_once() -> dict[str, float]:
    """One flight that is stopped from the page."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="crazyarena-viewer-"))
        # Nobody else's flights are stopped.
        os.environ["CRAZYARENA_RUNTIME_DIR"] = folder
        view, url = opened()
        stack.callback(view.close)
        driver = stack.enter_context(browser(500, 400))
        driver.get(url)
        watched = Watched(view.live.file)
        results: dict[str, float] = {}

        def facts() -> dict[str, Any]:
            state = watched.state()
            return {} if state is None else state.facts

        def operator() -> None:
            until(lambda: facts().get("phase") == "run" and facts().get("time", 0.0) > 4.0)
            until(lambda: STOP in text(driver))
            driver.execute_script(
                "addEventListener('click', e => {"
                "  window.pressed = performance.timeOrigin + e.timeStamp}, true)"
            )
            before = watched.versions[1]
            press(driver, STOP)
            until(lambda: max(facts().get("motors") or [1.0]) == 0.0, 20.0)
            off = time.time()
            pressed = driver.execute_script("return window.pressed") / 1000.0
            results["motors_off_ms"] = 1000.0 * (off - pressed)
            results["pictures"] = watched.versions[1] - before

        thread = threading.Thread(target=operator)
        thread.start()
        episode = fly(60.0, Path(folder), view)
        thread.join()
        assert episode["termination"] == "SAFETY", episode["termination"]
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--only", choices=("off", "on"))
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--stops", type=int)
    arguments = parser.parse_args()
    if arguments.minutes is not None:
        flights = ["off", "on"] if arguments.only is None else [arguments.only]
        flights += ["off"] if arguments.noise else []
        worst: dict[str, list[float]] = {}
        for name in flights:
            found = lateness(60.0 * arguments.minutes, name == "on")
            print(json.dumps({name: found}, indent=2), flush=True)
            worst.setdefault(name, []).append(found["late"]["p99.9"])
        print(json.dumps({"p99.9 of the lateness, ms": worst}))
    if arguments.stops is not None:
        times = []
        for _ in range(arguments.stops):
            times.append(stop_once()["motors_off_ms"])
            print(json.dumps({"motors_off_ms": round(times[-1], 1)}), flush=True)
        told = {f"p{q}": round(float(np.percentile(times, q)), 1) for q in (50, 90, 100)}
        print(json.dumps({"stops": len(times), **told}))


if __name__ == "__main__":
    main()
