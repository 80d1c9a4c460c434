"""What enters a trial: a submission and a level, recognised by their files, under one contract.

:func:`enter` tells a controller of lsy_drone_racing from a submission of 2022. Both come as the
same kind of object, from which dry run, bench and flight take what differs: the level of the
arena, the contestant, where the track is to stand, what the vehicle must be told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw import Draw
from crazyarena.levels.lsy import is_lsy_level
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.dialogue import Contestant
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.submission import Submission, entry_file
from crazyarena.runner.judging.result import TrialResult
from crazyarena.runner.records.outcome_table import remarks, score_line
from crazyarena.runner.records.report import provenance
from crazyarena.runner.trial.contract import Contract, Contract2022
from crazyarena.runner.trial.options import FlightOptions

if TYPE_CHECKING:
    from crazyarena.runner.records.ground import Ground
    from crazyarena.runner.trial.site import Site
    from crazyarena.safety.limits import Limits
    from crazyarena.sim_backend.arena_world import AnyTrack


_TILT = 0.9  # rad, up to which contestants may lean that fly by attitude


class Entry(Protocol):
    """See the module's text.

    Attributes
    ----------
    path: of the submission. level: as what rigs are put together from.
    track: builds the simulated track of a draw; None for that of 2022.
    params: firmware parameters that the vehicle must be told, by name.
    arena: what another process needs to build the same track, as plain data; None for the level
        itself.
    """

    path: Path
    level: Level

    def settle(self, level: Level) -> None:
        """The level with the numbers of the vehicle that flies."""
        ...

    def check(self, options: FlightOptions) -> None:
        """Raise InputError for options that this contract does not know."""
        ...

    @property
    def contract(self) -> Contract: ...

    @property
    def track(self) -> Callable[[Draw], AnyTrack] | None: ...

    @property
    def params(self) -> Mapping[str, float]: ...

    @property
    def arena(self) -> dict[str, Any] | None: ...

    def site(self) -> Site | None:
        """Where the track is to stand; None for what the level says."""
        ...

    def limits(self, limits: Limits) -> Limits:
        """Limits of the guard, with what this contract's commands need."""
        ...

    def contestant(self, options: FlightOptions, work: Path, sandboxed: bool) -> Contestant:
        """Load it; raises InputError if that fails."""
        ...

    def provenance(self, seed: int, digest: str) -> dict[str, Any]: ...

    def told(self, result: TrialResult, seed: int | str) -> list[str]:
        """What there is to say of the result, in lines."""
        ...

    def ground(self, gates: np.ndarray, obstacles: np.ndarray) -> Ground:
        """What figures draw a flight over, where gates (n, 7) and obstacles (m, 6) stand."""
        ...


class Entry2022:
    """A submission to the 2022 competition."""

    track = None
    params: Mapping[str, float] = {}
    arena = None

    def __init__(self, submission: Path, level: str | Level, overrides: Sequence[str]) -> None:
        self.level = load_level(level, overrides) if isinstance(level, str) else level
        entry_file(submission.expanduser())  # a wrong path must not leave a results folder behind
        self.path = submission.expanduser().resolve()

    def settle(self, level: Level) -> None:
        self.level = level

    def check(self, options: FlightOptions) -> None:
        return

    @property
    def contract(self) -> Contract2022:
        return Contract2022(self.level)

    def site(self) -> None:
        return None

    def limits(self, limits: Limits) -> Limits:
        return limits

    def contestant(self, options: FlightOptions, work: Path, sandboxed: bool) -> Contestant:
        if sandboxed:
            from crazyarena.runner.contestant.sandbox.process import Sandboxed

            return Sandboxed(
                self.path,
                options.limits,
                require=options.require_sandbox,
                parameters=options.parameters,
            )
        return InProcess(Submission(self.path, work))

    def provenance(self, seed: int, digest: str) -> dict[str, Any]:
        return provenance(self.level, seed, self.path, digest)

    def told(self, result: TrialResult, seed: int | str) -> list[str]:
        return [score_line(result), *remarks(result, self.level, seed)]

    def ground(self, gates: np.ndarray, obstacles: np.ndarray) -> Ground:
        from crazyarena.runner.records.ground import ground_of

        return ground_of(self.level, gates, obstacles)


class EntryLsy:
    """A controller of lsy_drone_racing in an arena."""

    def __init__(self, submission: Path, level: str, overrides: Sequence[str]) -> None:
        from crazyarena.levels.lsy import load_lsy_level
        from crazyarena.levels.lsy.arena import arena_level
        from crazyarena.levels.lsy.draw import fresh_seed
        from crazyarena.runner.contestant.contract_lsy.submission import controller_file

        self.path = controller_file(submission, level)
        self.lsy = load_lsy_level(level, overrides)
        self._source = (str(level), list(overrides))
        seed = self.lsy.env.seed
        self.level = arena_level(self.lsy, fresh_seed() if seed < 0 else seed)

    def settle(self, level: Level) -> None:
        self.level = level

    def check(self, options: FlightOptions) -> None:
        from crazyarena.levels.lsy.draw import refuse_short_keys

        if options.secret:
            refuse_short_keys(self.lsy)

    @property
    def attitude(self) -> bool:
        """Whether its commands are attitudes."""
        return self.lsy.env.control_mode == "attitude"

    @property
    def contract(self) -> Contract:
        from crazyarena.runner.trial.contract_lsy import ContractLsy

        return ContractLsy(self.lsy, self.level)

    @property
    def track(self) -> Callable[[Draw], AnyTrack]:
        from crazyarena.sim_backend.lsy_track import LsyTrack

        return LsyTrack

    @property
    def params(self) -> Mapping[str, float]:
        return {"flightmode.stabModeYaw": 1.0} if self.attitude else {}

    @property
    def arena(self) -> dict[str, Any]:
        return {"name": self._source[0], "overrides": self._source[1]}

    def site(self) -> Site:
        from crazyarena.runner.trial.site import LsySite

        return LsySite(self.lsy)

    def limits(self, limits: Limits) -> Limits:
        if not self.attitude:
            return limits
        from crazyarena.sim_backend.successor_models import GRAVITY, model

        chosen = model(self.lsy.sim.drone_model)
        weight = GRAVITY * self.level.vehicle.mass
        return replace(
            limits,
            allow_attitude=True,
            setpoint_tilt=_TILT,
            thrust_to_weight=4.0 * chosen.thrust_max / weight,
        )

    def contestant(self, options: FlightOptions, work: Path, sandboxed: bool) -> Contestant:
        from crazyarena.runner.contestant.lsy_player import (
            LsyPlayer,
            Seat,
            ThrustScale,
            Translate,
            attitude,
            full_state,
        )
        from crazyarena.sim_backend.successor_models import model

        chosen = model(self.lsy.sim.drone_model)
        translate: Translate = full_state
        if self.attitude:
            translate = attitude(
                ThrustScale(4.0 * chosen.thrust_max, chosen.pwm_min, chosen.pwm_max)
            )
        seat: Seat
        config = self.lsy.config
        if sandboxed:
            from crazyarena.runner.contestant.sandbox.lsy import LsySandboxed

            seat = LsySandboxed(
                self.path,
                self.lsy.sim.drone_model,
                options.limits,
                require=options.require_sandbox,
            )
        else:
            from crazyarena.runner.contestant.contract_lsy.pilot import LsyInProcess
            from crazyarena.runner.contestant.contract_lsy.submission import LsySubmission

            seat = LsyInProcess(LsySubmission(self.path, work, self.lsy.sim.drone_model))
        return LsyPlayer(seat, config, translate)

    def provenance(self, seed: int, digest: str) -> dict[str, Any]:
        origin = provenance(self.level, seed, self.path, digest)
        return {
            **origin,
            "contract": "lsy_drone_racing",
            "level": self.lsy.name,
            "lsy_level": self.lsy.config,
            "rng": self.lsy.rng.value,
        }

    def told(self, result: TrialResult, seed: int | str) -> list[str]:
        done = [e for e in result.episodes if e.completed]
        line = f"{len(done)} of {result.requested} passed all gates"
        if done:
            line += f", mean time {sum(e.flight_time for e in done) / len(done):.2f} s"
        notes = [
            f"episode {e.index}: {event.detail}"
            for e in result.episodes
            for event in e.events
            if event.name == "note"
        ]
        slow = [e for e in result.episodes if e.missed_ticks]
        if slow:
            missed = sum(e.missed_ticks for e in slow)
            notes.append(
                f"Thinking takes time here: {missed} ticks passed without a command. --compute "
                "free flies as if it did not"
            )
        return [f"{line} (seed {seed})", *notes]

    def ground(self, gates: np.ndarray, obstacles: np.ndarray) -> Ground:
        from crazyarena.levels.lsy.arena import quaternions_of
        from crazyarena.runner.records.ground import lsy_ground

        true, track = quaternions_of(gates), self.lsy.env.track
        # Of a layout that is drawn as a whole no other place is known.
        rows = np.array([[*gate.pos, *gate.rpy] for gate in track.gates], float).reshape(-1, 6)
        told = true if track.randomize else quaternions_of(rows)
        return lsy_ground(self.lsy, true, told, obstacles)


def is_lsy(submission: Path | None, level: str | None) -> bool:
    """Whether this is a controller, or a level, of lsy_drone_racing.

    Raises
    ------
    InputError: a controller with a level of another kind.
    """
    if level is not None and is_lsy_level(level):
        return True
    if submission is None:
        return False
    from crazyarena.runner.contestant.contract_lsy.submission import find_controller

    file = find_controller(submission.expanduser())
    if file is not None and level is not None:
        raise InputError(
            f"{file}: a controller of lsy_drone_racing; level {level} is none of its levels. "
            "Pass --level lsy/level0 ... lsy/level3, or a TOML file"
        )
    return file is not None


def default_level(
    submission: Path | None, otherwise: str = "level0", lsy: str = "lsy/level0"
) -> str:
    """The level that a submission is flown on if none is named."""
    return lsy if is_lsy(submission, None) else otherwise


def enter(submission: Path, level: str | Level, overrides: Sequence[str] = ()) -> Entry:
    """The entry that a submission is, on a level or a loaded one of 2022.

    Raises
    ------
    InputError: the level or the submission is at fault, or they do not go together.
    """
    if isinstance(level, str) and is_lsy(submission, level):
        return EntryLsy(submission, level, overrides)
    return Entry2022(submission, level, overrides)
