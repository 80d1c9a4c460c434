"""The rules: what is measured, from where on it matters and for how long, and what follows.

Pure: a monitor knows nothing but the observations it is given and when it was given them. A
measurement that is not a number breaks every limit of its rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from crazyarena.safety.events import Action
from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import GRAVITY
from crazyarena.safety.lasting import Lasting
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import LAG, Observation
from crazyarena.safety.stopping import pushed_path, stopping_path

# Bits of the firmware's ``supervisor.info``.
CAN_FLY, TUMBLED, LOCKED, CRASHED = 1 << 3, 1 << 5, 1 << 6, 1 << 7

_FRICTION = 5.0  # m/s2, with which what has fallen slides to rest

Measure = Callable[[Observation, Fence, Limits], float | None]


class When(Enum):
    """In which part of a trial a rule holds."""

    ACTIVE = "active"
    AIRBORNE = "airborne"
    CONTESTANT = "contestant"  # active, and the contestant has the vehicle
    OVERRIDE = "override"  # airborne, and the watchdog has it


@dataclass(frozen=True, slots=True)
class Stage:
    """From ``limit`` on, lasting ``time`` s, ``action`` follows.

    Both are numbers, or names of fields of :class:`Limits`.
    """

    limit: float | str
    action: Action
    time: float | str = 0.0


@dataclass(frozen=True, slots=True)
class Rule:
    """One monitor.

    Attributes
    ----------
    stages: each is watched by itself.
    below: small values are the bad ones.
    tell: what else there is to say about it.
    """

    name: str
    when: When
    measure: Measure
    stages: tuple[Stage, ...]
    below: bool = False
    tell: Callable[[Observation], str] | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """A rule that is broken now; ``detail`` is for people."""

    rule: str
    action: Action
    measured: float
    limit: float
    detail: str = ""


def _number(value: float | str, limits: Limits) -> float:
    return float(getattr(limits, value)) if isinstance(value, str) else value


def _told(name: str) -> Measure:
    """What somebody has told, as it is: a field of the observation."""

    def measure(obs: Observation, fence: Fence, limits: Limits) -> float | None:
        value = getattr(obs, name)
        return None if value is None else float(value)

    return measure


def _least_on_path(
    obs: Observation, limits: Limits, fence: Fence, distance: Callable[..., float]
) -> float:
    # The ground stops a vehicle by itself, so the path is not followed below it.
    paths = [stopping_path(obs, limits)]
    if obs.pushed is not None:
        paths.append(pushed_path(obs, obs.pushed, limits))
    floor = fence.floor
    least = math.inf
    for (x, y, z), (sx, sy, sz) in paths:
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            height = max(z + share * (sz - z), floor)
            room = distance(x + share * (sx - x), y + share * (sy - y), height)
            if not room >= least:
                least = room
    return least


def _fence(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return None if obs.position is None else -fence.clearance(*obs.position)


def _fence_predicted(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.position is None:
        return None
    return -_least_on_path(obs, limits, fence, fence.clearance)


def _adrift(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    """m beyond the fence where a vehicle that does not know where it is comes to lie, cut now."""
    if obs.position is None or obs.onboard is None:
        return None
    if math.dist(obs.position, obs.onboard) <= limits.disagreement:
        return None
    (x, y, z), (vx, vy, vz) = obs.position, obs.velocity
    height = max(z - fence.floor, 0.0)
    time = (vz + math.sqrt(vz * vz + 2.0 * GRAVITY * height)) / GRAVITY
    time += math.hypot(vx, vy) / (2.0 * _FRICTION)  # of sliding on, with half the speed on average
    return -fence.clearance(x + time * vx, y + time * vy, fence.floor)


def _keep_out(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.position is None or not fence.zones:
        return None
    return -fence.zone_distance(*obs.position)


def _keep_out_predicted(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.position is None or not fence.zones:
        return None
    return -_least_on_path(obs, limits, fence, fence.zone_distance)


def _people_zone(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.position is None or not fence.people_zones:
        return None
    return max(-zone.distance(*obs.position) for zone in fence.people_zones)


def _speed(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return None if obs.position is None else math.hypot(*obs.velocity)


def _tilt(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.position is None:
        return None
    upright = obs.upright
    return math.acos(min(max(upright, -1.0), 1.0)) if math.isfinite(upright) else math.nan


def _wrong_body(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.onboard is None or obs.position is None:
        return None
    return math.dist(obs.onboard, obs.position)


def _supervisor(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.supervisor is None:
        return None
    return float(bool(obs.supervisor & (TUMBLED | LOCKED | CRASHED)))


def _may_not_fly(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return None if obs.supervisor is None else float(not obs.supervisor & CAN_FLY)


def _following(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    position = obs.flown_from(limits.disagreement)
    if obs.setpoint is None or position is None:
        return None
    return math.dist(obs.setpoint, position)


def _not_followed(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    """m from the setpoint, but for what the vehicle is behind because it was told no speed."""
    position = obs.flown_from(limits.disagreement)
    if obs.setpoint is None or position is None:
        return None
    way = [LAG * (v - told) for v, told in zip(obs.velocity, obs.setpoint_velocity, strict=True)]
    ahead = [s - p for s, p in zip(obs.setpoint, position, strict=True)]
    length = sum(w * w for w in way)
    along = sum(w * a for w, a in zip(way, ahead, strict=True))
    share = min(max(along / length, 0.0), 1.0) if length > 1e-9 else 0.0
    return math.hypot(*(a - share * w for w, a in zip(way, ahead, strict=True)))


def _clock(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return None if obs.clock_error is None else abs(obs.clock_error)


# Shares of an angle that must be beyond its own uncertainty to be believed.
WARN_SURELY, CUT_SURELY = 0.4, 0.7


def _turned(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    # Nothing is in danger yet: it is told once it can be told how far.
    if obs.turned is not None and not obs.turned.known:
        return 0.0
    return _at_least(obs, WARN_SURELY * limits.turn_warn)


def _turned_far(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return _at_least(obs, CUT_SURELY * limits.turn_cut)


def _at_least(obs: Observation, surely: float) -> float | None:
    turned = obs.turned
    if turned is None:
        return None
    return abs(turned.angle) if turned.surely >= surely else 0.0


def _yaw_apart(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return None if obs.turned is None else abs(obs.turned.yaw)


def _how_turned(obs: Observation) -> str:
    return "" if obs.turned is None else obs.turned.remedy


WARN, HOLD, LAND, CUT = Action.WARN, Action.HOLD, Action.LAND, Action.CUT

RULES: tuple[Rule, ...] = (
    # Distances beyond the hard fence, m. The second fence lies further out and cuts.
    Rule(
        "fence",
        When.AIRBORNE,
        _fence,
        (Stage(0.0, HOLD), Stage("outer_margin", CUT)),
    ),
    Rule(
        "fence_predicted",
        When.AIRBORNE,
        _fence_predicted,
        (Stage("predicted_margin", HOLD),),
    ),
    # It flies to where it takes itself to be, and nobody can land it inside.
    Rule("adrift", When.OVERRIDE, _adrift, (Stage(0.0, CUT, 0.05),)),
    Rule("keep_out", When.AIRBORNE, _keep_out, (Stage(0.0, HOLD),)),
    Rule(
        "keep_out_predicted",
        When.AIRBORNE,
        _keep_out_predicted,
        (Stage(0.0, HOLD),),
    ),
    Rule("people_zone", When.AIRBORNE, _people_zone, (Stage(0.0, CUT),)),
    Rule(
        "neighbour",
        When.AIRBORNE,
        _told("neighbour"),
        (Stage("neighbour_warn", WARN), Stage("neighbour_hold", HOLD)),
        below=True,
    ),
    Rule(
        "neighbour_predicted",
        When.AIRBORNE,
        _told("neighbour_predicted"),
        (Stage("neighbour_hold", HOLD),),
        below=True,
    ),
    Rule("speed", When.AIRBORNE, _speed, (Stage("max_speed", HOLD, "speed_time"),)),
    Rule("tilt", When.AIRBORNE, _tilt, (Stage("max_tilt", HOLD, "tilt_time"),)),
    Rule("tumble", When.AIRBORNE, _tilt, (Stage("tumble_tilt", CUT, "tumble_time"),)),
    Rule(
        "pose_stale",
        When.ACTIVE,
        _told("pose_age"),
        (
            Stage("pose_warn", WARN),
            Stage("pose_hold", HOLD),
            Stage("pose_land", LAND),
            Stage("pose_cut", CUT),
        ),
    ),
    Rule(
        "pose_jump",
        When.ACTIVE,
        _told("doubted"),
        (Stage(0.0, WARN), Stage("bad_pose_time", HOLD)),
    ),
    Rule(
        "camera_rate",
        When.ACTIVE,
        _told("camera_rate"),
        (Stage("camera_rate", WARN, "camera_rate_time"),),
        below=True,
    ),
    Rule("body_swap", When.ACTIVE, _told("swapped"), (Stage(0.5, HOLD),)),
    Rule(
        "wrong_body",
        When.AIRBORNE,
        _wrong_body,
        (Stage("disagreement", LAND, "disagreement_time"),),
    ),
    Rule(
        "link_lost",
        When.ACTIVE,
        _told("link_age"),
        (
            Stage("link_warn", WARN),
            Stage("link_hold", HOLD),
            Stage("link_cut", CUT),
        ),
    ),
    Rule(
        "link_quality",
        When.ACTIVE,
        _told("link_quality"),
        (
            Stage("quality_warn", WARN, "quality_time"),
            Stage("quality_land", LAND, "quality_time"),
        ),
        below=True,
    ),
    Rule(
        "battery",
        When.ACTIVE,
        _told("battery"),
        (
            Stage("battery_warn", WARN, "battery_time"),
            Stage("battery_land", LAND, "battery_time"),
        ),
        below=True,
    ),
    Rule("supervisor", When.ACTIVE, _supervisor, (Stage(0.5, CUT),)),
    Rule("may_not_fly", When.AIRBORNE, _may_not_fly, (Stage(0.5, CUT, 0.2),)),
    Rule(
        "following",
        When.CONTESTANT,
        _not_followed,
        (
            Stage("following", HOLD, "following_time"),
            Stage("following_land", LAND, "following_time"),
        ),
    ),
    Rule(
        "lost_control",
        When.OVERRIDE,
        _following,
        (Stage("lost_control", CUT, "lost_control_time"),),
    ),
    Rule(
        "controller_silent",
        When.CONTESTANT,
        _told("controller_age"),
        (Stage("controller_warn", WARN), Stage("controller_hold", HOLD)),
    ),
    Rule(
        "scheduler_late",
        When.CONTESTANT,
        _told("lateness"),
        (Stage("late_warn", WARN), Stage("late_hold", HOLD)),
    ),
    # While the vehicle still stands there is nothing to see, and once it has left the ground there
    # is little time.
    Rule(
        "body_turned",
        When.ACTIVE,
        _turned,
        (Stage("turn_warn", WARN, "turn_time"),),
        tell=_how_turned,
    ),
    Rule("body_turned_far", When.ACTIVE, _turned_far, (Stage("turn_cut", CUT),), tell=_how_turned),
    Rule(
        "yaw_apart",
        When.ACTIVE,
        _yaw_apart,
        (Stage("yaw_warn", WARN), Stage("yaw_cut", CUT)),
        tell=_how_turned,
    ),
    Rule("clock_jump", When.ACTIVE, _clock, (Stage("clock_step", LAND),)),
    Rule(
        "person_near",
        When.ACTIVE,
        _told("person_distance"),
        (Stage("people_distance", CUT),),
        below=True,
    ),
    Rule("person_inside", When.ACTIVE, _told("person_depth"), (Stage(0.0, LAND),)),
    Rule("strangers", When.ACTIVE, _told("strangers"), (Stage(0.5, WARN),)),
    Rule("dead_man", When.ACTIVE, _told("dead_man_age"), (Stage("dead_man", LAND),)),
)


class Monitor:
    """One rule with its memory: since when each stage is broken."""

    __slots__ = ("_fence", "_limits", "_stages", "rule")

    def __init__(self, rule: Rule, fence: Fence, limits: Limits) -> None:
        self.rule = rule
        self._fence = fence
        self._limits = limits
        self._stages = tuple(
            (_number(stage.limit, limits), _number(stage.time, limits), stage.action, Lasting())
            for stage in rule.stages
        )

    def update(self, obs: Observation, overriding: bool) -> Finding | None:
        """The strongest stage that is broken and has been for long enough, or None."""
        measured = self._measure(obs, overriding)
        worst: Finding | None = None
        for limit, time, action, lasting in self._stages:
            good = measured is None or (measured >= limit if self.rule.below else measured <= limit)
            held = lasting.update(not good, obs.time)
            if held is None or held < time - 1e-9 or measured is None:
                continue
            if worst is None or action > worst.action:
                detail = "" if self.rule.tell is None else self.rule.tell(obs)
                worst = Finding(self.rule.name, action, measured, limit, detail)
        return worst

    def _measure(self, obs: Observation, overriding: bool) -> float | None:
        when = self.rule.when
        if when is When.AIRBORNE:
            holds = obs.airborne
        elif when is When.ACTIVE:
            holds = obs.active
        elif when is When.CONTESTANT:
            holds = obs.active and not overriding
        else:
            holds = obs.airborne and overriding
        return self.rule.measure(obs, self._fence, self._limits) if holds else None
