"""A live flight in the browser: what flies in one tab, the operator's page in another."""

from __future__ import annotations

import base64
import io
import math
import struct
import threading
import wave
from typing import Any

import numpy as np

from crazyarena.clock import Clock, WallClock
from crazyarena.live import COLOUR, POSITION, QUATERNION, SETPOINT, STOP, State, Watched
from crazyarena.plain_text import shown_line
from crazyarena.runner.viewer.fleet import Fleet, colours
from crazyarena.runner.viewer.operator_page import page
from crazyarena.runner.viewer.server import Rights, connection_of, frame, go_to, look_at
from crazyarena.runner.viewer.stage import Stage
from crazyarena.runner.viewer.sure_button import LOOKS, SureButton
from crazyarena.runner.viewer.trails import Trails
from crazyarena.safety.estop_local import LANDING, STOPPED, stop_local

RATE = 30.0  # pictures a second
_RATE_OF_MANY = 15.0
_MANY = 10  # vehicles
_IDLE = 2.0  # pictures a second while nobody looks
_WORDS = 0.2  # s, between new words
_PATHS = 0.25  # s, between new paths
_FAREWELL = 2.5  # s, for a page that is being reloaded
_HOLD = 1.5  # s of holding a button that arms
_GAP = 0.5  # s; a hold that pauses for longer begins anew
_SOURCE = "operator's page"
_STOP_LABEL = "STOP – cut the motors"
_LAND_LABEL = "LAND"
_ARM_LABEL = "Hold to arm"
_READ_ONLY = '<div style="padding:0.2em 1em;font-size:0.85em">read only</div>'
_NOT_THE_TOKEN = _READ_ONLY.replace("read only", "read only: this is not the token")
# A button one can hit without looking for it, as those of LOOKS.
_LOOKS = """<style>
button[data-block=true][data-with-left-section=true] {
  height: 3.4em !important; font-size: 1.15em !important; font-weight: 700;
}
</style>"""
_RED, _ORANGE = "#d6202a", "#d9730d"


class LivePage:
    """Shows a live flight until it has ended and the last browser is closed.

    Parameters
    ----------
    server: of viser. watched: the flight. rights: which browsers may stop, land and arm.
    """

    def __init__(
        self, server: Any, watched: Watched, rights: Rights, clock: Clock | None = None
    ) -> None:
        self._server = server
        self._watched = watched
        self._rights = rights
        self._clock = clock if clock is not None else WallClock()
        self._stage = Stage(server.scene)
        self._fleet = Fleet(server.scene)
        self._trails = Trails(server.scene)
        self._rate = RATE if watched.vehicles <= _MANY else _RATE_OF_MANY
        self._versions = (-1, -1)
        self._path: tuple[Any, ...] = ()
        self._news = self._clock.now()
        self._told = self._drawn = -math.inf
        self._state: State | None = None
        self._drew = False
        self._control = False
        self._question = ""
        self._confirmed: str | None = None
        self._consoles: dict[int, _Console] = {}
        self._bounds: tuple[Any, Any] | None = None
        self._lock = threading.Lock()
        server.gui.add_html(_LOOKS + LOOKS, order=0)
        tabs = server.gui.add_tab_group(order=10)
        with tabs.add_tab("Flight", icon="drone"):
            self._title = server.gui.add_html("")
            self._choices()
        self._tab = tabs.add_tab("Operator", icon="dashboard")
        with self._tab:
            self._words = server.gui.add_html("", order=100)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._farewell)

    def _choices(self) -> None:
        """What of the moving things is shown."""
        self._show_paths = self._server.gui.add_checkbox("path flown", True)
        self._show_setpoints = self._server.gui.add_checkbox("setpoints", True)
        self._show_stops = self._server.gui.add_checkbox("predicted stop", True)
        near = self._server.gui.add_button("Go to the vehicle", color="gray")

        @near.on_click
        def _(event: Any) -> None:
            if self._state is not None:
                go_to(event.client, self._state.rows[0, POSITION : POSITION + 3])

    # Browsers

    def _welcome(self, client: Any) -> None:
        console = _Console(self, client, self._tab)
        with self._lock:
            self._consoles[client.client_id] = console
            bounds = self._bounds
        if bounds is not None:
            frame(client, *bounds)
        if self._rights.without_token(connection_of(self._server, client)):
            console.allow()
        else:
            console.only_look(self._rights.by_token)
        console.update(self._control, self._question)

    def _farewell(self, client: Any) -> None:
        with self._lock:
            self._consoles.pop(client.client_id, None)

    @property
    def browsers(self) -> int:
        """How many look."""
        with self._lock:
            return len(self._consoles)

    def knows(self, token: str) -> bool:
        """Whether this token gives the right to stop, land and arm."""
        return self._rights.knows(token)

    def confirm(self) -> None:
        """The operator has answered the present question with yes."""
        self._confirmed = self._question or None
        self._answer()

    def _answer(self) -> None:
        self._watched.reply({"browsers": self.browsers, "confirm": self._confirmed})

    # Pictures

    def run(self) -> None:
        """Show the flight to its end, and on as long as a browser does."""
        clock = self._clock
        alone = clock.now()
        while True:
            now = clock.now()
            over = self._watched.over
            looked_at = self.browsers > 0
            if looked_at or not over:
                alone = now
            elif now - alone > _FAREWELL:
                return
            self.show(now, over)
            clock.sleep_until(now + 1.0 / (self._rate if looked_at else _IDLE))

    def show(self, now: float, over: bool) -> None:
        """Show the newest state."""
        watched, versions = self._watched, self._watched.versions
        if versions[0] != self._versions[0]:
            self._show_scene(watched.scene())
        if versions[1] != self._versions[1]:
            state = watched.state()
            if state is not None:
                self._state, self._news = state, now
                self._show_vehicles(state)
        self._versions = versions
        if now - self._drawn >= _PATHS:
            self._drawn = now
            self._show_ways()
            self._answer()
        if now - self._told >= _WORDS:
            self._told = now
            facts = {} if self._state is None else self._state.facts
            self._words.content = page(facts, now - self._news, over)
            self._title.content = _title(facts)
            self._tell_consoles(facts, over)

    def _show_scene(self, scene: dict[str, Any]) -> None:
        self._stage.show(scene)
        bounds = Stage.bounds(scene)
        with self._lock:
            before, self._bounds = self._bounds, bounds
            consoles = list(self._consoles.values())
        if before is not None and all(map(np.array_equal, before, bounds)):
            return  # whoever looks from somewhere else goes on doing so
        look_at(self._server, *bounds)
        for console in consoles:
            frame(console.client, *bounds)

    def _show_vehicles(self, state: State) -> None:
        rows = state.rows
        nowhere = np.full((len(rows), 3), np.nan)
        self._fleet.place(
            rows[:, POSITION : POSITION + 3],
            rows[:, QUATERNION : QUATERNION + 4],
            _colours(rows[:, COLOUR : COLOUR + 3]),
            rows[:, SETPOINT : SETPOINT + 3] if self._show_setpoints.value else nowhere,
            rows[:, STOP : STOP + 3] if self._show_stops.value else nowhere,
        )

        facts = state.facts
        if facts.get("edges") or facts.get("ellipsoid") or self._drew:
            self._drew = bool(facts.get("edges") or facts.get("ellipsoid"))
            spots = rows[:, POSITION : POSITION + 3]
            self._fleet.drawn(spots, facts.get("edges"), facts.get("ellipsoid"))

    def _show_ways(self) -> None:
        episode, count = self._watched.path_version()
        wanted = bool(self._show_paths.value)
        version = (episode, count, wanted)
        if version == self._path:
            return
        if not wanted or self._path[:1] != (episode,):
            self._trails.clear()
        self._path = version
        if wanted and self._state is not None:
            shades = _colours(self._state.rows[:, COLOUR : COLOUR + 3])
            self._trails.show(*self._watched.paths(), shades)

    def _tell_consoles(self, facts: dict[str, Any], over: bool) -> None:
        self._control = bool(facts.get("control")) and not over
        question = facts.get("question")
        known = isinstance(question, dict) and not over
        self._question = str(question.get("id", "")) if known and question else ""
        alarm = bool(facts.get("taken")) and not over
        with self._lock:
            consoles = list(self._consoles.values())
        for console in consoles:
            console.update(self._control, self._question, alarm)


class _Console:
    """What one browser may do."""

    def __init__(self, shown: LivePage, client: Any, tab: Any) -> None:
        self._shown = shown
        self.client = client
        self._tab = tab
        self._buttons: list[SureButton] = []
        self._arm: Any = None
        self._gate: list[Any] = []
        self._letters = threading.Lock()
        self._was: tuple[bool, str] | None = None
        self._held = (-math.inf, -math.inf)  # since, last
        self._alarm = False
        with tab:
            self._sounds = client.gui.add_checkbox("sounds", False, order=90)
            self._sound = client.gui.add_html("", order=91)

    def only_look(self, by_token: bool) -> None:
        """Without rights; the token gives them, if there is one."""
        gui = self.client.gui
        with self._tab:
            if not by_token:
                self._gate = [gui.add_html(_READ_ONLY, order=1)]
                return
            field = gui.add_text(
                "token", "", order=1, hint="The secret that lets you stop and arm."
            )
            told = gui.add_html(_READ_ONLY, order=2)
        self._gate = [field, told]

        # No button beside it: the browser sends only the newest of what changes within 50 ms
        # (viser's throttle), so that a click soon after the last letter would lose letters.
        @field.on_update
        def _(event: Any) -> None:
            # Letters are told by several threads, each of which may see the last one.
            with self._letters:
                if not self._gate:
                    return
                if self._shown.knows(field.value):
                    for part in self._gate:
                        part.remove()
                    self._gate = []
                    self.allow()
                else:
                    told.content = _NOT_THE_TOKEN if field.value else _READ_ONLY

    def allow(self) -> None:
        """Buttons that stop, land and arm."""
        gui = self.client.gui
        # Above the tabs: they must never be looked for.
        self._buttons = [
            SureButton(gui, _STOP_LABEL, _RED, "S", 1, lambda: self._send(land=False)),
            SureButton(gui, _LAND_LABEL, _ORANGE, "L", 2, lambda: self._send(land=True)),
        ]
        arm = gui.add_button(_ARM_LABEL, color="green", icon="lock-open", order=3, visible=False)
        # A hold that is lost among other inputs arms later, never sooner.
        arm.on_hold(lambda event: self._hold(), callback_hz=10.0)
        self._arm = arm
        self._was = None

    def _send(self, land: bool) -> None:
        """By the way that ``crazyarena estop`` takes; never waits for the page."""
        answers = stop_local(_SOURCE, land=land)
        good = [a for _, a in answers if a.startswith(LANDING if land else STOPPED)]
        told = "; ".join(shown_line(answer) for _, answer in answers) or "no flight answered"
        self._say("LAND" if land else "STOP", told, "green" if good else "red")

    def _hold(self) -> None:
        now = self._shown._clock.now()
        since, last = self._held
        if now - last > _GAP:
            since = now
        self._held = (since, now)
        if now - since >= _HOLD:
            self._held = (math.inf, now)
            self._shown.confirm()
            self._say("Armed", "the countdown begins", "green")

    def _say(self, title: str, text: str, colour: Any) -> None:
        self.client.add_notification(title, text, color=colour, auto_close_seconds=8.0)

    def update(self, control: bool, question: str, alarm: bool = False) -> None:
        """Buttons follow what the flight can."""
        if (control, question) != self._was:
            self._was = (control, question)
            for button in self._buttons:
                button.show(control)
            if self._arm is not None:
                self._arm.visible = bool(question)
        if alarm and not self._alarm and self._sounds.value:
            self._sound.content = _BEEP
        self._alarm = alarm
        if not alarm and self._sound.content:
            self._sound.content = ""


def _colours(rows: Any) -> Any:
    """(n, 3) colours of vehicles 0..255: their own, or by number."""
    own = np.nan_to_num(np.clip(rows, 0.0, 1.0) * 255).astype(np.uint8)
    return np.where(np.isfinite(rows).all(axis=1)[:, None], own, colours(len(rows)))


def _title(facts: dict[str, Any]) -> str:
    from html import escape

    level, phase = escape(str(facts.get("level", ""))), escape(str(facts.get("phase", "")))
    time = facts.get("time")
    when = f"{time:.1f} s" if isinstance(time, int | float) else ""
    why = escape(str(facts.get("why") or ""))
    return (
        f'<div style="padding:0.3em 1em"><b>{level}</b> {phase} {when}'
        f'<div style="font-size:0.85em">{why}</div></div>'
    )


def _beep() -> str:
    """A short tone as an element that plays itself."""
    rate, seconds = 8000, 0.6
    tone = [int(9000 * math.sin(2 * math.pi * 880 * k / rate)) for k in range(int(rate * seconds))]
    data = io.BytesIO()
    with wave.open(data, "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(struct.pack(f"<{len(tone)}h", *tone))
    coded = base64.b64encode(data.getvalue()).decode()
    return f'<audio autoplay src="data:audio/wav;base64,{coded}"></audio>'


_BEEP = _beep()
