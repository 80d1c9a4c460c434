"""A trial with a vehicle on a link and a camera system; what ``crazyarena fly`` does."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from crazyarena.errors import InputError
from crazyarena.levels.schema import Level, Profile
from crazyarena.mocap.survey import read_track
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.rig.stops import StopOptions
from crazyarena.runner.trial.asking import ask_operator
from crazyarena.runner.trial.checklist import FlightChecklist
from crazyarena.runner.trial.injection import DEFAULT_PREFIX, Injection, ZenohOutlet
from crazyarena.runner.trial.phase import Grip, Phase
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.runner.trial.world import World
from crazyarena.safety.limits import Limits
from crazyarena.types import Pose
from crazyarena.viewer_process import View

OpenRig = Callable[[Level, Limits], Rig]

_BEFORE_OTHERS = -10  # niceness of a contestant in flight: browsers may draw on every processor


class Fly(DryRun):
    """As :class:`~crazyarena.runner.dry_run.DryRun`, on a rig that somebody else opens.

    Parameters
    ----------
    open_rig: connects; called once, before anything else happens.
    yes: do not ask the operator.
    surveyed: file of an earlier survey; None measures the track.
    publish: zenoh endpoints (``connect``, ``listen``) to tell of the track and of what the
        contestant is told; None keeps it in the recording alone.
    stops: what stops the flight besides the watchdog.
    waive: lines of the pre-flight checklist that must not ground the vehicle.
    uri: link of the vehicle, if there are people to try the emergency stop and tip it by hand.
    onboard: the poses are the vehicle's own estimate; what stands in the arena nobody sees.

    Raises
    ------
    InputError, DependencyMissing: an option is wrong or asks for what is not there.
    """

    def __init__(
        self,
        *arguments: Any,
        open_rig: OpenRig,
        yes: bool = False,
        surveyed: str | None = None,
        publish: dict[str, list[str]] | None = None,
        real_time: bool = True,
        stops: StopOptions | None = None,
        waive: Sequence[str] = (),
        uri: str | None = None,
        onboard: bool = False,
        **options: Any,
    ) -> None:
        options.setdefault("pace", 0.0)  # the clock's own
        super().__init__(*arguments, **options)
        if self._level.profile is not Profile.ARENA:
            raise InputError(
                f"level {self._level.name}: profile '{self._level.profile.value}' is a simulation "
                "of its own; only arena levels can be flown. Add --set profile=arena"
            )
        if self._options.sandbox is False:
            raise InputError("fly: a contestant never shares the process of a vehicle's link")
        if onboard and self._level.track.tracked:
            raise InputError(
                f"level {self._level.name}: gates that move have to be seen; --mocap onboard sees "
                "none"
            )
        if onboard and uri is not None and surveyed is None and self._level.track.gates:
            raise InputError(
                "--mocap onboard: no cameras measure the track; --survey FILE. crazyarena "
                "arena-check LEVEL --track FILE writes one to be corrected by hand"
            )
        if real_time:
            # Its answers are waited for; what is looked at or drawn meanwhile is not.
            limits = replace(self._options.limits, niceness=_BEFORE_OTHERS)
            self._options = replace(self._options, limits=limits)
        self._open_rig = open_rig
        self._yes = yes
        self._surveyed: dict[str, Pose] | None = None if surveyed is None else read_track(surveyed)
        self._publish = publish
        self._real_time = real_time
        self._waive = tuple(waive)
        self._uri = uri
        self._stop_options = stops or StopOptions()
        self._stop_options.check()
        self._asking: Crew | None = None

    def _make_world(self) -> World:
        return TrackedWorld(self._open_rig(self._level, self._limits()))

    def _crew(self, world: TrackedWorld) -> Crew:
        site = self.entry.site()
        self._preflight = FlightChecklist(
            world.rig,
            self._level,
            waive=self._waive,
            uri=self._uri,
            out=self.out,
            say=lambda text: self._tell(Phase.PREFLIGHT, text),
            vehicle=self.model,
            surveyed=self._surveyed,
            landmarks=None if site is None else site.landmarks,
        )
        crew = Crew(
            world.rig,
            world,
            self._level,
            confirm=lambda question: self._confirm(question, world),
            on_phase=self._tell,
            surveyed=self._surveyed,
            checks=(self._checked,),
            anywhere=True,  # that is a line of the checklist
            site=site,
        )
        self._asking = crew
        self._listen_for_stops(world, crew)
        return crew

    def _injection(self, stack: contextlib.ExitStack) -> Injection:
        if self._publish is None:
            return Injection()
        outlet = ZenohOutlet(DEFAULT_PREFIX, **self._publish)
        stack.callback(outlet.close)
        return Injection(outlet)

    _controlled = True

    def _opened_view(self) -> View | None:
        """Always there: people may want to look when the flight has begun already."""
        wanted = self._wanted_view
        if wanted is not None:
            return super()._opened_view()
        try:
            return View(None, self._print)
        except InputError as error:
            self._print(str(error))
            return None

    def _tell(self, phase: Phase, text: str) -> None:
        super()._tell(phase, text)
        line = phase.value if not text else f"{phase.value}: {text}"
        self._console.print(line, highlight=False, markup=False)

    def _confirm(self, question: str, world: TrackedWorld) -> bool:
        guard = world.rig.safeguard
        if guard is not None:
            guard.close_keys()  # they belong to the question now
        if not self._yes and not ask_operator(
            question,
            world.rig.clock,
            terminal=sys.stdin if sys.stdin.isatty() else None,
            show=self._show,
            page=self._view is not None and self._view.shown,
            say=lambda text: self._console.print(text, end="", markup=False, highlight=False),
            interrupted=lambda: self._asking is not None and self._asking.interrupted(),
        ):
            return False
        keys = self._stop_options.only_keyboard()
        if guard is not None and keys.keyboard:
            for note in guard.open_keys(keys):
                self._tell(Phase.ARM, note)
        return True

    def _listen_for_stops(self, world: TrackedWorld, crew: Crew) -> None:
        """Everything but the terminal's keys, which first have a question to answer."""
        guard = world.rig.safeguard
        if guard is None:
            return
        options = self._stop_options
        notes, hold = guard.open_stops(options.without_keyboard())
        for note in notes:
            self._tell(Phase.CONNECT, note)
        if options.dead_man is not None and hold is not None:
            crew.grip = Grip(hold, options.dead_man.hold, self._limits().dead_man)
