"""Piecewise polynomial trajectories of position and yaw, and their flatness outputs.

A differentially flat quadrotor needs only position and yaw over time; attitude and body rates
follow (Mellinger and Kumar, ICRA 2011). SI units, yaw in rad, world frame.
"""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.bounded_read import read_text
from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line

GRAVITY = np.array([0.0, 0.0, 9.81])
_COEFFICIENTS = 8
_COLUMNS = 1 + 4 * _COEFFICIENTS
_NAMES = ["duration", *(f"{a}^{n}" for a in ("x", "y", "z", "yaw") for n in range(_COEFFICIENTS))]


def normalize(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale a nonzero vector to unit length."""
    length = np.linalg.norm(v)
    if not length > 0:
        raise AssertionError("normalize: the vector has no length")
    return v / length


class Polynomial:
    """Polynomial with coefficients ``p`` in ascending powers."""

    def __init__(self, p: ArrayLike) -> None:
        self.p = p

    def eval(self, t: float) -> float:
        """Value at ``t`` >= 0 (Horner's rule)."""
        if not t >= 0:
            raise AssertionError(f"Polynomial.eval: t is {t}; it must be >= 0")
        value = 0.0
        for coefficient in reversed(np.asarray(self.p)):
            value = value * t + coefficient
        return value

    def derivative(self) -> Polynomial:
        """First derivative, one coefficient shorter."""
        p = np.asarray(self.p, dtype=np.float64)
        return Polynomial(p[1:] * np.arange(1, len(p)))


class TrajectoryOutput:
    """Desired motion at one instant.

    pos m, vel m/s, acc m/s², each (3,) world; omega (3,) rad/s body; yaw rad.
    """

    def __init__(self) -> None:
        self.pos: NDArray[np.float64] | None = None
        self.vel: NDArray[np.float64] | None = None
        self.acc: NDArray[np.float64] | None = None
        self.omega: NDArray[np.float64] | None = None
        self.yaw: float | None = None


class Polynomial4D:
    """One piece: ``duration`` s and polynomials of x, y, z (m) and yaw (rad)."""

    def __init__(
        self,
        duration: float,
        px: ArrayLike,
        py: ArrayLike,
        pz: ArrayLike,
        pyaw: ArrayLike,
    ) -> None:
        self.duration = duration
        self.px = Polynomial(px)
        self.py = Polynomial(py)
        self.pz = Polynomial(pz)
        self.pyaw = Polynomial(pyaw)

    def derivative(self) -> Polynomial4D:
        """Piece of the same duration with each polynomial differentiated."""
        return Polynomial4D(
            self.duration,
            *(axis.derivative().p for axis in (self.px, self.py, self.pz, self.pyaw)),
        )

    def _position(self, t: float) -> NDArray[np.float64]:
        return np.array([self.px.eval(t), self.py.eval(t), self.pz.eval(t)])

    def eval(self, t: float) -> TrajectoryOutput:
        """Motion at local time ``t`` s; body rates by differential flatness."""
        first = self.derivative()
        second = first.derivative()
        out = TrajectoryOutput()
        out.pos = self._position(t)
        out.yaw = self.pyaw.eval(t)
        out.vel = first._position(t)
        out.acc = second._position(t)
        jerk = second.derivative()._position(t)

        thrust = out.acc + GRAVITY
        z_body = normalize(thrust)
        x_course = np.array([np.cos(out.yaw), np.sin(out.yaw), 0.0])
        y_body = normalize(np.cross(z_body, x_course))
        x_body = np.cross(y_body, z_body)
        h = (jerk - np.dot(jerk, z_body) * z_body) / np.linalg.norm(thrust)
        yaw_rate = first.pyaw.eval(t)
        out.omega = np.array([-np.dot(h, y_body), np.dot(h, x_body), z_body[2] * yaw_rate])
        return out


def _is_header(line: str, place: str) -> bool:
    """Whether a first line names columns: nothing in it is a number.

    A spoilt first piece is none, and is refused where it is read. Raises InputError for columns
    in another order.
    """
    names = [field.strip(" \t\"'").lower() for field in line.split(",")]
    if any(_is_number(name) for name in names):
        return False
    found = names[:_COLUMNS]
    if found != _NAMES and sorted(found) == sorted(_NAMES):
        raise InputError(f"{place}: columns in another order; write them as {', '.join(_NAMES)}")
    return True


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


class Trajectory:
    """A sequence of :class:`Polynomial4D` pieces; ``duration`` is their sum in s."""

    def __init__(self) -> None:
        self.polynomials: list[Polynomial4D] = []
        self.duration: float = 0.0

    def n_pieces(self) -> int:
        """Number of pieces."""
        return len(self.polynomials)

    def loadcsv(self, filename: str | os.PathLike[str]) -> None:
        """Read rows of duration and 4 x 8 ascending coefficients, with or without a header line.

        Further columns (such as an empty one after a trailing comma) are not read.

        Raises
        ------
        InputError
            naming file, row and what was found.
        """
        path = os.fspath(filename)
        lines = read_text(Path(path), "trajectory").splitlines()
        pieces = []
        first = next((n for n, line in enumerate(lines, start=1) if line.strip()), None)
        for number, line in enumerate(lines, start=1):
            if not line.strip() or (number == first and _is_header(line, f"{path}, line {number}")):
                continue
            fields = line.split(",")[:_COLUMNS]
            if len(fields) < _COLUMNS:
                raise InputError(
                    f"{path}, line {number}: {len(fields)} columns; a piece has {_COLUMNS} "
                    "(duration, then 8 coefficients each for x, y, z and yaw)"
                )
            try:
                row = np.array([float(field) for field in fields])
            except ValueError as error:
                raise InputError(f"{path}, line {number}: {shown_line(str(error))}") from None
            if not np.isfinite(row).all() or row[0] <= 0:
                raise InputError(
                    f"{path}, line {number}: duration {row[0]}; durations must be > 0 and all "
                    "coefficients finite"
                )
            pieces.append(row)
        if not pieces:
            raise InputError(f"{path}: holds no trajectory piece after its header line")
        bounds = range(1, _COLUMNS + 1, _COEFFICIENTS)
        self.polynomials = [
            Polynomial4D(row[0], *(row[a:b] for a, b in pairwise(bounds))) for row in pieces
        ]
        self.duration = float(sum(row[0] for row in pieces))

    def eval(self, t: float) -> TrajectoryOutput:
        """Motion at ``t`` s; AssertionError unless 0 <= t <= duration."""
        if not 0 <= t <= self.duration:
            raise AssertionError(f"Trajectory.eval: t is {t}; it must be 0..{self.duration}")
        begin = 0.0
        for piece in self.polynomials[:-1]:
            if t < begin + piece.duration:
                return piece.eval(t - begin)
            begin += piece.duration
        return self.polynomials[-1].eval(t - begin)
