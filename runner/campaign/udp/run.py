"""The fault campaign over the virtual radio: the stack of the arena, in real time.

Of each flight: a process with vehicle, radio and cameras (:mod:`.udp.field`), and the ground
station (:mod:`.udp.station`), which flies it as ``crazyarena fly`` does: with a flight process
of its own, cflib, cameras over zenoh, watchdog thread and command gate. What became of the
vehicle is told by the former, who knows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from crazyarena.errors import BackendError, InputError
from crazyarena.levels import dump_level, load_level
from crazyarena.mocap.stamps import host_time
from crazyarena.runner.campaign.faults import FAULTS
from crazyarena.runner.campaign.outcome import Outcome
from crazyarena.runner.campaign.plan import draw_plan
from crazyarena.runner.campaign.setting import LAND_TIME, MISSION, PATIENCE
from crazyarena.runner.campaign.udp import field as field_process
from crazyarena.runner.campaign.udp import station as station_process
from crazyarena.runner.campaign.udp.json_child import JsonChild, Message
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.sim_backend.vehicles import VehicleChoice

KILLED = "killed_process"
UDP_FAULTS = tuple(
    name
    for name in FAULTS
    if name == KILLED or name in field_process.STRIKES or name in station_process.STRIKES
)
_START_TIMEOUT = 300.0  # s; the first run compiles
_LEAD = 0.3  # s, for word of the take-off to get around
_GRACE = 25.0  # s


def fly(
    fault: str,
    seed: int,
    level: str = "level0",
    radio: bool = False,
    vehicle: VehicleChoice | None = None,
) -> Outcome:
    """One flight, in real time; ``radio`` over a virtual Crazyradio instead of UDP.

    Raises
    ------
    InputError: an unknown fault, level or vehicle.
    BackendError: vehicle or ground station do not come up.
    """
    check_faults([fault])
    vehicle = vehicle or VehicleChoice()
    plan = draw_plan(fault, seed, vehicle)
    place = [round(float(value), 4) for value in plan.start]
    empty = ["track.gates=[]", "track.obstacles=[]", f"start.position={place}"]
    with TemporaryDirectory(prefix="campaign-") as name:
        folder = Path(name)
        level_file = folder / "level.yaml"
        level_file.write_text(dump_level(load_level(level, empty)))
        config = {
            "fault": fault,
            "seed": seed,
            "level_file": str(level_file),
            "radio": radio,
            "vehicle": [vehicle.name, list(vehicle.overrides)],
        }
        with (
            JsonChild(field_process.__name__, config, folder / "field.log") as field,
            JsonChild(station_process.__name__, config, folder / "station.log") as station,
        ):
            station.tell(field.take(_START_TIMEOUT))
            station.take(_START_TIMEOUT)
            start = host_time() + _LEAD
            for child in (field, station):
                child.tell({"go": start})
            if fault == KILLED:
                time.sleep(max(0.0, start + plan.onset - host_time()))
                station.kill()
            report = field.take(_LEAD + MISSION + LAND_TIME + PATIENCE + _GRACE)
            told: list[Message] = []
            if fault != KILLED:
                station.tell({"end": True})
                told = station.take(_GRACE)["events"]
    return outcome_of(fault, seed, plan.onset, report, told)


def outcome_of(
    fault: str, seed: int, onset: float, report: Message, told: list[Message]
) -> Outcome:
    """Put together what the field reports and the events the ground station told of."""
    events = [_event(event) for event in told]
    action = max((event.action for event in events), default=Action.NONE)
    taken = [event.rule for event in events if event.action.takes_over]
    safe_after = report["safe_after"]
    end = "flying"
    if safe_after is not None:
        end = "cut" if action is Action.CUT or report["locked"] else "landed"
    return Outcome(
        fault,
        seed,
        report["excursion"],
        math.inf if safe_after is None else safe_after,
        end,
        int(action),
        taken[0] if taken else "",
        report["speed"],
        onset,
        events,
    )


def _event(told: Message) -> SafetyEvent:
    actions = {name: Action(told[name]) for name in ("severity", "action")}
    return SafetyEvent(**{**told, **actions})


def check_faults(names: Iterable[str]) -> None:
    """Raise InputError for a fault that is not flown over UDP."""
    for name in names:
        if name not in UDP_FAULTS:
            raise InputError(f"fault {name!r} over UDP: choose from {', '.join(UDP_FAULTS)}")


def run_campaign(
    faults: Iterable[str],
    seeds: int,
    level: str = "level0",
    workers: int = 2,
    on_flight: Callable[[Outcome], None] | None = None,
    radio: bool = False,
    vehicle: VehicleChoice | None = None,
) -> list[Outcome]:
    """Every fault with every seed, ``workers`` flights side by side; the rest as for :func:`fly`.

    Raises
    ------
    InputError: an unknown fault, level or vehicle.
    BackendError: a flight did not come about.
    """
    names = list(faults)
    check_faults(names)
    jobs = [(name, seed) for name in names for seed in range(seeds)]
    outcomes = []
    pool = ThreadPoolExecutor(max(1, workers), thread_name_prefix="flight")
    try:
        flights = [(job, pool.submit(fly, *job, level, radio, vehicle)) for job in jobs]
        for (name, seed), flight in flights:
            try:
                outcomes.append(flight.result())
            except BackendError as error:
                raise BackendError(f"{name}, seed {seed}: {error}") from None
            if on_flight is not None:
                on_flight(outcomes[-1])
    finally:
        pool.shutdown(cancel_futures=True)
    return outcomes
