"""The checklist where only the vehicle itself knows where it is.

What cameras would have shown is listed as not checked: whoever flies without them has chosen so,
and must see what that means. What the vehicle can tell of itself is asked of it all the more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from crazyarena.crazyswarm_compat.positioning import Positioning
from crazyarena.safety import preflight as pf
from crazyarena.safety.own_estimate import OwnEstimate
from crazyarena.safety.preflight import Line, Preflight, VehicleFacts

# m by which a place that is counted, and not seen, may wander while it stands.
_RELATIVE_SPREAD = 0.05

MachineChecks = tuple[Callable[[Preflight], list[Line]], ...]
VehicleChecks = tuple[Callable[[Preflight, VehicleFacts], list[Line]], ...]


@dataclass(frozen=True, slots=True)
class Onboard:
    """Checks of vehicles that are known by their own estimates, by name."""

    own: Mapping[str, OwnEstimate]

    def _decks(self, v: VehicleFacts) -> Positioning:
        return self.own[v.name].decks

    @property
    def machine_checks(self) -> MachineChecks:
        """Instead of those of world axes, strangers and cameras."""
        return (self._axes, self._arena, self._rate)

    @property
    def vehicle_checks(self) -> VehicleChecks:
        """Instead of those of its estimate and place, its body and heading."""
        return (self._deck, self._estimate, self._body, self._heading, self._start)

    def all_checks(self) -> tuple[MachineChecks, VehicleChecks]:
        """Those of a checklist before any flight."""
        cameras = (pf.check_axes, pf.check_strangers, pf.check_cameras, pf.check_gates)
        seen = (pf.check_estimate, pf.check_body, pf.check_heading, pf.check_start)
        machine = tuple(check for check in pf.MACHINE_CHECKS if check not in cameras)
        each = tuple(check for check in pf.VEHICLE_CHECKS if check not in seen)
        gates = (self._gates, *self.machine_checks)
        return (*machine, *gates), (*each, *self.vehicle_checks)

    def _gates(self, p: Preflight) -> list[Line]:
        if not p.level.track.gates:
            return []
        return [_unchecked("gates", "fly them from a file measured by hand, --survey")]

    def _axes(self, p: Preflight) -> list[Line]:
        return [_unchecked("world axes", "those of the decks' own world; see where it starts")]

    def _arena(self, p: Preflight) -> list[Line]:
        return [_unchecked("arena clear", "nothing sees who or what is in there: look yourself")]

    def _rate(self, p: Preflight) -> list[Line]:
        return [replace(line, found=f"{line.found}, its own") for line in pf.check_cameras(p)]

    def _deck(self, p: Preflight, v: VehicleFacts) -> list[Line]:
        remedy = "fit a lighthouse, LPS or flow deck, and restart it"
        return [Line(f"{v.name} deck", bool(self._decks(v).decks), str(self._decks(v)), remedy)]

    def _estimate(self, p: Preflight, v: VehicleFacts) -> list[Line]:
        own = p
        if self._decks(v).relative:
            own = replace(p, tolerances=replace(p.tolerances, spread=_RELATIVE_SPREAD))
        lines = [line for line in pf.check_estimate(own, v) if not line.name.endswith("cameras")]
        t = v.telemetry
        found = "unknown" if t is None or t.position_std is None else f"{t.position_std:.2f} m"
        if t is not None and self._decks(v).relative and t.velocity_std is not None:
            found = f"{t.velocity_std:.2f} m/s; the place itself drifts"
        doubt = "unknown" if t is None else self.own[v.name].certainty.doubt(t)
        sight = "check that the base stations are in sight, or the floor has a pattern"
        return [
            *lines,
            Line(f"{v.name} certain", doubt is None, doubt or found, sight),
            _unchecked(f"{v.name} agrees with cameras", "there are none"),
        ]

    def _body(self, p: Preflight, v: VehicleFacts) -> list[Line]:
        return [Line(f"{v.name} is body {v.body}", True, "its estimate comes over its own link")]

    def _heading(self, p: Preflight, v: VehicleFacts) -> list[Line]:
        degrees = math.degrees(p.level.start.attitude[2])
        text = f"it must stand with its nose at {degrees:g} deg; nothing shows if it does not"
        return [_unchecked(f"{v.name} heading", text)]

    def _start(self, p: Preflight, v: VehicleFacts) -> list[Line]:
        if self._decks(v).relative:
            text = "its place is counted from the start: put it there"
            return [_unchecked(f"{v.name} at start", text)]
        return [
            replace(line, remedy=line.remedy.replace("the cameras see it", "its estimate says"))
            for line in pf.check_start(p, v)
        ]


def _unchecked(name: str, why: str) -> Line:
    return Line(name, True, f"not checked: {why}", checked=False)
