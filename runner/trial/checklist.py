"""The pre-flight checklist of a trial: what of it can be looked at before each arming.

The same checks as of ``crazyarena preflight``, on the rig of the trial, simulated or real. What
needs a hand (the emergency stop tried, the vehicle tipped) is believed if it was tried lately,
and asked for only where there are people: not in simulation, nor on the bench.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.errors import BackendError, InputError
from crazyarena.levels import Level
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.preflight import Bodies, remember
from crazyarena.safety import preflight as pf
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.fence import Fence
from crazyarena.safety.rehearsal import Rehearsals
from crazyarena.types import Pose

_LOOK = 0.4  # s, over which the vehicle's estimate must be still, and bodies are counted
_PERIOD = 0.02  # s
# In the order of the checklist; {} is the vehicle's body.
_ALWAYS = (
    "world axes",
    "arena clear",
    "camera rate",
    "{} connected",
    "{} state",
    "{} battery",
    "{} estimator",
    "{} agrees with cameras",
    "{} controller",
    "{} heading",
    "{} at start",
)
_WITH_PEOPLE = ("disk", "e-stop tested", "{} is body {}")


def names(body: str) -> tuple[str, ...]:
    """Names of the lines that can be waived."""
    return tuple(name.format(body, body) for name in (*_ALWAYS, *_WITH_PEOPLE))


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
        landmarks: Mapping[str, Pose] | None = None,
    ) -> None:
        self._rig = rig
        self._level = level
        self._waive = tuple(dict.fromkeys(waive))
        check_waivers(self._waive, rig.body)
        self._uri = uri
        self._out = out
        self._say = say
        self._rehearsals = rehearsals
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
        machine: tuple[Callable[[pf.Preflight], list[pf.Line]], ...] = (
            pf.check_axes,
            pf.check_strangers,
            pf.check_cameras,
        )
        each: tuple[Callable[[pf.Preflight, pf.VehicleFacts], list[pf.Line]], ...] = (
            pf.check_connected,
            pf.check_state,
            pf.check_battery,
            pf.check_estimate,
            pf.check_controller,
        )
        if self._uri is not None:
            machine = (*machine, pf.check_disk, pf.check_estop)
            each = (*each, pf.check_body, pf.check_heading)
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
            vehicle_checks=(*each, pf.check_start),
            landmarks=self._landmarks,
        )
        if self._uri is not None:
            remember(checklist, self._rehearsals or Rehearsals(), {rig.body: self._uri})
        return checklist
