"""The faults of the campaign, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from crazyarena.runner.campaign.strikes import (
    attitude,
    cameras,
    contestant,
    radio,
    station,
    vehicle,
)
from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.safety.limits import Limits


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of trouble; ``strike`` sets it in motion.

    ``physical`` faults (a motor, the wind) throw the vehicle out of what any software controls and
    are not held to the fence as the rest is; ``link`` faults leave it to its own firmware.
    ``attitude``: the contestant flies by attitude. ``beyond``: m beyond the fence that the limits
    let a vehicle come down, more than usual. ``early``: it may set in from the take-off on.
    """

    strike: Callable[[Struck], None]
    physical: bool = False
    link: bool = False
    limits: Limits = field(default_factory=Limits)
    attitude: bool = False
    beyond: float = 0.0
    early: bool = False

    @property
    def kind(self) -> str:
        """``physical``, ``link`` or ``software``."""
        return "physical" if self.physical else "link" if self.link else "software"


FAULTS: dict[str, Fault] = {
    "mocap_dropout": Fault(cameras.dropout),
    "mocap_freeze": Fault(cameras.freeze),
    "mocap_hiccup": Fault(cameras.hiccup),
    "mocap_jump": Fault(cameras.jump),
    "identity_swap": Fault(cameras.swap),
    "latency_growth": Fault(cameras.latency),
    "radio_loss": Fault(radio.loss),
    "radio_burst": Fault(radio.burst, link=True),
    "radio_cut": Fault(radio.cut, link=True),
    "radio_cut_at_wall": Fault(radio.cut_at_wall, link=True),
    "outside": Fault(contestant.outside),
    "straight_up": Fault(contestant.up),
    "wall": Fault(contestant.wall),
    "wall_velocity": Fault(contestant.wall_velocity),
    "position_step": Fault(contestant.position_step),
    "tilt": Fault(
        contestant.tilt, limits=Limits(allow_attitude=True, max_speed=2.3, setpoint_speed=2.0)
    ),
    "nan": Fault(contestant.nan),
    "silent": Fault(contestant.silent),
    "stuck": Fault(contestant.stuck),
    "oscillating": Fault(contestant.oscillating),
    "battery_sag": Fault(vehicle.battery),
    "motor_failure": Fault(vehicle.motor, physical=True),
    "wind_gust": Fault(vehicle.gust, physical=True),
    "late_scheduler": Fault(station.late),
    "killed_process": Fault(station.killed, link=True),
}

# What full thrust is to its weight is told by the plan of a flight, which knows the vehicle.
_BY_ATTITUDE = Limits(allow_attitude=True, setpoint_tilt=0.9)


def _flown_by_attitude(
    strike: Callable[[Struck], None], *, physical: bool = False, link: bool = False,
    early: bool = False,
) -> Fault:  # fmt: skip
    # What loses the link leaves a vehicle that brakes for nobody.
    beyond = _BY_ATTITUDE.attitude_loss_margin if link else 0.0
    return Fault(strike, physical, link, _BY_ATTITUDE, True, beyond, early)


ATTITUDE_FAULTS: dict[str, Fault] = {
    f"attitude_{name}": fault
    for name, fault in {
        "mocap_dropout": _flown_by_attitude(cameras.dropout),
        "mocap_freeze": _flown_by_attitude(cameras.freeze),
        "mocap_hiccup": _flown_by_attitude(cameras.hiccup),
        "mocap_jump": _flown_by_attitude(cameras.jump),
        "latency_growth": _flown_by_attitude(cameras.latency),
        "radio_loss": _flown_by_attitude(radio.loss),
        "radio_burst": _flown_by_attitude(radio.burst, link=True),
        "radio_cut": _flown_by_attitude(radio.cut, link=True),
        "silent": _flown_by_attitude(contestant.silent),
        "nan": _flown_by_attitude(contestant.nan),
        "tilted": _flown_by_attitude(attitude.tilted),
        "up": _flown_by_attitude(attitude.up),
        "fall": _flown_by_attitude(attitude.fall),
        "spin": _flown_by_attitude(attitude.spin),
        "flip": _flown_by_attitude(attitude.flip),
        "hostile": _flown_by_attitude(attitude.hostile, early=True),
        "battery_sag": _flown_by_attitude(vehicle.battery),
        "motor_failure": _flown_by_attitude(vehicle.motor, physical=True),
        "wind_gust": _flown_by_attitude(vehicle.gust, physical=True),
        "late_scheduler": _flown_by_attitude(station.late),
        "killed_process": _flown_by_attitude(station.killed, link=True),
    }.items()
}
"""Those of contestants that fly by attitude; in virtual time only."""
ALL_FAULTS = {**FAULTS, **ATTITUDE_FAULTS}
