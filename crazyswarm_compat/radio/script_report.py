"""What a script hears of its vehicles over the radio, which itself raises nothing and waits for
nobody: warnings, and the end of the flight when a vehicle is gone."""

from __future__ import annotations

import math
import os
import queue
import sys
from collections.abc import Mapping

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.radio.events import (
    CommandDoubtful,
    CommandLost,
    CommandRefused,
    EventLog,
    LinkEvent,
    LinkLost,
    LinkUp,
    StreamEnded,
    VehicleRestarted,
)
from crazyarena.crazyswarm_compat.radio.link import VehicleLink
from crazyarena.crazyswarm_compat.radio.telemetry import SupervisorState

# Error numbers of high-level commands.
_REFUSALS = {
    2: "it has no such trajectory",
    7: "that does not fit into its memory",
    8: "its firmware cannot execute it (trajectory ids go from 0 to 30)",
    12: "its memory is full",
    16: "it may not fly now",
}
_FLIGHT_VERBS = frozenset({"takeoff", "land", "goTo", "startTrajectory"})
_DUMB = 3.0  # s without a log packet on a link that answers
_LOW = 0.15  # m
_FRESH = 1.0  # s; the word that it flies no more may come some packets before the reason
_KNOWN_BY = 4.0  # s after which it is known whether a vehicle that is back was restarted


class _Vehicle:
    """What is remembered of one vehicle between looks."""

    def __init__(self, link: VehicleLink) -> None:
        self.link = link
        self.lost_at: float | None = None
        self.flew = False  # when it was lost or fell silent, or is meant to fly since
        self.flown_at = -math.inf  # when it was last seen to fly
        self.up_at = -math.inf  # since when it has been in reach
        self.back_at: float | None = None  # likewise, where it was lost in flight
        self.restarted = False  # in flight
        self.dumb = False
        self.ended = False


class ScriptReport:
    """Warns the script's thread of what happened, and ends the flight of what is gone.

    Parameters
    ----------
    links: the vehicles.
    events: what their links tell.
    patience: s for which a vehicle that flew may be out of reach.
    guarded: somebody else decides about the end of the flight.
    """

    def __init__(
        self,
        links: Mapping[int, VehicleLink],
        events: EventLog,
        clock: Clock,
        patience: float,
        guarded: bool = False,
    ) -> None:
        self._vehicles = {ident: _Vehicle(link) for ident, link in links.items()}
        self._clock = clock
        self._patience = patience
        self._guarded = guarded
        self._queue: queue.SimpleQueue[LinkEvent] = queue.SimpleQueue()
        self._unsubscribe = events.subscribe(self._queue.put)

    def check(self) -> None:
        """Warn of what has happened since the last look.

        Raises
        ------
        FlightEnded
            once for each vehicle that flew and is gone: out of reach for longer than
            ``patience``, locked, crashed, or restarted.
        """
        while True:
            try:
                self._tell(self._queue.get_nowait())
            except queue.Empty:
                break
        now = self._clock.now()
        for vehicle in self._vehicles.values():
            why = None if vehicle.ended else self._gone(vehicle, now)
            if why is not None:
                vehicle.ended = True
                message = f"{vehicle.link.name}: {why}"
                if self._guarded:
                    warn(message, stacklevel=5)
                else:
                    raise FlightEnded(message)

    def finish(self) -> bool:
        """Look for the last time; False if a vehicle that flew is gone."""
        good = True
        for _ in self._vehicles:
            try:
                self.check()
            except FlightEnded as ended:
                print(f"error: {ended}", file=sys.stderr)
        for vehicle in self._vehicles.values():
            if vehicle.lost_at is not None and vehicle.flew and not vehicle.ended:
                print(
                    f"error: {vehicle.link.name}: out of reach when the script ended, and in the "
                    "air when it was last heard",
                    file=sys.stderr,
                )
                good = False
            good = good and not vehicle.ended
        self._unsubscribe()
        return good or self._guarded

    def exit(self) -> None:
        """For the end of the interpreter, after everything else: a lost vehicle is a failure of
        the script, whatever it returned itself."""
        if not self.finish():
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(1)

    # One event

    def _tell(self, event: LinkEvent) -> None:
        vehicle = self._vehicles[event.vehicle]
        name = vehicle.link.name
        match event:
            case LinkLost():
                vehicle.lost_at = event.time
                vehicle.flew = vehicle.flew or _flies(vehicle.link)
                state = "in the air" if vehicle.flew else "on the ground"
                warn(f"{name}: link lost ({event.reason}), {state} when last heard", stacklevel=6)
            case LinkUp():
                if vehicle.lost_at is not None:
                    warn(f"{name}: link is back after {event.outage:.1f} s", stacklevel=6)
                vehicle.up_at = event.time
                vehicle.back_at = event.time if vehicle.flew else None
                # That it flew stays: what it tells first may be the lock that ended the flight.
                vehicle.lost_at = None
            case VehicleRestarted():
                # What it was doing before it was lost, it was doing when it was restarted.
                back, vehicle.back_at = vehicle.back_at, None
                recent = back is not None and event.time - back < _KNOWN_BY
                vehicle.restarted = vehicle.flew or recent
                if not vehicle.restarted:
                    warn(
                        f"{name}: was restarted: its parameters are those that it boots with, "
                        "what was uploaded is gone",
                        stacklevel=6,
                    )
            case CommandLost():
                if event.verb in _FLIGHT_VERBS and vehicle.lost_at is not None:
                    vehicle.flew = True
                warn(f"{name}: {event.verb}: did not happen; {event.reason}", stacklevel=6)
            case CommandRefused():
                reason = _REFUSALS.get(event.code, f"error {event.code}")
                if event.code == 16:
                    reason += _state_of(vehicle.link)
                warn(f"{name}: {event.verb}: refused by the vehicle; {reason}", stacklevel=6)
            case CommandDoubtful():
                warn(f"{name}: {event.verb}: {event.reason}", stacklevel=6)
            case StreamEnded(action=action) if action != "idle":
                doing = "landed" if action == "land" else "held in place"
                warn(
                    f"{name}: no setpoint and no other command came after its last setpoint; the "
                    f"vehicle is {doing} (a Crazyflie left alone levels out after 0.5 s and stops "
                    "its motors after 2 s)",
                    stacklevel=6,
                )
            case _:
                pass

    # Between events

    def _gone(self, vehicle: _Vehicle, now: float) -> str | None:
        link = vehicle.link
        if vehicle.restarted:
            return "was restarted in flight"
        if vehicle.lost_at is not None:
            out = now - vehicle.lost_at
            if vehicle.flew and out > self._patience:
                return f"out of reach for {out:.1f} s while it flew; its flight is over"
            return None
        telemetry = link.telemetry.latest
        if telemetry.supervisor is None:
            return None
        state = SupervisorState.from_bits(telemetry.supervisor)
        flew = vehicle.flew or now - vehicle.flown_at < _FRESH
        vehicle.flew = _flies(link)
        if vehicle.flew:
            vehicle.flown_at = now
        # What the script has asked for is not news.
        if (flew or state.crashed) and state.locked and not link.outbox.locked:
            return (
                "has locked itself in flight, after a fall, silence of its setpoints or an "
                "emergency stop from elsewhere; switch it off and on"
            )
        if flew and (state.crashed or state.tumbled):
            return "has crashed or lies on its back"
        if link.connected and now - max(telemetry.timestamp, vehicle.up_at) > _DUMB:
            if not vehicle.dumb:
                vehicle.dumb = True
                if _flies(link):
                    return "answers, but tells nothing any more; was it restarted in flight?"
                warn(
                    f"{link.name}: answers, but tells nothing any more; was it restarted?",
                    stacklevel=5,
                )
        else:
            vehicle.dumb = False
        return None


def _flies(link: VehicleLink) -> bool:
    telemetry = link.telemetry.latest
    if telemetry.supervisor is None:
        return False
    state = SupervisorState.from_bits(telemetry.supervisor)
    # The firmware keeps the bit for 2 s after touchdown.
    high = telemetry.state is None or bool(telemetry.state.position[2] > _LOW)
    return state.flying and (high or state.high_level_active)


def _state_of(link: VehicleLink) -> str:
    bits = link.telemetry.latest.supervisor
    if bits is None:
        return ""
    state = SupervisorState.from_bits(bits)
    names = {
        "locked after an emergency stop": state.locked,
        "tumbled": state.tumbled,
        "crashed": state.crashed,
        "not armed": not state.armed,
    }
    found = ", ".join(name for name, holds in names.items() if holds)
    return f": it is {found}" if found else ""
