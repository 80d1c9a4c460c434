"""The pre-flight checklist of a trial: what of it can be looked at before each arming.

The same checks as of ``crazyarena preflight``, on the rig of the trial, simulated or real. What
needs a hand (the emergency stop tried, the vehicle tipped) is believed if it was tried lately,
and asked for only where there are people: not in simulation, nor on the bench.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.errors import BackendError, InputError
from crazyarena.levels import Level
from crazyarena.runner.rig.flight_model import foretold, known
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.preflight import Bodies, remember
from crazyarena.safety import preflight as pf
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.fence import Fence
from crazyarena.safety.preflight_onboard import MachineChecks, Onboard, VehicleChecks
from crazyarena.safety.preflight_track import NAME, gates_free
from crazyarena.safety.rehearsal import Rehearsals
from crazyarena.sim_backend.vehicles import Vehicle
from crazyarena.types import Pose

_LOOK = 0.4  # s, over which the vehicle's estimate must be still, and bodies are counted
_PERIOD = 0.02  # s
# In the order of the checklist; {} is the vehicle's body.
_ALWAYS = (
    "world axes",
    "arena clear",
    "camera rate",
    NAME,
    "{} connected",
    "{} state",
    "{} battery",
    "{} estimator",
    "{} agrees with cameras",
    "{} controller",
    "{} heading",
    "{} at start",
)
_ONBOARD = ("{} deck", "{} certain", "{} heading")  # where there are no cameras
_WITH_PEOPLE = ("disk", "e-stop tested", "{} is body {}", "{} model")


def names(body: str) -> tuple[str, ...]:
    """Names of the lines that can be waived."""
    all_of_them = dict.fromkeys((*_ALWAYS, *_ONBOARD, *_WITH_PEOPLE))
    return tuple(name.format(body, body) for name in all_of_them)


def check_waivers(waive: Iterable[str], body: str) -> None:
    """Raise InputError for a waiver of a line that there is not."""
    unknown = [name for name in waive if name not in names(body)]
    if unknown:
        raise InputError(
            f"--waive {unknown[0]!r}: no such line of the checklist; there are "
            f"{', '.join(names(body))}"
        )


class FlightChecklist:
    """A pre-flight check of a :class:`~crazyarena.runner.trial.phases.Crew`.

    Parameters
    ----------
    waive: names of lines that must not ground the vehicle.
    uri: link of the vehicle if people are there to try what needs a hand; None if not.
    out: folder recordings go to.
    landmarks: bodies whose nominal places tell the cameras' axes; the level's own by default.
    say: told of each line that is waived.
    vehicle: model of the vehicle, looked at where there are people; elsewhere it is what flies.
    surveyed: poses of the track from an earlier survey.

    Raises
    ------
    InputError: a waiver of a line that there is not.
    """

    def __init__(
        self,
        rig: Rig,
        level: Level,
        *,
        waive: Iterable[str] = (),
        uri: str | None = None,
        out: Path = Path("."),
        say: Callable[[str], None] = lambda text: None,
        rehearsals: Rehearsals | None = None,
        vehicle: Vehicle | None = None,
        surveyed: Mapping[str, Pose] | None = None,
        landmarks: Mapping[str, Pose] | None = None,
    ) -> None:
        self._vehicle = vehicle
        self._rig = rig
        self._level = level
        self._waive = tuple(dict.fromkeys(waive))
        check_waivers(self._waive, rig.body)
        self._uri = uri
        self._out = out
        self._say = say
        self._rehearsals = rehearsals
        self._surveyed = surveyed
        self._landmarks = landmarks
        self._runs: list[list[pf.Line]] = []

    def __call__(self) -> list[str]:
        """What keeps the vehicle on the ground, in plain words."""
        checklist = self._gather()
        # The same call is flown where there is nobody, and then fewer lines are asked for.
        asked = {line.name for line in checklist.run()}
        lines = checklist.run(name for name in self._waive if name in asked)
        self._runs.append(lines)
        for line in lines:
            if line.waived:
                self._say(f"waived: {line.name} ({line.found})")
        grounding = [line for line in lines if line.grounds]
        problems = [f"{line.name}: {line.found} ({line.remedy})" for line in grounding]
        if problems:
            problems[-1] += f". To fly in spite of it: --waive {grounding[-1].name!r}"
        return problems

    @property
    def lines(self) -> list[pf.Line]:
        """Of the last look."""
        return list(self._runs[-1]) if self._runs else []

    def record(self) -> dict[str, Any]:
        """For ``result.json``: what was waived, and the lines before each arming."""
        waived = [line.name for lines in self._runs for line in lines if line.waived]
        return {
            "waived": list(dict.fromkeys(waived)),
            "checks": [[asdict(line) for line in lines] for lines in self._runs],
        }

    def _look(self) -> tuple[Bodies, list[np.ndarray]]:
        """Bodies that the cameras see, and the vehicle's own positions, for a moment."""
        rig, clock = self._rig, self._rig.clock
        bodies, own = Bodies(clock), []
        rig.listeners.frames.append(bodies.note)
        try:
            end = clock.now() + _LOOK
            while clock.now() < end:
                clock.sleep_until(clock.now() + _PERIOD)
                state = rig.backend.telemetry(rig.vehicle).state
                if state is not None:
                    own.append(state.position)
        finally:
            rig.listeners.frames.remove(bodies.note)
        return bodies, own

    def _checks(self) -> tuple[MachineChecks, VehicleChecks]:
        by_hand = self._uri is not None
        surveyed = self._surveyed or self._rig.taped()
        machine: MachineChecks = (partial(gates_free, measured=surveyed),)
        if by_hand:
            machine = (*machine, pf.check_disk, pf.check_estop)
        onboard = self._rig.onboard
        healthy: VehicleChecks = (pf.check_connected, pf.check_state, pf.check_battery)
        if by_hand:
            healthy = (*healthy, pf.check_model)
        if onboard is not None:
            own = Onboard({self._rig.body: onboard})
            return (
                (*own.machine_checks, *machine),
                (*healthy, *own.vehicle_checks, pf.check_controller),
            )
        seen: MachineChecks = (pf.check_axes, pf.check_strangers, pf.check_cameras)
        tipped: VehicleChecks = (pf.check_body, pf.check_heading) if by_hand else ()
        each = (*healthy, pf.check_estimate, pf.check_controller, *tipped, pf.check_start)
        return (*seen, *machine), each

    def _gather(self) -> pf.Preflight:
        rig, clock = self._rig, self._rig.clock
        bodies, own = self._look()
        controller = None
        with contextlib.suppress(BackendError):
            controller = int(rig.backend.get_param(rig.vehicle, "stabilizer.controller"))
        fact = pf.VehicleFacts(
            rig.body,
            rig.body,
            rig.backend.telemetry(rig.vehicle),
            rig.pipeline.estimate(rig.body),
            own,
            controller,
        )
        machine, each = self._checks()
        if self._uri is not None and self._vehicle is not None:
            fact.model = foretold(
                self._vehicle,
                known(controller or 0),
                lambda name: rig.backend.get_param(rig.vehicle, name),
            )
        checklist = pf.Preflight(
            self._level,
            [fact],
            poses=bodies.now(),
            bodies=sorted(bodies.now()),
            camera_rate=bodies.frames.rate,
            known=bodies.known(Fence.from_level(self._level)),
            estop=EmergencyStop([], clock),
            out=self._out,
            clock=clock,
            machine_checks=machine,
            vehicle_checks=each,
            landmarks=self._landmarks,
        )
        if self._uri is not None:
            remember(checklist, self._rehearsals or Rehearsals(), {rig.body: self._uri})
        return checklist
