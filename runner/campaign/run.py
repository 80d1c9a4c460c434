"""Fly the fault campaign in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.campaign.faults import ALL_FAULTS
from crazyarena.runner.campaign.flight import Flight
from crazyarena.runner.campaign.outcome import Outcome
from crazyarena.sim_backend.vehicles import VehicleChoice


def fly(
    fault: str, seed: int, level: str = "level0", vehicle: VehicleChoice | None = None
) -> Outcome:
    """One flight of the campaign."""
    return Flight(fault, seed, load_level(level), vehicle=vehicle).run()


def _fly_job(job: tuple[str, int, str, VehicleChoice | None]) -> Outcome:
    return fly(*job)


def run_campaign(
    faults: Iterable[str],
    seeds: int,
    level: str = "level0",
    workers: int = 1,
    on_flight: Callable[[Outcome], None] | None = None,
    vehicle: VehicleChoice | None = None,
) -> list[Outcome]:
    """Every fault with every seed, by ``vehicle`` or the default one.

    Raises
    ------
    InputError: an unknown fault, level or vehicle.
    """
    names = list(faults)
    for name in names:
        if name not in ALL_FAULTS:
            raise InputError(f"fault {name!r}: choose from {', '.join(ALL_FAULTS)}")
    jobs = [(name, seed, level, vehicle) for name in names for seed in range(seeds)]
    outcomes = []
    if workers <= 1:
        for job in jobs:
            outcomes.append(_fly_job(job))
            if on_flight is not None:
                on_flight(outcomes[-1])
        return outcomes
    with ProcessPoolExecutor(workers) as pool:
        for outcome in pool.map(_fly_job, jobs, chunksize=4):
            outcomes.append(outcome)
            if on_flight is not None:
                on_flight(outcome)
    return outcomes
