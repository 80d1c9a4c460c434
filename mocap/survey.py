"""Survey of the track: where gates and obstacles really stand, before anybody flies.

Averages the poses of the track's bodies over many frames (quaternions by Markley et al. 2007),
compares them with the level's nominal poses and refuses what is out of tolerance.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.bounded_read import read_json
from crazyarena.errors import InputError
from crazyarena.mocap.cadence import Cadence
from crazyarena.mocap.rotations import angle_between
from crazyarena.plain_text import shown_line
from crazyarena.types import Pose, PoseFrame, Vector
from crazyarena.whole_file import write_whole

FORMAT = "crazyarena-measured-track"
VERSION = 1
_LATEST = 10  # frames that tell where a moving body is
_LONGEST = 4 << 20  # characters of a measured track
_SLOWEST = 4  # frames from one sight of a body to the next, at most


@dataclass(frozen=True, slots=True)
class Allowed:
    """How far a body may be from nominal: ``(low, high)`` of x, y, z in m and of yaw in rad.

    roll, pitch: the same of the fixed-axis angles, rad, for what need not stand upright; None:
    it must.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]
    yaw: tuple[float, float]
    roll: tuple[float, float] | None = None
    pitch: tuple[float, float] | None = None

    @property
    def leans(self) -> bool:
        """Whether it need not stand upright."""
        return self.roll is not None or self.pitch is not None


def misplaced(
    pose: Pose, nominal: Pose, allowed: Allowed, full_turn: bool = False, height: bool = True
) -> str | None:
    """Say how a body is out of its tolerance, axis by axis; None when it is not.

    ``full_turn`` False takes a body turned by half a turn for the same; ``height`` False does
    not look at z.
    """
    off = (pose.position - nominal.position).tolist()
    for axis, value, (low, high) in zip("xyz", off, (allowed.x, allowed.y, allowed.z), strict=True):
        if axis == "z" and not height:
            continue
        if not low <= value <= high:
            return (
                f"stands {value * 1e2:+.1f} cm from its nominal place in {axis}; "
                f"{low * 1e2:+.1f} to {high * 1e2:+.1f} cm are allowed"
            )
    turns = [("turned", _turned(pose, nominal, full_turn), allowed.yaw)]
    if allowed.leans:
        (roll, pitch), (level_roll, level_pitch) = _lean(pose.quaternion), _lean(nominal.quaternion)
        upright = (0.0, 0.0)
        turns += [
            ("rolled", _wrap(roll - level_roll, 2.0 * math.pi), allowed.roll or upright),
            ("pitched", pitch - level_pitch, allowed.pitch or upright),
        ]
    for how, turn, (low, high) in turns:
        if not low <= turn <= high:
            return (
                f"is {how} by {math.degrees(turn):+.1f} degrees against nominal; "
                f"{math.degrees(low):+.1f} to {math.degrees(high):+.1f} are allowed"
            )
    return None


def _lean(quaternion: Vector) -> tuple[float, float]:
    """Fixed-axis roll and pitch, rad."""
    x, y, z, w = quaternion.tolist()
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
    )


def _turned(pose: Pose, nominal: Pose, full_turn: bool) -> float:
    period = 2.0 * math.pi if full_turn else math.pi
    return _wrap(_yaw(pose.quaternion) - _yaw(nominal.quaternion), period)


@dataclass(frozen=True, slots=True)
class SurveyConfig:
    """Requirements of a survey.

    frames: frames to average; min_seen: share of them in which every body must appear, or of
    every second, ... up to fourth, for trackers that are slower than others;
    allowed: how far each body may be from nominal, by name; for others position_tolerance, of each
    axis, and yaw_tolerance, m and rad; tilt_tolerance, rad; max_spread: largest standard deviation
    of a body's position, m (it must stand still).
    ``full_turn`` False compares yaw modulo 180 degrees, for gates without a front.
    """

    frames: int = 200
    min_seen: float = 0.8
    position_tolerance: float = 0.15
    yaw_tolerance: float = math.radians(10.0)
    tilt_tolerance: float = math.radians(5.0)
    max_spread: float = 0.005
    full_turn: bool = True
    allowed: Mapping[str, Allowed] = field(default_factory=dict)

    def rule(self, name: str) -> Allowed:
        """How far the body ``name`` may be from nominal."""
        reach = (-self.position_tolerance, self.position_tolerance)
        turn = (-self.yaw_tolerance, self.yaw_tolerance)
        return self.allowed.get(name, Allowed(reach, reach, reach, turn))


@dataclass(frozen=True, slots=True)
class SurveyedBody:
    """One measured body: mean pose, deviation from nominal and what is wrong with it.

    deviation: distance from nominal, m; yaw_deviation, tilt: rad; spread: standard deviation
    of the position, m; problem: None, or plain words.
    """

    name: str
    pose: Pose | None
    seen: int
    deviation: float
    yaw_deviation: float
    tilt: float
    spread: float
    problem: str | None


@dataclass(frozen=True, slots=True)
class SurveyReport:
    """All bodies of the track, in the order of the nominal poses."""

    bodies: tuple[SurveyedBody, ...]
    frames: int

    @property
    def accepted(self) -> bool:
        return all(body.problem is None for body in self.bodies)

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(b.problem for b in self.bodies if b.problem is not None)

    def track(self) -> dict[str, Pose]:
        """Measured poses by name; raises InputError with every problem if any is refused."""
        if not self.accepted:
            raise InputError("track survey refused: " + "; ".join(self.problems))
        return {b.name: b.pose for b in self.bodies if b.pose is not None}


def mean_quaternion(quaternions: Vector) -> Vector:
    """Mean attitude of (n, 4) unit quaternions; signs do not matter."""
    _, vectors = np.linalg.eigh(quaternions.T @ quaternions)
    mean = vectors[:, -1]
    return -mean if mean[3] < 0 else mean


def _yaw(quaternion: Vector) -> float:
    x, y, z, w = quaternion.tolist()
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _wrap(angle: float, period: float) -> float:
    return (angle + 0.5 * period) % period - 0.5 * period


def survey(
    frames: Iterable[PoseFrame],
    nominal: Mapping[str, Pose],
    config: SurveyConfig | None = None,
    moving: Collection[str] = (),
) -> SurveyReport:
    """Measure the bodies named in ``nominal`` over the next ``config.frames`` frames.

    Those named in ``moving`` may be anywhere and on the move: they must only be seen and stand
    upright, and their pose is that at the end.
    """
    config = config or SurveyConfig()
    samples: dict[str, list[Pose]] = {name: [] for name in nominal}
    cadences: dict[str, Cadence] = {}
    count = 0
    for frame in frames:
        for name, poses in samples.items():
            pose = frame.bodies.get(name)
            if pose is None:
                continue
            poses.append(pose)
            if name in cadences:
                cadences[name].note(count)
            else:
                cadences[name] = Cadence(count)
        count += 1
        if count >= config.frames:
            break
    bodies = []
    for name, expected in nominal.items():
        period = min(cadences[name].period, _SLOWEST) if name in cadences else 1
        need = math.ceil(config.min_seen * config.frames / period)
        bodies.append(
            _measure(name, samples[name], expected, (need, count), config, name in moving)
        )
    return SurveyReport(tuple(bodies), count)


def _measure(
    name: str,
    samples: list[Pose],
    nominal: Pose,
    needed: tuple[int, int],
    config: SurveyConfig,
    moving: bool,
) -> SurveyedBody:
    need, count = needed
    problem: str | None = None
    if not samples:
        nan = math.nan
        problem = f"{name} was not seen in {count} frames; is its body enabled and named so?"
        return SurveyedBody(name, None, 0, nan, nan, nan, nan, problem)
    earlier = 0
    if moving:
        earlier = max(0, len(samples) - _LATEST)
        samples = samples[earlier:]
    positions = np.array([p.position for p in samples])
    # The median resists the odd outlier that a mean would carry into the track.
    centre = np.median(positions, axis=0)
    near = np.linalg.norm(positions - centre, axis=1) <= 0.05
    quaternions = np.array([p.quaternion for p in samples])
    middle = mean_quaternion(quaternions)
    upright = np.array([angle_between(middle, q) <= 0.5 for q in quaternions])
    kept = near & upright
    if not kept.any():
        kept = near
    position = positions[kept].mean(axis=0)
    quaternion = mean_quaternion(quaternions[kept])
    spread = float(np.sqrt(positions[kept].var(axis=0).sum()))
    deviation = float(np.linalg.norm(position - nominal.position))
    pose = Pose(position, quaternion)
    yaw = _turned(pose, nominal, config.full_turn)
    x, y, _, _ = quaternion.tolist()
    tilt = math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))
    seen = earlier + int(kept.sum())
    if seen < need:
        problem = f"{name} was seen well in {seen} of {count} frames; {need} are needed"
    elif not moving and spread > config.max_spread:
        problem = (
            f"{name} moves by {spread * 1e3:.1f} mm; it must stand still "
            f"({config.max_spread * 1e3:.1f} mm)"
        )
    elif not moving and (wrong := misplaced(pose, nominal, config.rule(name), config.full_turn)):
        problem = f"{name} {wrong}"
    elif tilt > config.tilt_tolerance and not config.rule(name).leans:
        problem = f"{name} leans by {math.degrees(tilt):.1f} degrees; straighten it"
    return SurveyedBody(name, pose, seen, deviation, yaw, tilt, spread, problem)


def write_track(path: str | Path, report: SurveyReport, level: str = "") -> None:
    """Write the measured track as JSON; raises InputError if the survey was refused."""
    report.track()
    bodies = {
        b.name: {
            "position": b.pose.position.tolist(),
            "quaternion": b.pose.quaternion.tolist(),
            "frames": b.seen,
            "spread": b.spread,
            "deviation": b.deviation,
            "yaw_deviation": b.yaw_deviation,
        }
        for b in report.bodies
        if b.pose is not None
    }
    _write(path, bodies, level)


def write_taped(path: str | Path, poses: Mapping[str, Pose], level: str = "") -> None:
    """Write a track as people measure it without cameras, to be corrected by hand: place (m) and
    ``yaw`` (rad) of each body."""
    bodies = {}
    for name, pose in poses.items():
        x, y, z, w = pose.quaternion.tolist()
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        place = [round(float(value), 4) for value in pose.position]
        bodies[name] = {"position": place, "yaw": round(yaw, 5)}
    _write(path, bodies, level)


def _write(path: str | Path, bodies: Mapping[str, Any], level: str) -> None:
    document = {"format": FORMAT, "version": VERSION, "level": level, "bodies": bodies}
    write_whole(Path(path), json.dumps(document, indent=2) + "\n")


def read_track(path: str | Path) -> dict[str, Pose]:
    """Read a measured track; a body has ``position`` (m) and ``quaternion`` or ``yaw`` (rad).

    Raises InputError naming file and field.
    """
    path = Path(path)
    document = read_json(path, "measured track")
    if not isinstance(document, dict) or (document.get("format"), document.get("version")) != (
        FORMAT,
        VERSION,
    ):
        raise InputError(f"{path}: field format: need {FORMAT} version {VERSION}")
    bodies = document.get("bodies", {})
    if not isinstance(bodies, dict):
        raise InputError(f"{path}: field bodies: need bodies by name")
    poses = {}
    for name, body in bodies.items():
        try:
            position = np.array(body["position"], dtype=float)
            if "yaw" in body and "quaternion" not in body:
                half = 0.5 * float(body["yaw"])
                quaternion = np.array((0.0, 0.0, math.sin(half), math.cos(half)))
            else:
                quaternion = np.array(body["quaternion"], dtype=float)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            what = f"missing {error}" if isinstance(error, KeyError) else str(error)
            raise InputError(f"{path}: body {shown_line(name)}: {shown_line(what)}") from None
        good = position.shape == (3,) and quaternion.shape == (4,)
        good = good and bool(np.isfinite([*position, *quaternion]).all())
        if not good or abs(float(np.linalg.norm(quaternion)) - 1.0) > 1e-6:
            raise InputError(
                f"{path}: body {shown_line(name)}: need position (3,) and unit quaternion "
                "x, y, z, w"
            )
        poses[name] = Pose(position, quaternion)
    return poses
