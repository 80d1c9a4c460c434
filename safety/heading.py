"""Is the rigid body turned against the vehicle that wears it?

A body whose nose is not the vehicle's makes the vehicle tip the wrong way: from some 30 degrees on
it circles, from 60 on it runs away. Its own estimate follows the cameras and shows nothing. The
gyroscope does, which is bolted to the motors: what it feels as roll and pitch must be

- how the cameras see the body turn, about its own axes, and
- how the vehicle is pushed: it is accelerated by gravity times its tilt, so the way is the second
  integral of that, whatever place, speed and tilt were in the beginning.

Both are compared over windows of half a second as complex numbers, x + i y: the ratio is
exp(-i angle), by least squares, each weighted with the noise of the cameras. The first is good
in lively flight, the second on calm take-offs, where tilts are smaller than cameras can see. A
ratio to the conjugate instead tells of mirrored axes. Yaw is compared as it is.

Winds, drag and a wrong trim are slow, and go with what a window does not look at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

GRAVITY = 9.81

Point = tuple[float, float, float]
Array = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]
# Time, place x and y, what was seen and what was felt of the attitude.
_Row = tuple[float, ...]
_LEVEL = (0.0, 0.0, 0.0, 1.0)

_WINDOW = 0.5  # s
_LEAST_SAMPLES = 12
_HURRY, _EASE = 1, 4  # samples after which an unfinished window is looked at, until it is known
_GAP = 0.15  # s without a sample, after which a window begins anew
_MEMORY = 0.97  # share of old windows that is kept at each new one
# rad of turn within a window, above which thrust is no longer what gravity is, and above which a
# turn may be told the other way round.
_LIVELY, _WILD = 0.9, 2.2
_YAW_MEMORY = 4.0  # s in which an old difference of yaw is forgotten
# Noise that is reckoned with: what cameras have, and what the model leaves out.
_PLACE_NOISE = 0.0008  # m
_TURN_NOISE = 0.012  # rad
_MODEL = 0.03  # rad, standard deviation of what the model leaves out
_GAIN = (0.5, 1.7)  # of what is seen to what is felt, that can be a turn
_MIRROR_MARGIN = 0.25
_SURE = 3.0  # standard deviations
KNOWN = 0.05  # rad, standard deviation of an angle that is known well enough
_VAGUE = 0.2  # rad, standard deviation of an angle that says nothing yet


@dataclass(frozen=True, slots=True)
class Turned:
    """By how much a body is turned against its vehicle.

    Attributes
    ----------
    angle: rad, counter-clockwise from the vehicle's nose to the body's.
    sigma: rad, standard deviation of it.
    mirrored: the axes are those of a mirror.
    yaw: rad, by which cameras and gyroscope have come apart in yaw.
    """

    angle: float = 0.0
    sigma: float = math.inf
    mirrored: bool = False
    yaw: float = 0.0

    @property
    def remedy(self) -> str:
        """For people."""
        if self.mirrored:
            return "the cameras' axes are those of a mirror: correct the world frame"
        if abs(self.angle) < abs(self.yaw):
            return (
                f"the cameras turn the body by {math.degrees(self.yaw):+.0f} deg more than its "
                "gyroscope feels"
            )
        degrees = math.degrees(self.angle)
        return (
            f"the body is turned by {degrees:+.0f} deg against the vehicle (to within "
            f"{2.0 * math.degrees(self.sigma):.0f} deg): turn its axes by {-degrees:+.0f} deg "
            "about z in the motion-capture software"
        )

    @property
    def known(self) -> bool:
        """The angle is known well enough to be named."""
        return self.sigma <= KNOWN

    @property
    def surely(self) -> float:
        """rad that the body is turned at least."""
        if self.sigma > _VAGUE:
            return 0.0
        return max(0.0, abs(self.angle) - _SURE * self.sigma)


@dataclass(slots=True)
class _Sums:
    """Of windows: what the gyroscope explains, the conjugate, and how much there was."""

    ratio: complex = 0j
    mirror: complex = 0j
    felt: float = 0.0
    seen: float = 0.0
    samples: float = 0.0

    def plus(self, other: _Sums, share: float) -> _Sums:
        return _Sums(
            share * self.ratio + other.ratio,
            share * self.mirror + other.mirror,
            share * self.felt + other.felt,
            share * self.seen + other.seen,
            share * self.samples + other.samples,
        )


@dataclass(slots=True)
class HeadingWatch:
    """Follows one vehicle; feed it with every believed pose while the vehicle flies."""

    _rows: list[_Row] = field(default_factory=list)
    _sums: _Sums = field(default_factory=_Sums)
    _yaw: float = 0.0
    _last: tuple[float, Quaternion, Point] | None = None
    _felt: Quaternion = _LEVEL
    now: Turned = field(default_factory=Turned)

    def reset(self) -> None:
        """Begin anew: on the ground, or after poses were missing."""
        self._rows, self._sums, self._yaw, self._last = [], _Sums(), 0.0, None
        self._felt = _LEVEL
        self.now = Turned()

    def update(self, time: float, position: Point, seen: Quaternion, gyro: Point) -> Turned:
        """Take a sample.

        Parameters
        ----------
        time: s. position: m, of the cameras. seen: their attitude x, y, z, w.
        gyro: rad/s about the vehicle's own axes.
        """
        if self._last is not None and time <= self._last[0]:
            return self.now
        if self._last is None or time - self._last[0] > _GAP:
            self._rows = []
        else:
            before, q, rate = self._last
            dt = time - before
            mean = [0.5 * dt * (a + b) for a, b in zip(rate, gyro, strict=True)]
            self._felt = _turned(self._felt, *mean)
            self._yaw *= math.exp(-dt / _YAW_MEMORY)
            self._yaw += _rotation(q, seen)[2] - mean[2]
        self._last = time, seen, gyro
        self._rows.append((time, *position[:2], *seen, *self._felt))
        latest = _Sums()
        if time - self._rows[0][0] >= _WINDOW and len(self._rows) >= _LEAST_SAMPLES:
            latest = _window(self._rows)
            self._rows = self._rows[-1:]
            self._sums = self._sums.plus(latest, _MEMORY)
            self.now = self._judge(self._sums)
        elif len(self._rows) >= _LEAST_SAMPLES and not len(self._rows) % self._each:
            self.now = self._judge(self._sums.plus(_window(self._rows), _MEMORY))
        else:
            self.now = Turned(self.now.angle, self.now.sigma, self.now.mirrored, self._yaw)
        return self.now

    @property
    def _each(self) -> int:
        return _EASE if self.now.known else _HURRY

    def _judge(self, sums: _Sums) -> Turned:
        if sums.felt <= 0.0:
            return Turned(yaw=self._yaw)
        # Motion along one line fits a turn as well as a mirror: then it is taken for a turn.
        spread = math.sqrt(1.0 / (2.0 * sums.felt))
        margin = max(_MIRROR_MARGIN, 4.0 * spread) * sums.felt
        mirrored = abs(sums.mirror) > abs(sums.ratio) + margin
        ratio = sums.mirror if mirrored else sums.ratio
        gain = abs(ratio) / sums.felt
        if not _GAIN[0] < gain < _GAIN[1]:
            return Turned(yaw=self._yaw)
        left = max(0.0, sums.seen - abs(ratio) ** 2 / sums.felt) / sums.samples
        sigma = math.hypot(math.sqrt(max(left, 1.0)) * spread, _MODEL)
        angle = math.pi if mirrored else -math.atan2(ratio.imag, ratio.real)
        return Turned(angle, sigma, mirrored, self._yaw)


def _window(rows: list[_Row]) -> _Sums:
    table = np.array(rows)
    times = table[:, 0] - table[0, 0]
    place = table[:, 1] + 1j * table[:, 2]
    felt, lean = _turns(table[:, 7:])
    seen, _ = _turns(table[:, 3:7])
    most = max(np.abs(felt).max(), np.abs(seen).max())
    if most > _WILD:
        return _Sums()
    # As a camera behind a mirror would see it.
    sums = _compared(felt, -felt.conj(), seen, np.ones((len(times), 1)), _TURN_NOISE)
    if most > _LIVELY:
        return sums
    turned = GRAVITY * np.exp(1j * _yaw(rows[0][3:7]))
    pushed = _integral(_integral(turned * lean, times), times)
    mirror = _integral(_integral(turned * lean.conj(), times), times)
    slow = np.vander(times, 3)
    return sums.plus(_compared(pushed, mirror, place, slow, _PLACE_NOISE), 1.0)


def _turns(q: Array) -> tuple[NDArray, NDArray]:
    """Of attitudes (n, 4), about the axes of the first: their turns as rotation vectors, and
    where up leans; x + i y of both."""
    a, b = q[0], q
    x = a[3] * b[:, 0] - a[0] * b[:, 3] - a[1] * b[:, 2] + a[2] * b[:, 1]
    y = a[3] * b[:, 1] + a[0] * b[:, 2] - a[1] * b[:, 3] - a[2] * b[:, 0]
    z = a[3] * b[:, 2] - a[0] * b[:, 1] + a[1] * b[:, 0] - a[2] * b[:, 3]
    w = a[3] * b[:, 3] + a[0] * b[:, 0] + a[1] * b[:, 1] + a[2] * b[:, 2]
    sign = np.where(w < 0.0, -1.0, 1.0)
    sine = np.sqrt(x * x + y * y + z * z)
    share = np.where(sine > 1e-9, 2.0 * np.arctan2(sine, abs(w)) / np.maximum(sine, 1e-9), 2.0)
    lean = 2.0 * ((x * z + w * y) + 1j * (y * z - w * x))
    return sign * share * (x + 1j * y), lean


def _turned(q: Quaternion, x: float, y: float, z: float) -> Quaternion:
    """q, turned by a small rotation vector (rad) about its own axes."""
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    s, w = (0.5 * math.sin(half) / half if half > 1e-9 else 0.5), math.cos(half)
    x, y, z = s * x, s * y, s * z
    a, b, c, d = q
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def _compared(felt: NDArray, mirror: NDArray, seen: NDArray, slow: Array, noise: float) -> _Sums:
    """What is left of them without the columns of ``slow``, in units of the noise."""
    q, _ = np.linalg.qr(slow)
    felt, mirror, seen = ((row - q @ (q.T @ row)) / noise for row in (felt, mirror, seen))
    return _Sums(
        complex(np.vdot(felt, seen)),
        complex(np.vdot(mirror, seen)),
        float(np.vdot(felt, felt).real),
        float(np.vdot(seen, seen).real),
        float(len(seen)),
    )


def _integral(values: NDArray, times: Array) -> NDArray:
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _rotation(a: Quaternion, b: Quaternion) -> tuple[float, float, float]:
    """Rotation vector, rad, about a's own axes that takes a to b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by + ax * bz - ay * bw - az * bx
    z = aw * bz - ax * by + ay * bx - az * bw
    w = aw * bw + ax * bx + ay * by + az * bz
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-12:
        return 0.0, 0.0, 0.0
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    share = 2.0 * math.atan2(sine, w) / sine
    return share * x, share * y, share * z


def _yaw(q: Sequence[float]) -> float:
    x, y, z, w = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
