"""The faults of the campaign, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from crazyarena.runner.campaign.strikes import cameras, contestant, radio, station, vehicle
from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.safety.limits import Limits


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of trouble; ``strike`` sets it in motion.

    ``physical`` faults (a motor, the wind) throw the vehicle out of what any software controls and
    are not held to the fence as the rest is; ``link`` faults leave it to its own firmware.
    """

    strike: Callable[[Struck], None]
    physical: bool = False
    link: bool = False
    limits: Limits = field(default_factory=Limits)

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
