"""The checklist before a flight: each line green or red, red ones with a remedy.

Checks are functions of a :class:`Preflight` that gathers what they need; what cannot be known
is red, not green. A red line grounds the flight unless it is waived by name, and the waiver
stays in the record.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import InputError
from crazyarena.levels import Level
from crazyarena.mocap.axes import recognised_axes
from crazyarena.mocap.estimator import BodyEstimate, Freshness
from crazyarena.mocap.survey import misplaced
from crazyarena.plain_text import shown_line
from crazyarena.safety.axes import explain_axes
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import ModelFacts
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import CAN_FLY, CRASHED, LOCKED, TUMBLED
from crazyarena.safety.placement import allowed, nominal_track
from crazyarena.safety.tipping import tilt, yaw
from crazyarena.types import Pose, Telemetry

_LEANS = math.radians(15.0)
_CAN_ARM, _ARMED = 1 << 0, 1 << 1
# m that gates may be off before other axes are looked for that put them right.
_ELSEWHERE = 0.3


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the checklist.

    ``found`` says what was measured, ``remedy`` what to do about a red line; ``checked`` is False
    for what cannot be known as it is flown, which ``found`` then says.
    """

    name: str
    ok: bool
    found: str
    remedy: str = ""
    waived: bool = False
    checked: bool = True

    @property
    def grounds(self) -> bool:
        """Whether this line keeps the vehicle on the ground."""
        return not self.ok and not self.waived


@dataclass(frozen=True, slots=True)
class Tolerances:
    """What is still green. SI units.

    Attributes
    ----------
    battery: V, at rest.
    turned: rad, between the noses of a vehicle and its body.
    position, yaw: between the cameras and the vehicle's own estimate, m and rad.
    spread: m, of the vehicle's estimate over the last samples.
    height: m, of a standing vehicle over the level's start.
    camera_rate: Hz, at least.
    disk: bytes free. timer: s, latest wake-up of a short sleep.
    hover: m, by which it may hover away from its setpoint. lift: all the motors' thrust over its
        weight, at least.
    test_age: s, since the emergency stop was last tried. body_age: s, since a vehicle was tipped.
    """

    battery: float = 3.9
    position: float = 0.05
    yaw: float = math.radians(10.0)
    turned: float = math.radians(10.0)
    spread: float = 0.01
    height: float = 0.05
    camera_rate: float = Limits().camera_rate
    disk: int = 500_000_000
    timer: float = 0.002
    hover: float = 0.05
    lift: float = 1.1
    test_age: float = 3600.0
    body_age: float = 8 * 3600.0


@dataclass(slots=True)
class VehicleFacts:
    """What is known of one vehicle; None is unknown.

    Attributes
    ----------
    own: the vehicle's position estimates of the last seconds, newest last.
    controller: parameter ``stabilizer.controller``.
    tipped: the body that was tipped when this vehicle was, now or lately, see
        :func:`~crazyarena.safety.tipping.tipped_body`.
    turned: rad by which that body's nose lies to the left of the vehicle's, see
        :func:`~crazyarena.safety.tipping.nose_between`.
    model: None if nobody said which vehicle it is.
    """

    name: str
    body: str
    telemetry: Telemetry | None = None
    seen: BodyEstimate | None = None
    own: Sequence[np.ndarray] = ()
    controller: int | None = None
    tipped: str | None = None
    turned: float | None = None
    model: ModelFacts | None = None


@dataclass(slots=True)
class Preflight:
    """Everything the checklist looks at.

    Attributes
    ----------
    gates: surveyed poses of the gates by index; empty if they were not surveyed.
    bodies: all bodies the cameras see; known: names that belong there.
    camera_rate: Hz, of the cameras' frames; None if nobody counted.
    controller: what ``stabilizer.controller`` must be (2 Mellinger, 1 PID).
    out: folder recordings go to.
    machine_checks, vehicle_checks: what is looked at.
    poses: where bodies are seen now, by name. landmarks: where some should be, if not as the
        level says.
    """

    level: Level
    vehicles: Sequence[VehicleFacts]
    gates: Mapping[int, Pose] = field(default_factory=dict)
    bodies: Sequence[str] = ()
    known: Sequence[str] = ()
    controller: int = 2
    camera_rate: float | None = None
    estop: EmergencyStop | None = None
    out: Path = Path(".")
    clock: Clock = field(default_factory=WallClock)
    tolerances: Tolerances = field(default_factory=Tolerances)
    machine_checks: Sequence[Callable[[Preflight], list[Line]]] = field(
        default_factory=lambda: MACHINE_CHECKS
    )
    vehicle_checks: Sequence[Callable[[Preflight, VehicleFacts], list[Line]]] = field(
        default_factory=lambda: VEHICLE_CHECKS
    )
    poses: Mapping[str, Pose] = field(default_factory=dict)
    landmarks: Mapping[str, Pose] | None = None

    def run(self, waive: Iterable[str] = ()) -> list[Line]:
        """All lines, in order.

        Raises
        ------
        InputError: a waiver for a line that does not exist.
        """
        lines = [line for check in self.machine_checks for line in check(self)]
        for vehicle in self.vehicles:
            lines += [line for check in self.vehicle_checks for line in check(self, vehicle)]
        waived = set(waive)
        unknown = waived - {line.name for line in lines}
        if unknown:
            raise InputError(
                f"cannot waive {', '.join(sorted(unknown))}: no such line; there are "
                f"{', '.join(line.name for line in lines)}"
            )
        return [
            Line(line.name, line.ok, line.found, line.remedy, True)
            if line.name in waived and not line.ok
            else line
            for line in lines
        ]


def may_fly(lines: Iterable[Line]) -> bool:
    """No line is red without a waiver."""
    return not any(line.grounds for line in lines)


# The machine and the arena


def _fence(p: Preflight) -> list[Line]:
    try:
        Fence.from_level(p.level)
    except InputError as error:
        return [Line("fence", False, str(error), "correct arena in the level file")]
    return [Line("fence", True, f"{p.level.name}: {p.level.arena.low} .. {p.level.arena.high}")]


def _named(p: Preflight) -> list[Line]:
    names = ", ".join(vehicle.name for vehicle in p.vehicles)
    return [
        Line("vehicles", bool(names), names or "none named", "name them: --uri cf1=radio://...")
    ]


def check_gates(p: Preflight) -> list[Line]:
    wanted = p.level.track.gates
    missing = [index for index in range(len(wanted)) if index not in p.gates]
    remedy = "survey the gates, or correct their poses in the level file"
    still = [i for i, gate in enumerate(wanted) if not gate.tracked and i in p.gates]
    axes = explain_axes(
        np.array([[*p.gates[i].position[:2], 0.0] for i in still]).reshape(-1, 3),
        np.array([[wanted[i].x, wanted[i].y, 0.0] for i in still]).reshape(-1, 3),
        _ELSEWHERE,
    )
    if axes is not None:
        remedy = f"{axes}; correct its world frame"
    if missing:
        return [Line("gates", False, f"gates {missing} not surveyed", remedy)]
    nominal, rules = nominal_track(p.level), allowed(p.level)
    bad = []
    for index, gate in enumerate(wanted):
        if gate.tracked:
            continue  # it moves; that it is seen is all that can be asked of it
        name = f"gate{index + 1}"
        wrong = misplaced(p.gates[index], nominal[name], rules[name], height=False)
        if wrong is not None:
            bad.append(f"gate {index} {wrong}")
    for name, rule in rules.items():
        if name in p.poses and not name.startswith("gate"):
            wrong = misplaced(p.poses[name], nominal[name], rule, height=False)
            if wrong is not None:
                bad.append(f"{name} {wrong}")
    return [Line("gates", not bad, "; ".join(bad) or f"{len(wanted)} surveyed", remedy)]


def check_axes(p: Preflight) -> list[Line]:
    """Whether the cameras' world is ours, from what stands where it should and upright."""
    track = p.level.track
    nominal = nominal_track(p.level) if p.landmarks is None else p.landmarks
    places = {name: pose.position for name, pose in nominal.items()}
    if len(p.vehicles) == 1:
        places[p.vehicles[0].body] = np.array(p.level.start.position, dtype=float)
    for i in track.tracked:
        places.pop(f"gate{i + 1}", None)
    standing = {name: pose for name, pose in p.poses.items() if name in places}
    if not standing:
        return []
    axes = recognised_axes(standing, places)
    found = "z up, as they should be" if axes is None else f"the stream is {axes}, ours is z-up"
    remedy = "--mocap-option axes=y-up, or stream z up from the camera software"
    return [Line("world axes", axes is None, found, remedy)]


def check_strangers(p: Preflight) -> list[Line]:
    vehicles = [vehicle.body for vehicle in p.vehicles]
    unknown = sorted(set(p.bodies) - set(p.known) - set(vehicles))
    found = ", ".join(map(shown_line, unknown)) if unknown else f"{len(p.bodies)} bodies, all known"
    return [Line("arena clear", not unknown, found, "take them out of the arena, or name them")]


def check_cameras(p: Preflight) -> list[Line]:
    if p.camera_rate is None:
        return []  # that they are silent, the vehicles' lines say
    least = p.tolerances.camera_rate
    found = f"{p.camera_rate:.0f} frames a second"
    remedy = f"let the cameras deliver {least:g} or more, and nothing else use their network"
    return [Line("camera rate", p.camera_rate >= least, found, remedy)]


def check_disk(p: Preflight) -> list[Line]:
    folder = p.out
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    found = f"{free / 1e9:.1f} GB free for recordings"
    return [Line("disk", free >= p.tolerances.disk, found, f"make room on {folder.resolve()}")]


def _governor(p: Preflight, root: Path = Path("/sys/devices/system/cpu")) -> list[Line]:
    governors = {f.read_text().strip() for f in root.glob("cpu*/cpufreq/scaling_governor")}
    slow = governors - {"performance"}
    found = ", ".join(sorted(governors)) or "not scaled by this system"
    return [Line("cpu governor", not slow, found, "sudo cpupower frequency-set -g performance")]


def _timer(p: Preflight) -> list[Line]:
    late = []
    for _ in range(50):
        late.append(p.clock.sleep_until(p.clock.now() + 0.002))
    worst = max(late)
    return [
        Line(
            "timer",
            worst <= p.tolerances.timer,
            f"short sleeps end up to {worst * 1e3:.2f} ms late",
            "close other programs; allow real-time scheduling (ulimit -r)",
        )
    ]


def _real_time(p: Preflight) -> list[Line]:
    allowed = os.geteuid() == 0
    try:
        import resource

        allowed = allowed or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] != 0
    except (ImportError, AttributeError, OSError, ValueError):
        pass
    return [
        Line(
            "real-time scheduling",
            allowed,
            "allowed" if allowed else "not allowed",
            "add 'rtprio 60' for your user to /etc/security/limits.conf",
        )
    ]


def check_estop(p: Preflight) -> list[Line]:
    remedy = (
        "crazyarena estop --test in another shell, or press the button, while crazyarena "
        "preflight runs"
    )
    if p.estop is None:
        return [Line("e-stop tested", False, "no emergency stop in this session", remedy)]
    tested = p.estop.last_test
    if tested is None:
        return [Line("e-stop tested", False, "not tried in this session", remedy)]
    age = p.clock.now() - tested
    found = f"{age:.0f} s ago"
    return [Line("e-stop tested", age <= p.tolerances.test_age, found, remedy)]


# Each vehicle


def check_connected(p: Preflight, v: VehicleFacts) -> list[Line]:
    t = v.telemetry
    age = math.inf if t is None else p.clock.now() - t.timestamp
    found = f"heard {age:.1f} s ago" if math.isfinite(age) else "never heard"
    return [Line(f"{v.name} connected", age <= 1.0, found, "switch it on; check URI and channel")]


def check_state(p: Preflight, v: VehicleFacts) -> list[Line]:
    bits = None if v.telemetry is None else v.telemetry.supervisor
    name = f"{v.name} state"
    if bits is None:
        return [Line(name, False, "unknown", "wait for telemetry; update the firmware")]
    wrong = [
        word
        for bit, word in ((TUMBLED, "tumbled"), (LOCKED, "locked"), (CRASHED, "crashed"))
        if bits & bit
    ]
    if wrong:
        return [Line(name, False, ", ".join(wrong), "put it upright and restart it")]
    ready = bool(bits & (_ARMED | _CAN_ARM | CAN_FLY))
    found = "armed" if bits & _ARMED else "can be armed" if ready else "can neither arm nor fly"
    return [Line(name, ready, found, "restart it, standing still and level")]


def check_battery(p: Preflight, v: VehicleFacts) -> list[Line]:
    volts = None if v.telemetry is None else v.telemetry.battery
    found = "unknown" if volts is None else f"{volts:.2f} V"
    ok = volts is not None and volts >= p.tolerances.battery
    remedy = f"charge or change it: {p.tolerances.battery:g} V or more at rest"
    return [Line(f"{v.name} battery", ok, found, remedy)]


def check_estimate(p: Preflight, v: VehicleFacts) -> list[Line]:
    t = p.tolerances
    names = (f"{v.name} estimator", f"{v.name} agrees with cameras")
    if len(v.own) < 2:
        remedy = "wait for telemetry of the vehicle's estimate"
        return [Line(name, False, "unknown", remedy) for name in names]
    samples = np.array(v.own)
    spread = float(np.ptp(samples, axis=0).max())
    lines = [
        Line(
            names[0],
            spread <= t.spread,
            f"wanders by {spread * 1e3:.0f} mm",
            "reset the estimator (kalman.resetEstimation); check that poses arrive",
        )
    ]
    state = None if v.telemetry is None else v.telemetry.state
    remedy = "check the body's orientation and name, and the world frame of the cameras"
    if v.seen is None or v.seen.freshness is not Freshness.FRESH or state is None:
        return [*lines, Line(names[1], False, "cameras do not see it now", remedy)]
    off = float(np.linalg.norm(state.position - v.seen.state.position))
    turn = abs(math.remainder(yaw(state.quaternion) - yaw(v.seen.state.quaternion), math.tau))
    found = f"{off * 1e3:.0f} mm, {math.degrees(turn):.1f} deg apart"
    return [*lines, Line(names[1], off <= t.position and turn <= t.yaw, found, remedy)]


def check_controller(p: Preflight, v: VehicleFacts) -> list[Line]:
    found = "unknown" if v.controller is None else str(v.controller)
    remedy = f"set stabilizer.controller to {p.controller}"
    return [Line(f"{v.name} controller", v.controller == p.controller, found, remedy)]


def check_model(p: Preflight, v: VehicleFacts) -> list[Line]:
    """Whether a vehicle such as its file says can fly, and at the height it is told."""
    if v.model is None:
        return []
    flies, t = v.model.flies, p.tolerances
    where = "below" if flies.low > 0.0 else "above"
    found = (
        f"{v.model.name}: lifts {flies.lift:.2f} times its weight, hovers "
        f"{100.0 * abs(flies.low):.0f} cm {where} its setpoint"
    )
    remedy = (
        f"set ctrlMel.mass to {v.model.mass:.4f} or ctrlMel.massThrust to "
        f"{v.model.mass_thrust:.0f}, in firmware.params of the vehicle's file"
    )
    if flies.lift < t.lift:
        remedy = "make it lighter, or change motors, propellers or battery"
    good = flies.lift >= t.lift and abs(flies.low) <= t.hover
    return [Line(f"{v.name} model", good, found, remedy)]


def check_body(p: Preflight, v: VehicleFacts) -> list[Line]:
    found = "not tried" if v.tipped is None else f"body {v.tipped} was tipped with it"
    if v.tipped is None:
        remedy = "crazyarena preflight --tip, and tip it by hand"
    else:
        remedy = f"give the vehicle the name {v.tipped}, or exchange the markers"
    return [Line(f"{v.name} is body {v.body}", v.tipped == v.body, found, remedy)]


def check_heading(p: Preflight, v: VehicleFacts) -> list[Line]:
    if v.turned is None:
        # It was not tipped: the line before says so, and grounds.
        return [Line(f"{v.name} heading", True, "not measured; tip it by hand")]
    degrees = math.degrees(v.turned)
    remedy = (
        f"turn the axes of body {v.body} by {-degrees:+.0f} deg about z in the motion-capture "
        "software, so that its x axis is the vehicle's nose"
    )
    found = f"the body's nose is {degrees:+.0f} deg from the vehicle's"
    return [Line(f"{v.name} heading", abs(v.turned) <= p.tolerances.turned, found, remedy)]


def check_start(p: Preflight, v: VehicleFacts) -> list[Line]:
    name = f"{v.name} at start"
    remedy = "put it on the start position"
    if v.seen is None or v.seen.freshness not in (Freshness.FRESH, Freshness.BRIDGED):
        return [Line(name, False, "cameras do not see it", remedy)]
    x, y, z = v.seen.state.position.tolist()
    sx, sy, sz = p.level.start.position
    off = math.hypot(x - sx, y - sy)
    ok = off <= p.level.start.tolerance and abs(z - sz) <= p.tolerances.height
    axes = explain_axes((x, y, z), (sx, sy, sz), p.level.start.tolerance)
    if axes is not None:
        remedy = f"{remedy}; or {axes}: correct its world frame"
    if tilt(v.seen.state.quaternion) > _LEANS:
        # It stands, so the cameras' z axis is not up, or the body's is not the vehicle's.
        ok = False
        degrees = math.degrees(tilt(v.seen.state.quaternion))
        remedy = (
            f"the cameras see it lean by {degrees:.0f} deg: correct their z axis, or the body's"
        )
    return [Line(name, ok, f"{off:.2f} m off, {z - sz:+.2f} m in height", remedy)]


MACHINE_CHECKS: tuple[Callable[[Preflight], list[Line]], ...] = (
    _named,
    _fence,
    check_gates,
    check_axes,
    check_strangers,
    check_cameras,
    check_disk,
    _governor,
    _timer,
    _real_time,
    check_estop,
)
VEHICLE_CHECKS: tuple[Callable[[Preflight, VehicleFacts], list[Line]], ...] = (
    check_connected,
    check_state,
    check_battery,
    check_estimate,
    check_controller,
    check_model,
    check_body,
    check_heading,
    check_start,
)
