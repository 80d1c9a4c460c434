"""Vehicles from unlabelled markers, for arenas without rigid bodies in the vendor's software.

:class:`SingleMarkerTracker` follows one marker per vehicle: minimum-cost assignment (Kuhn 1955,
Munkres 1957; solved by :func:`scipy.optimize.linear_sum_assignment`) between predictions and
markers, with gates. :class:`ConstellationTracker` registers known marker arrangements to the
point cloud (Besl & McKay 1992) with the closed-form rotation of Kabsch (1976), and so knows
attitudes. Both say plainly when a vehicle is lost, and when it is found again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from crazyarena.errors import InputError
from crazyarena.mocap.rotations import exponential, kabsch, quaternion_of, rotate, turning
from crazyarena.mocap.tracker_kernels import greedy_match
from crazyarena.types import Pose, PoseFrame, Vector

# Indices or flags, as numpy makes them.
Selection = NDArray[Any]

# Cost of an impossible pair: finite, because the solver refuses rows of infinities.
_FORBIDDEN = 1e9


class TrackState(StrEnum):
    """State of one track."""

    WAITING = "waiting"  # not seen yet; looked for at its initial position
    TRACKED = "tracked"
    COASTING = "coasting"  # not seen in this frame; carried on by prediction
    LOST = "lost"  # not seen for too long; searched in a growing region, not reported
    TENTATIVE = "tentative"  # seen again after a loss, not yet confirmed, not reported


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Settings common to both trackers.

    Attributes
    ----------
    gate: largest distance between prediction and marker, m; while a track is not seen it
        grows with ``gate_growth`` (m/s) up to ``gate_limit`` (m).
    lost_after: time without a marker, s, after which a track is lost.
    confirm_frames: consecutive sightings that end a loss.
    marker_std: noise of a marker per axis, m. jerk: see
        :class:`~crazyarena.mocap.estimator.EstimatorConfig`.
    max_fitness: constellations: largest root-mean-square distance of matched markers, m.
    max_turn, max_tilt: constellations: largest believable turn between two frames, rad, and
        tilt, rad.
    """

    gate: float = 0.06
    gate_growth: float = 1.5
    gate_limit: float = 0.5
    lost_after: float = 0.25
    confirm_frames: int = 3
    marker_std: float = 0.001
    jerk: float = 30.0
    max_fitness: float = 0.005
    max_turn: float = 0.6
    max_tilt: float = 1.4

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"tracker {name}: found {value!r}; need a number above 0")


class _Motion:
    """Constant-acceleration Kalman filters of n points, one covariance per point."""

    def __init__(self, positions: Vector, config: TrackerConfig) -> None:
        self.config = config
        count = len(positions)
        self.state = np.zeros((count, 3, 3))  # point, derivative, axis
        self.state[:, 0] = positions
        self.covariance = np.zeros((count, 3, 3))
        for i in range(count):
            self.restart(i, positions[i])

    def restart(self, i: int, position: Vector) -> None:
        self.state[i] = 0.0
        self.state[i, 0] = position
        self.covariance[i] = np.diag([self.config.marker_std**2, 1.0, 100.0])

    def predict(self, dt: float) -> None:
        f = np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        q = self.config.jerk**2 * np.array(
            [
                [dt**5 / 20, dt**4 / 8, dt**3 / 6],
                [dt**4 / 8, dt**3 / 3, dt**2 / 2],
                [dt**3 / 6, dt**2 / 2, dt],
            ]
        )
        self.state = f @ self.state
        self.covariance = f @ self.covariance @ f.T + q

    def update(self, which: Selection, measured: Vector) -> None:
        if not len(which):
            return
        cov = self.covariance[which]
        innovation = cov[:, 0, 0] + self.config.marker_std**2
        gain = cov[:, :, 0] / innovation[:, None]
        error = measured - self.state[which, 0]
        self.state[which] += gain[:, :, None] * error[:, None, :]
        self.covariance[which] = cov - gain[:, :, None] * cov[:, 0, None, :]

    def hold(self, which: Selection) -> None:
        """Stop points whose motion nobody knows any more."""
        self.state[which, 1:] = 0.0


@dataclass(frozen=True, slots=True)
class TrackResult:
    """Outcome of one frame.

    ``poses`` of the vehicles seen in this frame (single markers have no attitude: identity);
    ``states`` of all; ``changes`` of state as (name, before, after); ``unassigned`` markers.
    """

    poses: Mapping[str, Pose]
    states: Mapping[str, TrackState]
    changes: tuple[tuple[str, TrackState, TrackState], ...]
    unassigned: Vector


class _TrackBook:
    """States, gates and sightings of all tracks."""

    def __init__(self, names: Sequence[str], config: TrackerConfig) -> None:
        self.names = tuple(names)
        self.config = config
        self.states = [TrackState.WAITING] * len(names)
        self.last_seen = np.zeros(len(names))
        self.sightings = [0] * len(names)
        self.time: float | None = None

    def advance(self, time: float) -> float:
        """Return the time since the last frame; frames must come in order."""
        dt = 0.0 if self.time is None else time - self.time
        if dt < 0 or (dt == 0 and self.time is not None):
            raise InputError(f"tracker: frame at {time} s after one at {self.time} s")
        if self.time is None:
            self.last_seen[:] = time
        self.time = time
        return dt

    def gates(self, time: float) -> Vector:
        config = self.config
        away = np.maximum(0.0, time - self.last_seen)
        # Who has not started yet stands still.
        away[[s is TrackState.WAITING for s in self.states]] = 0.0
        return np.minimum(config.gate + config.gate_growth * away, config.gate_limit)

    def settle(self, time: float, seen: Selection) -> list[tuple[str, TrackState, TrackState]]:
        """Move every track to its next state; return what changed."""
        changes = []
        for i, before in enumerate(self.states):
            after = before
            if seen[i]:
                self.sightings[i] += 1
                confirmed = self.sightings[i] >= self.config.confirm_frames
                if before is TrackState.COASTING or confirmed:
                    after = TrackState.TRACKED
                elif before in (TrackState.LOST, TrackState.WAITING):
                    after = TrackState.TENTATIVE
                self.last_seen[i] = time
            else:
                self.sightings[i] = 0
                if before is TrackState.TENTATIVE:
                    after = TrackState.LOST
                elif before in (TrackState.TRACKED, TrackState.COASTING):
                    gone = time - self.last_seen[i] > self.config.lost_after
                    after = TrackState.LOST if gone else TrackState.COASTING
            if after is not before:
                changes.append((self.names[i], before, after))
                self.states[i] = after
        return changes


class SingleMarkerTracker:
    """Follow one marker per vehicle.

    Parameters
    ----------
    initial_positions: where each vehicle stands at the start, m, by name; needed because one
        marker looks like another.
    """

    def __init__(
        self, initial_positions: Mapping[str, Vector], config: TrackerConfig | None = None
    ) -> None:
        self.config = config or TrackerConfig()
        self.names = tuple(initial_positions)
        positions = np.array([initial_positions[n] for n in self.names], dtype=float)
        positions = positions.reshape(-1, 3)
        apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        apart += np.eye(len(positions)) * 1e9
        if apart.size and apart.min() < self.config.gate:
            i, j = np.unravel_index(apart.argmin(), apart.shape)
            raise InputError(
                f"initial positions of {self.names[i]} and {self.names[j]} are "
                f"{apart.min():.3f} m apart; need more than the gate of {self.config.gate} m"
            )
        self._motion = _Motion(positions, self.config)
        self._book = _TrackBook(self.names, self.config)

    @property
    def states(self) -> dict[str, TrackState]:
        return dict(zip(self.names, self._book.states, strict=True))

    def update(self, time: float, markers: Vector) -> TrackResult:
        """Assign the markers (m, 3) of one frame; raises InputError if time does not advance."""
        book, motion = self._book, self._motion
        dt = book.advance(time)
        if dt > 0:
            motion.predict(dt)
        gates = book.gates(time)
        count = len(self.names)
        assigned = np.full(count, -1)
        cloud = np.asarray(markers, dtype=float).reshape(-1, 3)
        if count and len(cloud):
            offset = motion.state[:, 0][:, None, :] - cloud[None]
            squared = np.einsum("ijk,ijk->ij", offset, offset)
            # Distances count in units of each track's uncertainty, so a track that is sure
            # of itself does not lose its marker to one that gropes.
            spread = motion.covariance[:, 0, 0] + self.config.marker_std**2
            cost = squared / spread[:, None] + np.log(spread)[:, None]
            cost[squared > (gates * gates)[:, None]] = _FORBIDDEN
            rows, columns = linear_sum_assignment(cost)
            good = cost[rows, columns] < _FORBIDDEN
            assigned[rows[good]] = columns[good]
        seen = assigned >= 0
        found = np.flatnonzero(seen)
        for i in found.tolist():
            if book.states[i] in (TrackState.LOST, TrackState.WAITING):
                motion.restart(i, cloud[assigned[i]])
        motion.update(found, cloud[assigned[found]])
        changes = book.settle(time, seen)
        hidden = [i for i, s in enumerate(book.states) if s is TrackState.LOST and not seen[i]]
        motion.hold(np.array(hidden, dtype=int))
        poses = {
            self.names[i]: Pose(cloud[assigned[i]].copy())
            for i in found.tolist()
            if book.states[i] is TrackState.TRACKED
        }
        rest = np.ones(len(cloud), dtype=bool)
        rest[assigned[found]] = False
        return TrackResult(poses, self.states, tuple(changes), cloud[rest])


class ConstellationTracker:
    """Follow vehicles that carry known arrangements of three or more markers.

    Parameters
    ----------
    constellations: marker positions (k, 3) in the body frame, m, by vehicle.
    initial: pose near which each vehicle is first looked for; its heading may be anything.

    Raises
    ------
    InputError: fewer than three markers, markers on one line, or no initial pose.
    """

    HEADINGS = 24

    def __init__(
        self,
        constellations: Mapping[str, Vector],
        initial: Mapping[str, Pose],
        config: TrackerConfig | None = None,
    ) -> None:
        self.config = config or TrackerConfig()
        self.names = tuple(constellations)
        models = [np.asarray(constellations[n], dtype=float).reshape(-1, 3) for n in self.names]
        for name, points in zip(self.names, models, strict=True):
            if name not in initial:
                raise InputError(f"constellation of {name}: no initial pose given")
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            if len(points) < 3 or spread[1] < 5e-3:
                raise InputError(
                    f"constellation of {name}: need three markers that are not on one line"
                )
        count = len(models)
        width = max((len(m) for m in models), default=0)
        self._model = np.zeros((count, width, 3))
        self._real = np.zeros((count, width), dtype=bool)
        for i, points in enumerate(models):
            self._model[i, : len(points)] = points
            self._real[i, : len(points)] = True
        self._owner = np.repeat(np.arange(count), width)
        self._rotation = np.array(
            [rotate(initial[n].quaternion, np.eye(3)).T for n in self.names]
        ).reshape(count, 3, 3)
        positions = np.array([initial[n].position for n in self.names]).reshape(count, 3)
        self._motion = _Motion(positions, self.config)
        self._spin = np.zeros((count, 3))
        self._book = _TrackBook(self.names, self.config)

    @property
    def states(self) -> dict[str, TrackState]:
        return dict(zip(self.names, self._book.states, strict=True))

    def ambiguous(self) -> tuple[str, ...]:
        """Return the vehicles whose markers look alike after a turn about the vertical axis.

        Such arrangements flip sooner or later; move one marker.
        """
        named = []
        for i, name in enumerate(self.names):
            points = self._model[i][self._real[i]]
            centred = points - points.mean(axis=0)
            for heading in np.deg2rad(np.arange(20, 341, 5)):
                c, s = math.cos(heading), math.sin(heading)
                turned = centred @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
                apart = np.linalg.norm(turned[:, None] - centred[None], axis=2).min(axis=1)
                if math.sqrt(float((apart**2).mean())) < 2.0 * self.config.max_fitness:
                    named.append(name)
                    break
        return tuple(named)

    def _predicted(self) -> Vector:
        turned = np.einsum("bij,bkj->bki", self._rotation, self._model)
        return turned + self._motion.state[:, 0][:, None, :]

    def _register(
        self, cloud: Vector, rotation: Vector, position: Vector, which: Selection, gates: Vector
    ) -> tuple[Vector, Vector, Vector, Vector, Vector]:
        """Iterate matching and registration of the bodies ``which`` from a first guess.

        Returns rotations, positions, fitness (inf where fewer than three markers matched),
        the match (b, k) and the number of matched markers.
        """
        model = self._model[which]
        real = self._real[which]
        rotation, position = rotation.copy(), position.copy()
        match = np.full(real.shape, -1)
        fitness = np.full(len(which), np.inf)
        matched = np.zeros(len(which), dtype=int)
        for round_number in range(3):
            points = np.einsum("bij,bkj->bki", rotation, model) + position[:, None]
            # The first match bridges the error of prediction, later ones only noise.
            reach = gates if round_number == 0 else np.minimum(gates, 0.02)
            last, match = match, greedy_match(points, real, cloud, reach)
            if round_number > 0 and np.array_equal(last, match):
                break
            weight = (match >= 0).astype(float)
            matched = (match >= 0).sum(axis=1)
            enough = matched >= 3
            if not enough.any():
                break
            picked = cloud[np.maximum(match, 0)]
            new_rotation, new_position = kabsch(model[enough], picked[enough], weight[enough])
            rotation[enough] = new_rotation
            position[enough] = new_position
            rest = np.einsum("bij,bkj->bki", rotation, model) + position[:, None] - picked
            squared = np.einsum("bki,bki,bk->b", rest, rest, weight)
            fitness = np.where(enough, np.sqrt(squared / np.maximum(matched, 1)), np.inf)
        return rotation, position, fitness, match, matched

    def update(self, time: float, markers: Vector) -> TrackResult:
        """Register the markers (m, 3) of one frame; raises InputError if time stands still."""
        book, motion, config = self._book, self._motion, self.config
        dt = book.advance(time)
        cloud = np.ascontiguousarray(np.asarray(markers, dtype=float).reshape(-1, 3))
        if dt > 0:
            motion.predict(dt)
            self._rotation = self._rotation @ exponential(self._spin * dt)
        count = len(self.names)
        seen = np.zeros(count, dtype=bool)
        used = np.zeros(len(cloud), dtype=bool)
        gates = book.gates(time)
        steady = np.array(
            [
                i
                for i, s in enumerate(book.states)
                if s not in (TrackState.WAITING, TrackState.LOST)
            ],
            dtype=int,
        )
        if len(steady) and len(cloud):
            before = self._rotation[steady]
            rotation, position, fitness, match, _ = self._register(
                cloud, before, motion.state[steady, 0], steady, np.minimum(gates[steady], 0.08)
            )
            turn = turning(np.einsum("bji,bjk->bik", before, rotation))
            tilt = np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0))
            good = (fitness <= config.max_fitness) & (turn <= config.max_turn)
            good &= tilt <= config.max_tilt
            good &= np.linalg.norm(position - motion.state[steady, 0], axis=1) <= gates[steady]
            self._accept(steady[good], rotation[good], position[good], dt, seen)
            used[match[good][match[good] >= 0]] = True
        for i in range(count):
            if book.states[i] in (TrackState.WAITING, TrackState.LOST):
                self._search(i, cloud, used, float(gates[i]), seen)
        changes = book.settle(time, seen)
        for i, state in enumerate(book.states):
            if state is TrackState.LOST and not seen[i]:
                motion.hold(np.array([i]))
                self._spin[i] = 0.0
        poses = {
            self.names[i]: Pose(motion.state[i, 0].copy(), quaternion_of(self._rotation[i]))
            for i in np.flatnonzero(seen).tolist()
            if book.states[i] is TrackState.TRACKED
        }
        return TrackResult(poses, self.states, tuple(changes), cloud[~used])

    def _accept(
        self, which: Selection, rotation: Vector, position: Vector, dt: float, seen: Selection
    ) -> None:
        error = np.einsum("bji,bjk->bik", self._rotation[which], rotation)
        vector = 0.5 * np.stack(
            [
                error[:, 2, 1] - error[:, 1, 2],
                error[:, 0, 2] - error[:, 2, 0],
                error[:, 1, 0] - error[:, 0, 1],
            ],
            axis=1,
        )
        if dt > 0:
            # Half of the turn that prediction missed: markers are too noisy for more.
            self._spin[which] += 0.5 * vector / dt
        self._rotation[which] = rotation
        self._motion.update(which, position)
        seen[which] = True

    def _search(self, i: int, cloud: Vector, used: Selection, gate: float, seen: Selection) -> None:
        """Look for a vehicle of unknown heading among the markers nobody has claimed."""
        config, motion = self.config, self._motion
        free = np.flatnonzero(~used)
        reach = gate + float(np.linalg.norm(self._model[i], axis=1).max())
        near = free[np.linalg.norm(cloud[free] - motion.state[i, 0], axis=1) <= reach]
        need = max(3, int(self._real[i].sum()))
        if len(near) < need:
            return
        local = cloud[near]
        tries = self.HEADINGS
        angles = np.arange(tries) * (2.0 * math.pi / tries)
        turn = np.zeros((tries, 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angles)
        turn[:, 1, 0] = np.sin(angles)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = 1.0
        guesses = turn @ self._rotation[i]
        # With exactly its own markers nearby, their centre tells the position.
        centre = self._model[i][self._real[i]].mean(axis=0)
        start = local.mean(axis=0) if len(near) == need else motion.state[i, 0] + centre
        best = None
        for guess in guesses:
            rotation, position, fitness, match, matched = self._register(
                local, guess[None], (start - guess @ centre)[None], np.array([i]),
                np.array([min(gate + 0.03, 0.08)]),
            )  # fmt: skip
            tilt = math.acos(float(np.clip(rotation[0, 2, 2], -1.0, 1.0)))
            if matched[0] < need or tilt > config.max_tilt:
                continue
            if best is None or fitness[0] < best[0]:
                best = (fitness[0], rotation, position, match)
        if best is None or best[0] > config.max_fitness:
            return
        _, rotation, position, match = best
        motion.restart(i, position[0])
        self._spin[i] = 0.0
        self._rotation[i] = rotation[0]
        seen[i] = True
        used[near[match[0][match[0] >= 0]]] = True


def tracked_frame(frame: PoseFrame, tracker: Any) -> tuple[PoseFrame, TrackResult]:
    """Return ``frame`` with the bodies a tracker finds among its markers, and its result."""
    result = tracker.update(frame.timestamp, frame.markers)
    bodies = {**frame.bodies, **result.poses}
    return replace(frame, bodies=bodies, markers=result.unassigned), result
