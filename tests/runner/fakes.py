"""A world that follows a prescribed path, and rows for the referee."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crazyarena.clock import VirtualClock
from crazyarena.sim_backend.trace import (
    NO_CONTACT,
    TR_ACTION,
    TR_CONTACT,
    TR_POS,
    TR_QUAT,
    TR_RPY,
    TR_TIME,
    TR_TUMBLED,
    TRACE_SIZE,
)

HOVER = 0.0846  # N per rotor


def rows(
    positions, first_tick: int = 1, contact: float = NO_CONTACT, action: float = HOVER, rate=500.0
) -> np.ndarray:
    """Trace rows of a level vehicle at (n, 3) positions; the first is after ``first_tick``."""
    positions = np.atleast_2d(np.asarray(positions, dtype=float))
    out = np.zeros((len(positions), TRACE_SIZE))
    out[:, TR_TIME] = np.arange(first_tick, first_tick + len(positions)) / rate
    out[:, TR_POS : TR_POS + 3] = positions
    out[:, TR_QUAT + 3] = 1.0
    out[:, TR_ACTION : TR_ACTION + 4] = action
    out[:, TR_CONTACT] = contact
    return out


class PathWorld:
    """A world whose vehicle is where ``path(t)`` says, whatever it is sent."""

    def __init__(self, path: Callable[[float], tuple[float, float, float]], rate=30.0) -> None:
        self.clock = VirtualClock()
        self.clock.on_advance(self._advance)
        self._path = path
        self._rate = rate
        self.sent: list[tuple[float, object]] = []
        self.resets = 0
        self.contact_at: set[int] = set()
        self.tumble_at: int | None = None

    def reset(self, draw) -> None:
        self._epoch = self.clock.now()
        self._tick = 0
        self._pending: list[np.ndarray] = []
        self.resets += 1

    def send(self, command) -> None:
        self.sent.append((self.clock.now() - self._epoch, command))

    def poll(self) -> np.ndarray:
        out = np.concatenate(self._pending) if self._pending else np.empty((0, TRACE_SIZE))
        self._pending = []
        return out

    def motor_forces(self) -> np.ndarray:
        return np.full(4, 0.09)

    def close(self) -> None:
        pass

    def _advance(self, now: float) -> None:
        last = int(np.ceil((now - self._epoch) * 500.0 - 1e-6))
        ticks = np.arange(self._tick + 1, last + 1)
        if not len(ticks):
            return
        out = rows([self._path(t / 500.0) for t in ticks], int(ticks[0]))
        out[:, TR_RPY + 2] = 0.1
        for i, tick in enumerate(ticks):
            if int(tick) in self.contact_at:
                out[i, TR_CONTACT] = 0.0
            if self.tumble_at is not None and tick >= self.tumble_at:
                out[i, TR_TUMBLED] = 1.0
        self._pending.append(out)
        self._tick = last


CONTROLLER = """
from enum import Enum

class Command(Enum):
    FINISHED = -1
    NONE = 0
    FULLSTATE = 1
    TAKEOFF = 2
    LAND = 3
    STOP = 4
    GOTO = 5
    NOTIFYSETPOINTSTOP = 6

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.calls = []
        {init}

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        self.calls.append((time, list(obs), reward, done, info))
        {step}
"""


def controller(step: str = "return Command.NONE, []", init: str = "pass", extra: str = "") -> str:
    """Source of a submission in the style of the dev-sim2real folders."""
    return CONTROLLER.format(init=init, step=step) + extra
