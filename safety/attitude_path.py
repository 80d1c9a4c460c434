"""Where a vehicle gets to that is flown by attitude: tilt and thrust are an acceleration.

Its controller follows no place and brakes for nobody: what was told last goes on. After the last
setpoint the firmware holds tilt and thrust for half a second, levels out with the thrust it had,
and is cut by its emergency-stop watchdog a second after it was last fed; then it falls (Crazyflie
firmware, ``commander`` and ``supervisor``).
"""

from __future__ import annotations

import math

from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Point

GRAVITY = 9.81
FULL = 65535.0
_HOLD = 0.5  # s for which the firmware keeps a setpoint
_CUT = 1.0  # s until its emergency-stop watchdog stops the motors
_LEVELLING = 0.2  # s, over which the push to the side fades
_LOOKS = (0.5, 1.0)  # shares of each phase at which the way is looked at
_BISECTIONS = 6


def push(roll: float, pitch: float, yaw: float, thrust: float, limits: Limits) -> Point:
    """Acceleration, m/s2 world, that a setpoint asks for: rad (positive pitch nose down), and
    thrust of 0..65535. ``limits.thrust_to_weight`` says what full thrust is."""
    lift = thrust / FULL * limits.thrust_to_weight * GRAVITY
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    s, c = math.sin(yaw), math.cos(yaw)
    return (
        lift * (c * sp * cr + s * sr),
        lift * (s * sp * cr - c * sr),
        lift * cp * cr - GRAVITY,
    )


def tilt_of(ax: float, ay: float, yaw: float, lift: float) -> tuple[float, float]:
    """Roll and pitch, rad, that push by ax, ay (m/s2, world) at a thrust of ``lift`` m/s2."""
    size = math.hypot(ax, ay)
    most = 0.95 * max(lift, 1e-6)
    if size > most:
        ax, ay = ax * most / size, ay * most / size
    s, c = math.sin(yaw), math.cos(yaw)
    forward, left = (c * ax + s * ay) / max(lift, 1e-6), (c * ay - s * ax) / max(lift, 1e-6)
    roll = math.asin(-left)
    return roll, math.asin(max(-1.0, min(1.0, forward / math.cos(roll))))


class AttitudeLoss:
    """How far a vehicle flown by attitude gets if the link is lost."""

    def __init__(self, fence: Fence, limits: Limits) -> None:
        self._fence = fence
        self._limits = limits
        self._delay = limits.link_delay

    @property
    def on(self) -> bool:
        """Whether the limits ask for this at all."""
        return math.isfinite(self._limits.attitude_loss_margin)

    def excess(self, place: Point, moving: Point, pushed: Point) -> float:
        """How far beyond the hard fence, m, it comes down that is pushed so (m/s2) by its last
        setpoint; negative inside."""
        least = math.inf
        x, y, z = place
        vx, vy, vz = moving
        ax, ay, az = pushed
        phases = (
            (self._delay + _HOLD, ax, ay, az),
            (_LEVELLING, 0.5 * ax, 0.5 * ay, az),
            (_CUT - _HOLD - _LEVELLING, 0.0, 0.0, az),
        )
        for time, px, py, pz in phases:
            for share in _LOOKS:
                t = share * time
                h = 0.5 * t * t
                height = z + vz * t + pz * h
                least = min(least, self._room(x + vx * t + px * h, y + vy * t + py * h, height))
                if height <= 0.0:
                    return -least
            h = 0.5 * time * time
            x, y, z = x + vx * time + px * h, y + vy * time + py * h, z + vz * time + pz * h
            vx, vy, vz = vx + px * time, vy + py * time, vz + pz * time
        top = z + max(vz, 0.0) ** 2 / (2.0 * GRAVITY)
        fall = (vz + math.sqrt(vz * vz + 2.0 * GRAVITY * max(z, 0.0))) / GRAVITY
        return -min(least, self._room(x, y, top), self._room(x + fall * vx, y + fall * vy, 0.0))

    def held_back(self, place: Point, moving: Point, pushed: Point) -> tuple[float, float] | None:
        """Push to the side, m/s2, that may be told instead; None if it is good as it is.

        As much of it as keeps within the margin, the rest of the way to braking as hard as the
        vehicle can; all of that if nothing keeps within.
        """
        margin = self._limits.attitude_loss_margin
        if self.excess(place, moving, pushed) <= margin:
            return None
        # Of the same thrust more lifts where less pushes to the side.
        lift = math.hypot(pushed[0], pushed[1], pushed[2] + GRAVITY)
        speed = math.hypot(moving[0], moving[1])
        brake = 0.0 if speed < 1e-6 else -self._limits.braking * min(1.0, speed / 0.5) / speed
        bx, by = brake * moving[0], brake * moving[1]
        good, bad = 0.0, 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (good + bad)
            x, y = bx + share * (pushed[0] - bx), by + share * (pushed[1] - by)
            up = math.sqrt(max(lift * lift - x * x - y * y, 0.0))
            if self.excess(place, moving, (x, y, up - GRAVITY)) <= margin:
                good = share
            else:
                bad = share
        return bx + good * (pushed[0] - bx), by + good * (pushed[1] - by)

    def _room(self, x: float, y: float, z: float) -> float:
        return self._fence.room(x, y, max(z, self._fence.floor))
