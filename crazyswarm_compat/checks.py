"""What no vehicle could execute is refused before it is sent, by every backend alike.

:func:`check` is called by the Crazyswarm faces and by backends that are driven directly; the
message names the vehicle, the verb and the argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError

PIECE_COLUMNS = 33  # duration, then 8 coefficients each for x, y, z, yaw
LIMIT = 1e5  # m, s, rad, m/s ...: beyond any vehicle, and what firmware is asked to take
SIMULATED_PIECES = 256  # simulations take more, with a warning
MEMORY_PIECES = 31  # 4096 bytes of trajectory memory, 132 bytes a piece


class UnknownTrajectory(CommandError, KeyError):
    """A trajectory id was started that had not been uploaded."""

    __str__ = Exception.__str__  # KeyError would print the repr of the message


class _Checker:
    """Collects where we are, so that each message can say it."""

    def __init__(self, who: str, verb: str) -> None:
        self.where = f"{who}: {verb}"

    def fail(self, argument: str, found: object, wanted: str) -> None:
        raise CommandError(f"{self.where}: {argument} is {found!r}; it must be {wanted}")

    def number(
        self, argument: str, value: Any, low: float = -math.inf, high: float = LIMIT
    ) -> None:
        wanted = "a finite number" if low == -math.inf else f"a finite number >= {low:g}"
        try:
            number = float(value)
        except (TypeError, ValueError):
            self.fail(argument, value, wanted)
        if not math.isfinite(number) or number < low:
            self.fail(argument, value, wanted)
        if abs(number) > high:
            self.fail(argument, value, f"within ±{high:g}")

    def positive(self, argument: str, value: Any) -> None:
        self.number(argument, value)
        if float(value) <= 0:
            self.fail(argument, value, "a number > 0")

    def vector(self, argument: str, value: Any, finite: bool = True) -> None:
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            self.fail(argument, value, "three numbers")
        if array.shape != (3,):
            self.fail(argument, value, "three numbers")
        # Streamed setpoints pass here, so no array functions on three numbers.
        x, y, z = found = array.tolist()
        if finite and not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            self.fail(argument, found, "three finite numbers")
        if finite and not (-LIMIT <= x <= LIMIT and -LIMIT <= y <= LIMIT and -LIMIT <= z <= LIMIT):
            self.fail(argument, found, f"three numbers within ±{LIMIT:g}")

    def byte(self, argument: str, value: Any) -> None:
        try:
            whole = int(value) == value
        except (TypeError, ValueError, OverflowError):
            whole = False
        if not whole or not 0 <= int(value) <= 255:
            self.fail(argument, value, "a whole number 0..255")


def _vertical(k: _Checker, m: c.Takeoff | c.Land) -> None:
    k.number("targetHeight", m.height)
    k.number("duration", m.duration, low=0)
    if m.yaw is not None:
        k.number("yaw", m.yaw)
    k.byte("groupMask", m.group_mask)


def _go_to(k: _Checker, m: c.GoTo) -> None:
    k.vector("goal", m.position)
    k.number("yaw", m.yaw)
    k.number("duration", m.duration, low=0)
    k.byte("groupMask", m.group_mask)


def _masked(k: _Checker, m: c.Stop | c.SetGroupMask) -> None:
    k.byte("groupMask", m.group_mask)


def _notify(k: _Checker, m: c.NotifySetpointsStop) -> None:
    k.number("remainValidMillisecs", m.remain_valid_ms, low=0)
    k.byte("groupMask", m.group_mask)


def _full_state(k: _Checker, m: c.FullState) -> None:
    k.vector("pos", m.position)
    k.vector("vel", m.velocity)
    k.vector("acc", m.acceleration)
    k.number("yaw", m.yaw)
    k.vector("omega", m.omega)


def _position(k: _Checker, m: c.Position) -> None:
    k.vector("pos", m.position)
    k.number("yaw", m.yaw)


def _velocity(k: _Checker, m: c.VelocityWorld) -> None:
    k.vector("vel", m.velocity)
    k.number("yawRate", m.yaw_rate)


def _hover(k: _Checker, m: c.Hover) -> None:
    k.number("vx", m.vx)
    k.number("vy", m.vy)
    k.number("yaw_rate", m.yaw_rate)
    k.number("z_distance", m.height)


def _attitude(k: _Checker, m: c.Attitude) -> None:
    k.number("roll", m.roll)
    k.number("pitch", m.pitch)
    k.number("yawrate", m.yaw_rate)
    k.number("thrust", m.thrust, low=0)
    if m.thrust > 65535:
        k.fail("thrust", m.thrust, "0..65535")


def _angles(k: _Checker, m: c.RollPitchYawThrust) -> None:
    k.number("roll", m.roll)
    k.number("pitch", m.pitch)
    k.number("yaw", m.yaw)
    k.number("thrust", m.thrust, low=0)
    if m.thrust > 65535:
        k.fail("thrust", m.thrust, "0..65535")


def _upload(k: _Checker, m: c.UploadTrajectory) -> None:
    k.byte("trajectoryId", m.trajectory_id)
    k.byte("pieceOffset", m.piece_offset)
    pieces = np.asarray(m.pieces)
    if pieces.ndim != 2 or pieces.shape[1] != PIECE_COLUMNS or not len(pieces):
        k.fail("trajectory", f"array of shape {pieces.shape}", f"(n, {PIECE_COLUMNS}) with n >= 1")
    bad = np.flatnonzero(~np.isfinite(pieces).all(axis=1) | (pieces[:, 0] <= 0))
    if len(bad):
        k.fail(f"piece {bad[0]}", pieces[bad[0]].tolist(), "finite, with a duration > 0")
    if int(m.piece_offset) + len(pieces) > SIMULATED_PIECES:
        raise CommandError(f"{k.where}: {beyond_memory(m, SIMULATED_PIECES)}")


def beyond_memory(m: c.UploadTrajectory, held: int = MEMORY_PIECES) -> str | None:
    """What is too much for a memory of ``held`` pieces; None if it fits."""
    end = int(m.piece_offset) + len(m.pieces)
    if end <= held:
        return None
    return (
        f"{len(m.pieces)} pieces at pieceOffset {m.piece_offset} end at piece {end}, but the "
        f"trajectory memory holds {held} pieces for all trajectories together"
    )


def _start(k: _Checker, m: c.StartTrajectory) -> None:
    k.byte("trajectoryId", m.trajectory_id)
    k.positive("timescale", m.timescale)
    k.byte("groupMask", m.group_mask)


def check_param_name(who: str, name: Any) -> str:
    """Return ``group.name`` for ``group.name`` or ``group/name``; raises CommandError."""
    parts = str(name).replace("/", ".").split(".") if isinstance(name, str) else []
    if len(parts) != 2 or not all(parts):
        raise CommandError(
            f"{who}: parameter name is {name!r}; it must be 'group/name' or 'group.name'"
        )
    return ".".join(parts)


def _set_param(k: _Checker, m: c.SetParam) -> None:
    check_param_name(k.where, m.name)
    k.number(f"value of {m.name}", m.value, high=math.inf)


def _led(k: _Checker, m: c.SetLed) -> None:
    for name, value in (("r", m.red), ("g", m.green), ("b", m.blue)):
        k.number(name, value, low=0)
        if value > 1:
            k.fail(name, value, "0..1")


def _collision_avoidance(k: _Checker, m: c.CollisionAvoidance) -> None:
    if not m.enable:
        return
    k.vector("ellipsoidRadii", m.radii)
    if min(m.radii) <= 0:
        k.fail("ellipsoidRadii", list(m.radii), "three numbers > 0")
    k.vector("bboxMin", m.bbox_min, finite=False)
    k.vector("bboxMax", m.bbox_max, finite=False)
    # "not <" also catches NaN, which infinite bounds must not exclude.
    if not all(low < high for low, high in zip(m.bbox_min, m.bbox_max, strict=True)):
        k.fail("bboxMin, bboxMax", (list(m.bbox_min), list(m.bbox_max)), "min < max on each axis")
    k.positive("horizonSecs", m.horizon)
    k.number("maxSpeed", m.max_speed, low=0)


_CHECKS: dict[type, tuple[str, Callable[[_Checker, Any], None] | None]] = {
    c.Takeoff: ("takeoff", _vertical),
    c.Land: ("land", _vertical),
    c.GoTo: ("goTo", _go_to),
    c.Stop: ("stop", _masked),
    c.NotifySetpointsStop: ("notifySetpointsStop", _notify),
    c.FullState: ("cmdFullState", _full_state),
    c.Position: ("cmdPosition", _position),
    c.VelocityWorld: ("cmdVelocityWorld", _velocity),
    c.Hover: ("cmdHover", _hover),
    c.Attitude: ("cmdVel", _attitude),
    c.RollPitchYawThrust: ("rollPitchYawThrust", _angles),
    c.CutMotors: ("cmdStop", None),
    c.Emergency: ("emergency", None),
    c.Arm: ("arm", None),
    c.UploadTrajectory: ("uploadTrajectory", _upload),
    c.StartTrajectory: ("startTrajectory", _start),
    c.SetGroupMask: ("setGroupMask", _masked),
    c.SetParam: ("setParam", _set_param),
    c.SetLed: ("setLEDColor", _led),
    c.CollisionAvoidance: ("enableCollisionAvoidance", _collision_avoidance),
}


def verb(command: c.Command) -> str:
    """Name of a command in the Crazyswarm API."""
    return _CHECKS[type(command)][0]


def check(command: c.Command, who: str) -> None:
    """Raise :class:`CommandError` if no vehicle could execute ``command``.

    Parameters
    ----------
    who: name of the vehicle (``"cf7"``) or ``"all vehicles"``, for the message.
    """
    try:
        name, checker = _CHECKS[type(command)]
    except KeyError:
        raise CommandError(f"{who}: {command!r} is not a command") from None
    if checker is not None:
        checker(_Checker(who, name), command)
