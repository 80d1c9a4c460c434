"""What is wrong with the motion capture, in plain words. Logic of ``crazyarena mocap-check``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from crazyarena.mocap.assembly import SAME
from crazyarena.mocap.axes import recognised_axes
from crazyarena.mocap.cadence import Cadence
from crazyarena.mocap.rotations import angle_between
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.types import Pose, PoseFrame

# A body that stays within this, m, is at rest.
_REST = 0.02


@dataclass(frozen=True, slots=True)
class CheckLimits:
    """What a healthy arena keeps to.

    min_rate, max_rate: Hz, of each body; max_latency: median, s; max_jitter: standard deviation
    of a body's intervals as a share of its period; max_dropout: share of frames without a body;
    max_noise: standard deviation of a body at rest, m; jump, flip: change between two frames
    that nothing flying can do, m and rad.
    """

    min_rate: float = 80.0
    max_rate: float = 360.0
    max_latency: float = 0.02
    max_jitter: float = 0.25
    max_dropout: float = 0.01
    max_noise: float = 0.002
    jump: float = 0.1
    flip: float = 1.0


@dataclass(slots=True)
class BodyReport:
    """Statistics of one body.

    rate: how often it comes when nothing is missed, Hz; jitter: standard deviation of those
    intervals on arrival, s; both nan until it was seen often enough.
    """

    seen: int = 0
    missing: int = 0
    rate: float = math.nan
    jitter: float = math.nan
    longest_gap: float = 0.0
    jumps: int = 0
    flips: int = 0
    last: Pose | None = None
    last_time: float = math.nan
    cadence: Cadence | None = None
    recent: deque[np.ndarray] = field(default_factory=lambda: deque(maxlen=100))
    # Stride in frames, and intervals of capture and arrival, s.
    intervals: deque[tuple[int, float, float]] = field(default_factory=lambda: deque(maxlen=5000))
    last_received: float = math.nan

    def settle(self, frames: int) -> None:
        """Work out what follows from the sights among the first ``frames`` frames."""
        if self.cadence is None:
            self.missing = frames
            return
        self.missing = self.cadence.missing(frames)
        period = self.cadence.period
        steps = np.array([i[1:] for i in self.intervals if i[0] == period]).reshape(-1, 2)
        if len(steps) > 1:
            middle = float(np.median(steps[:, 0]))
            # Where stamps are made on arrival they come in bursts; their mean does not.
            mean = float(steps[:, 0].mean())
            self.rate = 1.0 / mean if mean > 0.0 and middle < 2.0 * mean else math.nan
            self.jitter = float(steps[:, 1].std())


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Live figures and verdicts; ``problems`` is empty when all is well.

    rate, jitter: of the bodies, Hz and s (the highest rate, the median jitter); of the frames
    where there are no bodies.
    """

    frames: int
    rate: float
    jitter: float
    latency_p50: float
    latency_p99: float
    lost: int
    malformed: int
    markers: float
    bodies: dict[str, BodyReport]
    problems: tuple[str, ...]

    @property
    def healthy(self) -> bool:
        return not self.problems


class MocapCheck:
    """Collect frames and judge them.

    Parameters
    ----------
    expected: names of bodies that must be there.
    limits: what is healthy.
    knows_latency: False for sources whose protocol does not tell the capture time.
    """

    def __init__(
        self,
        expected: Sequence[str] = (),
        limits: CheckLimits | None = None,
        knows_latency: bool = True,
    ) -> None:
        self.limits = limits or CheckLimits()
        self._expected = tuple(expected)
        self._knows_latency = knows_latency
        self._bodies: dict[str, BodyReport] = {name: BodyReport() for name in expected}
        self._received: deque[float] = deque(maxlen=5000)
        self._captured: deque[float] = deque(maxlen=5000)
        self._markers: deque[int] = deque(maxlen=5000)
        self._frames = 0
        self._instants = 0

    def add(self, frame: PoseFrame) -> None:
        """Take one frame."""
        self._frames += 1
        # A piece that came too late for its frame belongs to the same instant.
        if not self._captured or frame.timestamp - self._captured[-1] > SAME:
            self._instants += 1
        self._received.append(frame.received)
        self._captured.append(frame.timestamp)
        self._markers.append(len(frame.markers))
        for name, pose in frame.bodies.items():
            body = self._bodies.setdefault(name, BodyReport())
            stride = 0
            if body.cadence is None:
                body.cadence = Cadence(self._instants - 1)
            else:
                stride = body.cadence.note(self._instants - 1)
            if body.last is not None:
                gap = frame.timestamp - body.last_time
                step = float(np.linalg.norm(pose.position - body.last.position))
                # What was hidden for long may be anywhere when it is back.
                if gap < 0.1:
                    body.jumps += step > self.limits.jump
                    body.flips += angle_between(body.last.quaternion, pose.quaternion) > (
                        self.limits.flip
                    )
                body.longest_gap = max(body.longest_gap, gap)
                body.intervals.append((stride, gap, frame.received - body.last_received))
            body.seen += 1
            body.last = pose
            body.last_time = frame.timestamp
            body.last_received = frame.received
            body.recent.append(np.concatenate((pose.position, pose.quaternion)))

    def report(self, status: SourceStatus, elapsed: float) -> CheckReport:
        """Judge what came in ``elapsed`` s from a source with this ``status``."""
        limits = self.limits
        received = np.array(self._received)
        captured = np.array(self._captured)
        span = received[-1] - received[0] if len(received) > 1 else 0.0
        rate = (len(received) - 1) / span if span > 0 else 0.0
        # Capture times show the cameras' clock, receive times the network's mood.
        jitter = float(np.diff(received).std()) if len(received) > 2 else 0.0
        for body in self._bodies.values():
            body.settle(self._instants)
        rates = [b.rate for b in self._bodies.values() if math.isfinite(b.rate)]
        if rates:
            rate = max(rates)
            jitter = float(
                np.median([b.jitter for b in self._bodies.values() if math.isfinite(b.rate)])
            )
        delay = received - captured
        p50, p99 = np.percentile(delay, (50, 99)).tolist() if len(delay) else (math.nan,) * 2
        problems = []
        if not self._frames:
            state = {
                SourceState.CONNECTING: "no connection yet",
                SourceState.LOST: "the connection was lost",
            }.get(status.state, "connected, but silent")
            why = f" ({status.error})" if status.error else ""
            problems.append(
                f"No frame in {elapsed:.1f} s: {state}{why}. Is the camera software running and "
                "streaming, and are host name, interface and firewall right?"
            )
        elif rate < limits.min_rate:
            problems.append(
                f"Only {rate:.0f} frames per second; vehicles fly jerkily below "
                f"{limits.min_rate:.0f}. Raise the camera rate or look for a busy network."
            )
        elif rate > limits.max_rate:
            problems.append(
                f"{rate:.0f} frames per second are more than {limits.max_rate:.0f}; lower the "
                "camera rate, the extra frames cost time and tell nothing."
            )
        if rate and jitter * rate > limits.max_jitter:
            problems.append(
                f"Frames arrive unevenly (standard deviation {jitter * 1e3:.1f} ms at intervals "
                f"of {1e3 / rate:.1f} ms); use a cable and close other programs."
            )
        if self._knows_latency and p50 > limits.max_latency:
            problems.append(
                f"Poses are {p50 * 1e3:.0f} ms old when they arrive; up to "
                f"{limits.max_latency * 1e3:.0f} ms are good. Switch off smoothing in the camera "
                "software and check the network."
            )
        if status.lost or status.dropped:
            problems.append(f"{status.lost + status.dropped} frames were lost on the way.")
        if status.malformed:
            problems.append(
                f"{status.malformed} payloads could not be read ({status.error}); another "
                "program or version publishes under the same key."
            )
        if status.foreign:
            problems.append(
                f"{status.foreign} frames of another publisher were ignored: two programs publish "
                "poses under the same key. Stop one, or give each a key of its own."
            )
        for name in self._expected:
            if self._frames and not self._bodies[name].seen:
                others = sorted(n for n, b in self._bodies.items() if b.seen)
                problems.append(
                    f"{name} is not visible. Seen are: {', '.join(others) or 'no bodies'}; names "
                    "must match the camera software's, letter by letter."
                )
        for name, body in self._bodies.items():
            if body.seen:
                problems.extend(self._judge(name, body, rate))
        axes = recognised_axes(self._at_rest())
        if axes is not None:
            problems.append(
                f"What rests here leans, and stands upright only if the stream is {axes}. If it "
                f"stands on level ground: --option axes={axes}, or stream z up from the camera "
                "software."
            )
        return CheckReport(
            self._frames,
            rate,
            jitter,
            p50,
            p99,
            status.lost + status.dropped,
            status.malformed,
            float(np.mean(self._markers)) if self._markers else 0.0,
            self._bodies,
            tuple(problems),
        )

    def _at_rest(self) -> dict[str, Pose]:
        """Bodies that have not moved lately."""
        return {
            name: body.last
            for name, body in self._bodies.items()
            if body.last is not None
            and len(body.recent) > 20
            and float(np.ptp(np.array(body.recent)[:, :3], axis=0).max()) < _REST
        }

    def _judge(self, name: str, body: BodyReport, rate: float) -> list[str]:
        limits = self.limits
        problems = []
        if body.rate < limits.min_rate <= rate:
            problems.append(
                f"{name} comes only {body.rate:.0f} times per second, others {rate:.0f} times; "
                f"vehicles fly jerkily below {limits.min_rate:.0f}."
            )
        share = body.missing / (body.seen + body.missing)
        if share > limits.max_dropout:
            problems.append(
                f"{name} is missing in {share:.1%} of the frames (longest gap "
                f"{body.longest_gap * 1e3:.0f} ms); check its markers and the camera coverage."
            )
        if body.jumps:
            problems.append(
                f"{name} jumped {body.jumps} times by more than {limits.jump * 1e2:.0f} cm; two "
                "bodies may be exchanging names, or a reflection is taken for a marker."
            )
        if body.flips:
            problems.append(
                f"{name} flipped {body.flips} times; its markers are too symmetric, move one."
            )
        recent = np.array(body.recent)
        if len(recent) > 20 and float(np.ptp(recent[:, :3], axis=0).max()) < _REST:
            noise = float(recent[:, :3].std(axis=0).max())
            if noise > limits.max_noise:
                problems.append(
                    f"{name} at rest trembles by {noise * 1e3:.1f} mm; recalibrate the cameras."
                )
            if (recent == recent[0]).all() and len(recent) >= 50:
                problems.append(
                    f"{name} has not changed by a bit in {len(recent)} frames; its pose is frozen, "
                    "not measured."
                )
        return problems


def report_lines(report: CheckReport) -> list[str]:
    """Return the report as lines of text for a terminal."""
    lines = [
        f"frames {report.frames}, rate {report.rate:.1f} Hz, jitter {report.jitter * 1e3:.2f} ms, "
        f"latency p50 {report.latency_p50 * 1e3:.1f} p99 {report.latency_p99 * 1e3:.1f} ms, "
        f"lost {report.lost}, malformed {report.malformed}, markers {report.markers:.1f}"
    ]
    for name, body in sorted(report.bodies.items()):
        total = body.seen + body.missing
        where = (
            "never seen"
            if body.last is None
            else "at " + ", ".join(f"{value:+.3f}" for value in body.last.position)
        )
        lines.append(
            f"{name}: seen {body.seen}/{total}, {body.rate:.1f} Hz, "
            f"longest gap {body.longest_gap * 1e3:.0f} ms, jumps {body.jumps}, "
            f"flips {body.flips}, {where}"
        )
    lines.extend(report.problems or ["All is well."])
    return lines
