"""Recorded flights beside each other on one time line, in the browser."""

from __future__ import annotations

import bisect
import html
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import InputError
from crazyarena.runner.viewer.fleet import Fleet, colours
from crazyarena.runner.viewer.recorded import Flight
from crazyarena.runner.viewer.server import frame, go_to, look_at
from crazyarena.runner.viewer.stage import Stage

Array = NDArray[np.float64]

RATE = 30.0  # pictures a second
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")
_GHOST = 0.35
_PATH_STEP = 0.02  # s
_MOST_EVENTS = 6
_DRAWN = "drawings"  # id of what controllers of lsy_drone_racing draw
_SLIDER = 0.1  # s, between moves of the slider while it plays
# From slow to fast, without red beside green (viridis).
_SPEED_COLOURS = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]
)


class Replay:
    """Shows flights; the first is solid, others are ghosts beside it.

    Parameters
    ----------
    server: of viser.
    flights: at least one. Their times are those of their runs: 0 is the start.
    """

    def __init__(self, server: Any, flights: list[Flight], clock: Clock | None = None) -> None:
        if not flights:
            raise InputError("replay: no flights")
        self._flights = flights
        self._clock = clock if clock is not None else WallClock()
        self.begin = min(float(flight.time[0]) for flight in flights)
        self.end = max(float(flight.time[-1]) for flight in flights)
        self.time = self.begin
        self.playing = False
        self.speed = 1.0
        self._shown: tuple[Any, ...] = ()
        self._slider_at = -math.inf
        self._update = -1
        self._entities: dict[Any, dict[str, Any]] = {}
        self._colours = colours(len(flights))
        self._stage = Stage(server.scene)
        self._stage.show(flights[0].scene)
        bounds = Stage.bounds(flights[0].scene)
        look_at(server, *bounds)
        server.on_client_connect(lambda client: frame(client, *bounds))
        solid = np.array([1.0] + [_GHOST] * (len(flights) - 1))
        self._fleet = Fleet(server.scene, None if len(flights) == 1 else solid)
        self._show_paths()
        self._panel(server.gui)

    def _show_paths(self) -> None:
        segments, shades = [], []
        for k, flight in enumerate(self._flights):
            step = max(1, round(_PATH_STEP / max(1e-6, float(np.median(np.diff(flight.time))))))
            kept = flight.position[::step] if len(flight.time) > 2 else flight.position
            pairs = np.stack([kept[:-1], kept[1:]], axis=1)
            if len(self._flights) == 1:
                speed = flight.speed[::step][: len(pairs)]
                shade = speed_colours(speed)[:, None, :]
            else:
                shade = self._colours[k][None, None, :]
            good = np.isfinite(pairs).all(axis=(1, 2))
            segments.append(pairs[good])
            shades.append(np.broadcast_to(shade, pairs.shape)[good])
        self._fleet.segments(np.concatenate(segments), np.concatenate(shades).astype(np.uint8))

    def _panel(self, gui: Any) -> None:
        self._title = gui.add_html(self._heading())
        step = 0.01
        self._slider = gui.add_slider(
            "time, s",
            min=round(self.begin, 2),
            max=max(round(self.begin, 2) + step, math.ceil(self.end * 100) / 100),
            step=step,
            initial_value=round(self.begin, 2),
        )
        self._button = gui.add_button("Play", icon="player-play")
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        names = [self._label(k) for k in range(len(self._flights))]
        self._choice = gui.add_dropdown("told of", names) if len(names) > 1 else None
        events = self._marks()
        self._jump = gui.add_dropdown("go to", list(events)) if events else None
        near = gui.add_button("Go to the vehicle", icon="zoom-in", color="gray")
        self._facts = gui.add_html("")

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # a hand, not the player
                self.seek(float(self._slider.value))

        @self._button.on_click
        def _(event: Any) -> None:
            self.play(not self.playing)

        @near.on_click
        def _(event: Any) -> None:
            go_to(event.client, flight_at(self._flights[self._which()], self.time)[0])

        @self._speed.on_update
        def _(event: Any) -> None:
            self.speed = float(self._speed.value)

        if self._jump is not None:
            jump = self._jump

            @jump.on_update
            def _(event: Any) -> None:
                if event.client is not None:
                    self.seek(events[jump.value])
                    self._slider_at = -math.inf

    def _label(self, k: int) -> str:
        return f"{k + 1}: {self._flights[k].name}"

    def _marks(self) -> dict[str, float]:
        """Times worth going to, of the first flight."""
        return {
            f"{event['time']:.2f} s {event['event']}"[:60]: float(event["time"])
            for event in self._flights[0].events
            if math.isfinite(event["time"]) and event["event"] != "phase"
        }

    def _heading(self) -> str:
        rows = []
        for k, flight in enumerate(self._flights):
            r, g, b = self._colours[k].tolist()
            note = "" if flight.complete else " <i>(cut short)</i>"
            rows.append(
                f'<div><span style="color:rgb({r},{g},{b})">&#9632;</span> '
                f"{html.escape(flight.name)}{note}</div>"
            )
        title = html.escape(str(self._flights[0].scene.get("title", "")))
        shown = "".join(rows[:12]) + (
            f"<div>and {len(rows) - 12} more</div>" if len(rows) > 12 else ""
        )
        return f'<div style="font-size:0.85em;padding:0.3em 1em"><b>{title}</b>{shown}</div>'

    def play(self, on: bool) -> None:
        """Play or pause; from the beginning if it stands at the end."""
        if on and self.time >= self.end - 1e-9:
            self.time = self.begin
        self.playing = on
        self._button.label = "Pause" if on else "Play"

    def seek(self, time: float) -> None:
        """Go to a time, s."""
        self.time = min(self.end, max(self.begin, time))
        if abs(self._slider.value - self.time) > 0.005:
            self._slider.value = round(self.time, 2)

    def run(self, stop: Any) -> None:
        """Show until ``stop`` (a threading.Event) is set."""
        clock = self._clock
        last = clock.now()
        while not stop.is_set():
            now = clock.now()
            if self.playing:
                self.time += (now - last) * self.speed
                if self.time >= self.end:
                    self.time = self.end
                    self.play(False)
                    self._slider_at = -math.inf
                if now - self._slider_at >= _SLIDER:
                    self._slider_at = now
                    self._slider.value = round(self.time, 2)
            last = now
            self.show()
            clock.sleep_until(now + 1.0 / RATE)

    def _which(self) -> int:
        """Number of the flight that is told of."""
        return 0 if self._choice is None else int(self._choice.value.partition(":")[0]) - 1

    def show(self) -> None:
        """Show what there is at the present time."""
        which = self._which()
        now = (round(self.time, 4), which)
        if now == self._shown:
            return
        self._shown = now
        places = [flight_at(flight, self.time) for flight in self._flights]
        positions, turns, setpoints = (np.array(part) for part in zip(*places, strict=True))
        setpoints[np.arange(len(places)) != which] = np.nan
        self._fleet.place(positions, turns, self._colours, setpoints)
        self._show_update()
        self._facts.content = told_at(self._flights[which], self.time)

    def _show_update(self) -> None:
        """What the contestant has drawn, and gates that have moved, of the first flight."""
        updates = self._flights[0].updates
        latest = bisect.bisect_right(updates, self.time, key=lambda update: update[0]) - 1
        if latest == self._update or not updates:
            return
        scene = dict(self._flights[0].scene)
        if latest < self._update:
            self._entities = {}
            self._update = -1
        if not self._entities:
            self._entities = {e.get("id"): e for e in scene["track"] if isinstance(e, dict)}
        for _, update in updates[max(0, self._update + 1) : latest + 1]:
            self._entities |= {e.get("id"): e for e in update if isinstance(e, dict)}
        self._update = latest
        drawn = [e for name, e in self._entities.items() if name == _DRAWN]
        track = [e for name, e in self._entities.items() if name != _DRAWN]
        self._stage.show({**scene, "track": track, "drawn": drawn})


def speed_colours(speed: Array) -> NDArray[np.uint8]:
    """(n, 3) colours of speeds (n,), from 0 to the fastest."""
    top = float(np.nanmax(speed, initial=0.0)) or 1.0
    share = np.nan_to_num(speed / top) * (len(_SPEED_COLOURS) - 1)
    knots = np.arange(len(_SPEED_COLOURS))
    parts = [np.interp(share, knots, _SPEED_COLOURS[:, k]) for k in range(3)]
    return np.stack(parts, axis=1).astype(np.uint8)


def flight_at(flight: Flight, time: float) -> tuple[Array, Array, Array]:
    """Position, attitude and setpoint at a time, s: of the last row up to then; where it began
    before its beginning, and where it ended after its end."""
    k = int(np.clip(np.searchsorted(flight.time, time, side="right") - 1, 0, len(flight.time) - 1))
    return flight.position[k], flight.quaternion[k], flight.setpoint[k]


def told_at(flight: Flight, time: float) -> str:
    """What is to be said of a flight at a time, as HTML."""
    k = int(np.clip(np.searchsorted(flight.time, time, side="right") - 1, 0, len(flight.time) - 1))
    x, y, z = flight.position[k]
    rows = [
        ("time", f"{time:.2f} s"),
        ("place", f"{x:.2f}, {y:.2f}, {z:.2f} m"),
        ("speed", f"{flight.speed[k]:.2f} m/s"),
    ]
    if flight.fence is not None and np.isfinite(flight.position[k]).all():
        rows.append(("to the fence", f"{flight.fence.room(float(x), float(y), float(z)):.2f} m"))
    m = int(np.searchsorted(flight.told_time, time, side="right")) - 1
    if m >= 0:
        gate, exact = flight.told[m]
        word = "all passed" if gate < 0 else f"{gate:.0f} ({'exact' if exact else 'nominal'} pose)"
        rows.append(("next gate", word))
    cells = "".join(f"<tr><td>{a}</td><td><b>{html.escape(b)}</b></td></tr>" for a, b in rows)
    past = [event for event in flight.events if event["time"] <= time][-_MOST_EVENTS:]
    lines = "".join(
        f"<div>{event['time']:.2f} s <b>{html.escape(event['event'])}</b> "
        f"{html.escape(event['detail'][:120])}</div>"
        for event in reversed(past)
    )
    return (
        f'<div style="font-size:0.85em;padding:0.3em 1em"><table id="facts">{cells}</table>'
        f'<div id="events" style="margin-top:0.5em">{lines}</div></div>'
    )
