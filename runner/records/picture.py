"""What is drawn of an episode, made where it was flown.

The process that draws it loads arrays and words alone: what judges and measures would take it
longer to load than a picture to draw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.records.ground import Ground
from crazyarena.runner.records.marks import Mark, marks
from crazyarena.sim_backend.trace import TR_POS, TR_SETPOINT, TR_TIME, TR_VEL

if TYPE_CHECKING:
    from crazyarena.levels.schema import Arena

Array = NDArray[np.float64]

_MOST_ROWS = 2500  # of a path: more than a picture has points


class Outcome(Protocol):
    """What a picture takes from the result of an episode, of any contract."""

    index: int
    termination: str
    flight_time: float
    gates_passed: int
    gates: int
    gate_times: list[float]
    files: dict[str, str]
    why: str

    @property
    def clean(self) -> bool:
        """Nothing is to be said against it."""

    @property
    def events(self) -> Sequence[Any]:
        """With ``name``, ``time`` and ``detail``."""


@dataclass
class Opening:
    """Of a gate, when it was ``passed``, s, or where the way came nearest: heights in m."""

    when: float
    low: float
    high: float
    gate: str
    passed: bool


@dataclass
class Margin:
    """Distance ``far`` (k,) m to the nearest ``kind`` of thing over ``time`` (k,) s; the nearest
    of all is ``name``."""

    kind: str
    name: str
    time: Array
    far: Array


@dataclass
class Picture:
    """What is drawn of an episode; plain enough to be handed to another process.

    time (n,) s, position, velocity and setpoint (n, 3), SI; setpoint is NaN before the first
    command. openings: of gates, by time; the last one may be that of the gate not passed. ended:
    the run, s; then the way home.
    """

    ground: Ground
    title: str
    time: Array
    position: Array
    velocity: Array
    setpoint: Array
    gate_times: Sequence[float] = ()
    openings: Sequence[Opening] = ()
    margins: Sequence[Margin] = ()
    marks: list[Mark] = field(default_factory=list)
    ended: float = math.inf


def picture(
    ground: Ground,
    result: Outcome,
    states: Array,
    *,
    entities: list[dict[str, Any]] | None = None,
    commanded_from: float = -math.inf,
    isolated: bool = False,
) -> Picture:
    """What to draw of an episode just flown.

    Parameters
    ----------
    states: (n, TRACE_SIZE) ticks of the episode.
    entities: the same track, solid by solid.
    commanded_from: s, when the first command went out; no setpoint is shown before.
    isolated: the contestant could not reach its judge; if not, the picture says so.
    """
    step = max(1, len(states) // _MOST_ROWS)
    kept = np.concatenate([states[:-1:step], states[-1:]])
    time = np.array(kept[:, TR_TIME])
    setpoint = np.array(kept[:, TR_SETPOINT : TR_SETPOINT + 3])
    # Beyond the run the crew brings the vehicle home, by commands of its own.
    setpoint[(time < commanded_from) | (time > result.flight_time + 0.1)] = np.nan
    title = (
        f"{ground.name}, episode {result.index}: {result.why or result.termination}\n"
        f"{result.flight_time:.2f} s, {result.gates_passed}/{result.gates} gates"
        + ("" if isolated else " (not isolated)")
    )
    passed = [event.detail for event in result.events if event.name == "gate passed"]
    if len(passed) != len(result.gate_times):
        passed = [f"gate {i}" for i in range(len(result.gate_times))]
    following = ground.order[len(passed) :][:1]
    position = np.array(kept[:, TR_POS : TR_POS + 3])
    return Picture(
        replace(ground, arena=None),
        title,
        time,
        position,
        np.array(kept[:, TR_VEL : TR_VEL + 3]),
        setpoint,
        list(result.gate_times),
        _openings(time, position, result.gate_times, passed, following, entities or []),
        _margins(time, position, ground.arena, entities or []),
        marks(result.events),
        result.flight_time,
    )


def _openings(
    time: Array,
    position: Array,
    times: Sequence[float],
    passed: Sequence[str],
    following: Sequence[int],
    entities: list[dict[str, Any]],
) -> list[Opening]:
    from crazyarena.runner.records.bodies import gate_openings

    if not len(time):
        return []
    holes = gate_openings(entities)

    def hole(when: float, gate: str, through: bool) -> Opening:
        centre, half = holes[gate]
        low, high = float(centre[2]) - half, float(centre[2]) + half
        return Opening(when, low, high, gate, through)

    found = [
        hole(when, gate, True) for when, gate in zip(times, passed, strict=True) if gate in holes
    ]
    for gate in (f"gate {number}" for number in following):
        if gate in holes:
            after = times[-1] if times else -1.0
            away = np.linalg.norm(position - holes[gate][0], axis=1)
            away[(time < after) | ~np.isfinite(away)] = np.inf
            found.append(hole(float(time[int(np.argmin(away))]), gate, False))
    return found


def _margins(
    time: Array, position: Array, arena: Arena | None, entities: list[dict[str, Any]]
) -> list[Margin]:
    from crazyarena.runner.records.bodies import distances

    finite = np.isfinite(position).all(axis=1)
    time, path = time[finite], position[finite]
    if not len(time):
        return []
    found = []
    every = distances(path, entities)
    for kind in ("gate", "obstacle"):
        mine = {name: far for name, far in every.items() if name.startswith(kind)}
        if mine:
            far = np.stack(list(mine.values()))
            which = np.unravel_index(int(np.argmin(far)), far.shape)
            found.append(Margin(kind, list(mine)[int(which[0])], time, far.min(axis=0)))
    if arena is not None:
        from crazyarena.safety.fence import Fence

        fence = Fence.from_arena(arena)
        few = np.unique(np.linspace(0, len(time) - 1, min(len(time), 300)).astype(int))
        room = np.array([fence.room(*path[i].tolist()) for i in few])
        found.append(Margin("limits", "limits", time[few], room))
    return found
