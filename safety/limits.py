"""Every threshold of the watchdog and the command gate, with its reason."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace

from crazyarena.errors import InputError
from crazyarena.safety.flight_model import FlightModel

_SAGGING = 0.15  # V between the warning about a weak battery and its landing


@dataclass(frozen=True, slots=True)
class Limits:
    """Thresholds in SI units; ``*_time`` are how long something must last before it counts.

    Attributes
    ----------
    vehicle: how the vehicle follows what it is told (safety/flight_model.py); what is marked (v)
        below is what :meth:`for_vehicle` makes of it.
    braking: (v) deceleration, m/s2, that the vehicle is trusted with: 6 with the Mellinger
        controller, 3.5 with the cascaded PID controller, which limits its speed rather than
        following a plan; less with motors that have less.
    reaction: (v) time, s, until a command to brake has become deceleration: cameras, radio, and
        the attitude the vehicle has to take first.
    predicted_margin: m beyond the hard fence up to which the predicted end of a stop is let
        pass: the prediction brakes later and more gently than the watchdog does, and a goal close
        to the fence is approached with little to spare.
    outer_margin: m beyond the hard fence at which motors are cut (the second fence).
    max_speed: m/s, of the vehicle; the gate lets setpoints ask for ``setpoint_speed``.
    max_tilt, tumble_tilt: rad.
    pose_warn, pose_hold, pose_land, pose_cut: age of the last good pose, s.
    camera_rate: Hz, that cameras must deliver: at a tenth of a second from frame to frame nobody
        sees in time. Fewer are a warning in flight, and keep vehicles on the ground.
    bad_pose_time: how long the cameras may deliver poses that are not believed, s.
    disagreement: m between cameras and the vehicle's own estimate.
    link_warn, link_hold, link_cut: silence of the vehicle, s.
    quality_warn, quality_land: share of acknowledged packets.
    battery_warn, battery_land: (v) V, under load; higher for motors that need more to lift it.
    following, following_land: m between the vehicle and what it was told.
    lost_control: the same while the watchdog flies; then motors are cut.
    controller_warn, controller_hold: s since the contestant's last answer; setpoints that stay
        away longer than 0.5 s would make the firmware level out.
    late_warn, late_hold: lateness of a control step, s.
    turn_warn: rad that a rigid body may be turned against its vehicle (safety/heading.py), for
        turn_time s.
    turn_cut: the same at which motors are cut: hold and land need the heading.
    yaw_warn, yaw_cut: rad by which cameras and gyroscope may come apart in yaw.
    nudge: m, by which a vehicle that takes off is moved to and fro, to see how its body is turned
        (safety/nudge.py); 0 for not at all.
    clock_step: s, between two clocks that should run alike.
    neighbour_warn, neighbour_hold: m between the centres of two vehicles in the air.
    people_distance: m between a vehicle and a person, horizontally, at which motors are cut.
    dead_man: s since the operator last held the key.
    hold_time: s, from HOLD to LAND.
    land_time: s, within which a landing must be over.
    inside: m, how far inside the fence the watchdog holds and lands.
    return_speed, descent: m/s, of the watchdog's own flight; blind_descent without poses.
    setpoint_speed, setpoint_acceleration: m/s, m/s2 (v), what the gate lets pass.
    setpoint_step: m, by which one streamed position may differ from the last beyond what speed
        allows; setpoint_lead: m, by which it may be away from the vehicle. Further away, and the
        firmware's position loop tips the vehicle over.
    setpoint_tilt, setpoint_thrust, setpoint_yaw_rate: of attitude setpoints: rad from upright,
        share of full thrust, rad/s.
    allow_attitude: attitude setpoints are let through at all; no fence can clamp them.
    thrust_to_weight: what full thrust is to an attitude setpoint.
    attitude_reaction: s for which a vehicle flown by attitude goes on as it was told, before a
        command to brake has turned it round.
    attitude_loss_margin: m beyond the hard fence up to which a vehicle flown by attitude may come
        down if the link is lost. It brakes for nobody then, so that what state setpoints keep to
        (``link_loss_margin``) would leave no room to fly in. inf lets everything pass.
    tune_in_flight: gains, masses and limits of the controllers may be written in flight, within
        a range around their boot values; else they are closed.
    command_rate, command_burst: commands per second, and how many at once.
    link_loss_margin: m beyond the hard fence up to which a vehicle may come down that hears
        nothing more after a setpoint; setpoints that would carry it further are held back. inf
        lets them pass, for arenas with room behind the fence.
    link_delay: s, from a pose to the setpoint that was checked with it taking effect.
    """

    braking: float = 6.0
    reaction: float = 0.15
    predicted_margin: float = 0.05
    outer_margin: float = 0.5
    max_speed: float = 3.5
    speed_time: float = 0.1
    max_tilt: float = 1.2
    tilt_time: float = 0.15
    tumble_tilt: float = 1.75
    tumble_time: float = 0.05
    pose_warn: float = 0.08
    pose_hold: float = 0.15
    pose_land: float = 0.5
    pose_cut: float = 3.5
    camera_rate: float = 30.0
    camera_rate_time: float = 0.5
    bad_pose_time: float = 0.1
    disagreement: float = 0.4
    disagreement_time: float = 0.2
    link_warn: float = 0.3
    link_hold: float = 0.5
    link_cut: float = 1.0
    quality_warn: float = 0.7
    quality_land: float = 0.3
    quality_time: float = 1.0
    battery_warn: float = 3.2
    battery_land: float = 3.0
    battery_time: float = 1.0
    following: float = 0.5
    following_time: float = 0.3
    following_land: float = 1.0
    lost_control: float = 0.6
    lost_control_time: float = 0.5
    controller_warn: float = 0.15
    controller_hold: float = 0.4
    late_warn: float = 0.03
    late_hold: float = 0.25
    turn_warn: float = 0.26
    turn_time: float = 0.3
    turn_cut: float = 0.52
    yaw_warn: float = 0.25
    yaw_cut: float = 0.5
    nudge: float = 0.06
    clock_step: float = 0.05
    neighbour_warn: float = 0.3
    neighbour_hold: float = 0.2
    people_distance: float = 1.0
    dead_man: float = 0.5
    hold_time: float = 1.0
    land_time: float = 8.0
    inside: float = 0.2
    return_speed: float = 0.5
    descent: float = 0.5
    blind_descent: float = 0.8
    setpoint_speed: float = 3.0
    setpoint_acceleration: float = 12.0
    setpoint_step: float = 0.25
    setpoint_lead: float = 0.6
    setpoint_tilt: float = 0.6
    setpoint_thrust: float = 1.0
    setpoint_yaw_rate: float = 6.0
    allow_attitude: bool = False
    tune_in_flight: bool = False
    command_rate: float = 200.0
    command_burst: float = 60.0
    link_loss_margin: float = 0.05
    link_delay: float = 0.05
    vehicle: FlightModel = field(default_factory=FlightModel)
    thrust_to_weight: float = 2.0
    attitude_reaction: float = 0.2
    attitude_loss_margin: float = 2.0

    def __post_init__(self) -> None:
        for name in LIMIT_NAMES:
            value = getattr(self, name)
            if isinstance(value, bool):
                continue
            endless = name.endswith("loss_margin") and value == math.inf
            none = name == "nudge" and value == 0.0
            if not (endless or none or (math.isfinite(value) and value > 0.0)):
                raise InputError(f"safety limit {name}: found {value!r}; need a number > 0")
        self._ordered("pose_warn", "pose_hold", "pose_land", "pose_cut")
        self._ordered("link_warn", "link_hold", "link_cut")
        self._ordered("controller_warn", "controller_hold")
        self._ordered("late_warn", "late_hold")
        self._ordered("neighbour_hold", "neighbour_warn")
        self._ordered("quality_land", "quality_warn")
        self._ordered("battery_land", "battery_warn")
        self._ordered("following", "following_land")
        self._ordered("max_tilt", "tumble_tilt")
        self._ordered("turn_warn", "turn_cut")
        self._ordered("yaw_warn", "yaw_cut")
        self._ordered("setpoint_speed", "max_speed")

    def for_vehicle(self, vehicle: FlightModel, keep: Collection[str] = ()) -> Limits:
        """These limits for another vehicle; ``keep`` names those that somebody has set."""
        standard = Limits()
        braking = self.braking if "braking" in keep else vehicle.braking
        land = max(standard.battery_land, vehicle.spent)
        derived = {
            "braking": braking,
            # Never below the standard: what is better than that has not been flown.
            "reaction": max(standard.reaction, self.link_delay + vehicle.response(braking)),
            "setpoint_acceleration": min(
                standard.setpoint_acceleration, max(vehicle.strongest, braking)
            ),
            "battery_land": land,
            "battery_warn": max(standard.battery_warn, land + _SAGGING),
        }
        own = {name: value for name, value in derived.items() if name not in keep}
        return replace(self, vehicle=vehicle, **own)  # type: ignore[arg-type]

    def _ordered(self, *names: str) -> None:
        values = [getattr(self, name) for name in names]
        if any(a >= b for a, b in itertools.pairwise(values)):
            raise InputError(
                f"safety limits {', '.join(names)}: found {values}; each must be above the one "
                "before it"
            )


LIMIT_NAMES = tuple(f.name for f in fields(Limits) if f.name != "vehicle")
"""Fields that are thresholds, to be set one by one."""
