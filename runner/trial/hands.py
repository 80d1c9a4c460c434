"""What phases are made of: waiting for a condition, sending, and the shortest way down."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import BackendError, CommandError, CrazyarenaError
from crazyarena.mocap.estimator import BodyEstimate
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.phase import Aborted, OnPhase, Phase
from crazyarena.sim_backend.firmware.supervisor import INFO_CRASHED, INFO_LOCKED, INFO_TUMBLED

TICK = 0.02  # s, between looks at a condition
DOWN = 0.08  # m: what is lower stands on the ground
STILL = 0.1  # m/s
_DESCENT = 0.3  # m/s


class Hands:
    """Holds one vehicle of a rig. Whatever goes wrong in a phase ends on the way down.

    ``interrupted()`` is asked in every phase before the run; True aborts it. ``durations``: s by
    phase.
    """

    def __init__(self, rig: Rig, on_phase: OnPhase) -> None:
        self._rig = rig
        self._on_phase = on_phase
        self._may_stop = False
        self.interrupted: Callable[[], bool] = lambda: False
        self.durations: dict[str, float] = {}

    def abort(self) -> None:
        """Down, by the shortest way: land where it is; cut the motors if that does not work."""
        self._may_stop = False
        self._come_down()
        self._send_quietly(cs.Arm(False))

    def _come_down(self) -> None:
        """By the watchdog if it has the vehicle, else where it is; motors off if that fails."""
        guard = self._rig.safeguard
        if guard is not None and self._taken():
            guard.end()
            return
        try:
            self._land_here()
        except CrazyarenaError:
            self._send_quietly(cs.Emergency())

    def _taken(self) -> bool:
        """The watchdog has the vehicle."""
        guard = self._rig.safeguard
        return guard is not None and guard.verdict() is not None

    def _flyable(self) -> bool:
        info = self._supervisor()
        return info & (INFO_TUMBLED | INFO_CRASHED | INFO_LOCKED) == 0

    def _land_here(self) -> None:
        height = self._height()
        if height > DOWN:
            self._send(cs.NotifySetpointsStop())
            duration = max(1.5, height / _DESCENT)
            self._send(cs.Land(0.0, duration))
            self._until(
                lambda: self._height() <= DOWN and self._still(),
                duration + 5.0,
                Phase.RETURN,
                lambda: f"the vehicle is still {self._height():.2f} m high",
            )
        self._send(cs.Stop())

    @contextmanager
    def _phase(self, phase: Phase, land_on_failure: bool = True) -> Iterator[None]:
        begin = self._rig.clock.now()
        self._on_phase(phase, "")
        # Nobody wants to interrupt a landing.
        self._may_stop = land_on_failure
        try:
            yield
        except (BackendError, CommandError) as error:
            if land_on_failure:
                self.abort()
            raise Aborted(phase, str(error)) from error
        except BaseException:
            if land_on_failure:
                self.abort()
            raise
        finally:
            self.durations[phase.value] = self._rig.clock.now() - begin

    def _until(
        self,
        condition: Callable[[], bool],
        timeout: float,
        phase: Phase,
        complaint: Callable[[], str],
    ) -> None:
        clock = self._rig.clock
        end = clock.now() + timeout
        while not condition():
            self._look_for_interrupt(phase)
            if clock.now() >= end:
                raise Aborted(phase, f"{complaint()} (waited {timeout:g} s)")
            clock.sleep_until(clock.now() + TICK)

    def _look_for_interrupt(self, phase: Phase) -> None:
        lost = self._rig.lost()
        if lost is not None:
            raise BackendError(lost)
        if self._may_stop and self.interrupted():
            raise Aborted(phase, "interrupted by the operator")

    def _estimate(self) -> BodyEstimate:
        return self._rig.pipeline.estimate(self._rig.body)

    def _height(self) -> float:
        return float(self._estimate().state.position[2])

    def _still(self) -> bool:
        return float(np.linalg.norm(self._estimate().state.velocity)) < STILL

    def _supervisor(self) -> int:
        return self._rig.backend.telemetry(self._rig.vehicle).supervisor or 0

    def _send(self, command: cs.Command) -> None:
        self._rig.backend.send(command, self._rig.vehicle)

    def _send_quietly(self, command: cs.Command) -> None:
        """For the way down, on which a refused command must not stop the next."""
        try:
            self._send(command)
        except (BackendError, CommandError) as error:
            self._on_phase(Phase.RETURN, f"{type(command).__name__} refused: {error}")
