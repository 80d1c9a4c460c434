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
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Observation, Point

# Bits of the firmware's ``supervisor.info``.
CAN_FLY, TUMBLED, LOCKED, CRASHED = 1 << 3, 1 << 5, 1 << 6, 1 << 7

Measure = Callable[[Observation, Fence, Limits], float | None]


class When(Enum):
    """In which part of a trial a rule holds."""

    ACTIVE = "active"
    AIRBORNE = "airborne"
    CONTESTANT = "contestant"  # active, and the contestant has the vehicle
    OVERRIDE = "override"  # airborne, and the watchdog has it


@dataclass(frozen=True, slots=True)
class Stage:
    """From ``limit`` on, lasting ``time`` s, ``action`` follows."""

    limit: float
    time: float
    action: Action


@dataclass(frozen=True, slots=True)
class Rule:
    """One monitor.

    Attributes
    ----------
    stages: of the limits in force; each is watched by itself.
    below: small values are the bad ones.
    """

    name: str
    when: When
    measure: Measure
    stages: Callable[[Limits], tuple[Stage, ...]]
    below: bool = False


@dataclass(frozen=True, slots=True)
class Finding:
    """A rule that is broken now."""

    rule: str
    action: Action
    measured: float
    limit: float


def stopping_path(obs: Observation, limits: Limits) -> tuple[Point, Point]:
    """Where the vehicle is when it begins to brake, and where it comes to rest.

    Until the command bites (``limits.reaction``) it goes on with the acceleration its attitude
    gives it, so that one who brakes already is not taken for one who runs away; then it brakes
    along its velocity with ``limits.braking``.
    """
    assert obs.position is not None
    (x, y, z), (vx, vy, vz) = obs.position, obs.velocity
    ax, ay = obs.horizontal_acceleration(limits.braking)
    t = limits.reaction
    towards_rest = -(vx * ax + vy * ay)
    if towards_rest > 0.0:
        t = min(t, towards_rest / (ax * ax + ay * ay))
    half = 0.5 * t * t
    x, y, z = x + vx * t + ax * half, y + vy * t + ay * half, z + vz * t
    vx, vy = vx + ax * t, vy + ay * t
    stop = math.sqrt(vx * vx + vy * vy + vz * vz) / (2.0 * limits.braking)
    return (x, y, z), (x + vx * stop, y + vy * stop, z + vz * stop)


def _least_on_path(
    obs: Observation, limits: Limits, fence: Fence, distance: Callable[..., float]
) -> float:
    # The ground stops a vehicle by itself, so the path is not followed below it.
    (x, y, z), (sx, sy, sz) = stopping_path(obs, limits)
    floor = fence.floor
    least = math.inf
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


def _pose_stale(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.pose_age


def _pose_jump(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.doubted


def _body_swap(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return float(obs.swapped)


def _wrong_body(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    if obs.onboard is None or obs.position is None:
        return None
    return math.dist(obs.onboard, obs.position)


def _link_lost(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.link_age


def _link_quality(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.link_quality


def _battery(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.battery


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


def _controller(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.controller_age


def _scheduler(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.lateness


def _clock(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return None if obs.clock_error is None else abs(obs.clock_error)


def _person_near(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.person_distance


def _person_inside(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.person_depth


def _strangers(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return float(obs.strangers)


def _dead_man(obs: Observation, fence: Fence, limits: Limits) -> float | None:
    return obs.dead_man_age


WARN, HOLD, LAND, CUT = Action.WARN, Action.HOLD, Action.LAND, Action.CUT

RULES: tuple[Rule, ...] = (
    # Distances beyond the hard fence, m. The second fence lies further out and cuts.
    Rule(
        "fence",
        When.AIRBORNE,
        _fence,
        lambda n: (Stage(0.0, 0.0, HOLD), Stage(n.outer_margin, 0.0, CUT)),
    ),
    Rule(
        "fence_predicted",
        When.AIRBORNE,
        _fence_predicted,
        lambda n: (Stage(n.predicted_margin, 0.0, HOLD),),
    ),
    Rule("keep_out", When.AIRBORNE, _keep_out, lambda n: (Stage(0.0, 0.0, HOLD),)),
    Rule(
        "keep_out_predicted",
        When.AIRBORNE,
        _keep_out_predicted,
        lambda n: (Stage(0.0, 0.0, HOLD),),
    ),
    Rule("people_zone", When.AIRBORNE, _people_zone, lambda n: (Stage(0.0, 0.0, CUT),)),
    Rule("speed", When.AIRBORNE, _speed, lambda n: (Stage(n.max_speed, n.speed_time, HOLD),)),
    Rule("tilt", When.AIRBORNE, _tilt, lambda n: (Stage(n.max_tilt, n.tilt_time, HOLD),)),
    Rule("tumble", When.AIRBORNE, _tilt, lambda n: (Stage(n.tumble_tilt, n.tumble_time, CUT),)),
    Rule(
        "pose_stale",
        When.ACTIVE,
        _pose_stale,
        lambda n: (
            Stage(n.pose_warn, 0.0, WARN),
            Stage(n.pose_hold, 0.0, HOLD),
            Stage(n.pose_land, 0.0, LAND),
            Stage(n.pose_cut, 0.0, CUT),
        ),
    ),
    Rule(
        "pose_jump",
        When.ACTIVE,
        _pose_jump,
        lambda n: (Stage(0.0, 0.0, WARN), Stage(n.bad_pose_time, 0.0, HOLD)),
    ),
    Rule("body_swap", When.ACTIVE, _body_swap, lambda n: (Stage(0.5, 0.0, HOLD),)),
    Rule(
        "wrong_body",
        When.AIRBORNE,
        _wrong_body,
        lambda n: (Stage(n.disagreement, n.disagreement_time, LAND),),
    ),
    Rule(
        "link_lost",
        When.ACTIVE,
        _link_lost,
        lambda n: (
            Stage(n.link_warn, 0.0, WARN),
            Stage(n.link_hold, 0.0, HOLD),
            Stage(n.link_cut, 0.0, CUT),
        ),
    ),
    Rule(
        "link_quality",
        When.ACTIVE,
        _link_quality,
        lambda n: (
            Stage(n.quality_warn, n.quality_time, WARN),
            Stage(n.quality_land, n.quality_time, LAND),
        ),
        below=True,
    ),
    Rule(
        "battery",
        When.ACTIVE,
        _battery,
        lambda n: (
            Stage(n.battery_warn, n.battery_time, WARN),
            Stage(n.battery_land, n.battery_time, LAND),
        ),
        below=True,
    ),
    Rule("supervisor", When.ACTIVE, _supervisor, lambda n: (Stage(0.5, 0.0, CUT),)),
    Rule("may_not_fly", When.AIRBORNE, _may_not_fly, lambda n: (Stage(0.5, 0.2, CUT),)),
    Rule(
        "following",
        When.CONTESTANT,
        _following,
        lambda n: (
            Stage(n.following, n.following_time, HOLD),
            Stage(n.following_land, n.following_time, LAND),
        ),
    ),
    Rule(
        "lost_control",
        When.OVERRIDE,
        _following,
        lambda n: (Stage(n.lost_control, n.lost_control_time, CUT),),
    ),
    Rule(
        "controller_silent",
        When.CONTESTANT,
        _controller,
        lambda n: (Stage(n.controller_warn, 0.0, WARN), Stage(n.controller_hold, 0.0, HOLD)),
    ),
    Rule(
        "scheduler_late",
        When.CONTESTANT,
        _scheduler,
        lambda n: (Stage(n.late_warn, 0.0, WARN), Stage(n.late_hold, 0.0, HOLD)),
    ),
    Rule("clock_jump", When.ACTIVE, _clock, lambda n: (Stage(n.clock_step, 0.0, LAND),)),
    Rule(
        "person_near",
        When.ACTIVE,
        _person_near,
        lambda n: (Stage(n.people_distance, 0.0, CUT),),
        below=True,
    ),
    Rule("person_inside", When.ACTIVE, _person_inside, lambda n: (Stage(0.0, 0.0, LAND),)),
    Rule("strangers", When.ACTIVE, _strangers, lambda n: (Stage(0.5, 0.0, WARN),)),
    Rule("dead_man", When.ACTIVE, _dead_man, lambda n: (Stage(n.dead_man, 0.0, LAND),)),
)


class Monitor:
    """One rule with its memory: since when each stage is broken."""

    __slots__ = ("_fence", "_limits", "_since", "_stages", "rule")

    def __init__(self, rule: Rule, fence: Fence, limits: Limits) -> None:
        self.rule = rule
        self._fence = fence
        self._limits = limits
        self._stages = rule.stages(limits)
        self._since: list[float | None] = [None] * len(self._stages)

    def update(self, obs: Observation, overriding: bool) -> Finding | None:
        """The strongest stage that is broken and has been for long enough, or None."""
        measured = self._measure(obs, overriding)
        worst: Finding | None = None
        for i, stage in enumerate(self._stages):
            if measured is None or (
                measured >= stage.limit if self.rule.below else measured <= stage.limit
            ):
                self._since[i] = None
                continue
            since = self._since[i]
            if since is None:
                since = self._since[i] = obs.time
            lasts = obs.time - since >= stage.time - 1e-9
            if lasts and (worst is None or stage.action > worst.action):
                worst = Finding(self.rule.name, stage.action, measured, stage.limit)
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
