"""Settings of the whole suite."""

import signal
from pathlib import Path

import pytest
from hypothesis import settings

# The first call of a compiled kernel compiles it, so no example may be held to a deadline.
settings.register_profile("crazyarena", deadline=None)
settings.load_profile("crazyarena")

_TESTS = Path(__file__).parent
# Tests that fly or talk in wall time. They assert what happens, not how fast; but a machine that
# stalls for seconds makes the vehicle under test do what it should on a lost link.
_REALTIME = (
    "crazyswarm_compat/radio",
    "mocap/test_arena.py",
    "mocap/test_links.py",
    "runner/flight_process/test_disturbed.py",
    "runner/flight_process/test_rig.py",
    "runner/test_bench.py",
    "runner/test_mocap_commands.py",
    "runner/test_preflight.py",
    "runner/test_stops.py",
    "runner/test_stops_in_flight.py",
    "safety/test_estop.py",
    "safety/test_estop_over_udp.py",
    "safety/test_watchdog.py",
    "sim_backend/crtp/test_cflib.py",
    "sim_backend/crtp/test_ground_killed.py",
    "sim_backend/crtp/test_server.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Begin with Python's own Ctrl-C: shells start what runs in the background without one."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the folders and files above, and give them two more tries."""
    for item in items:
        place = item.path.relative_to(_TESTS).as_posix()
        if place.startswith(_REALTIME):
            item.add_marker(pytest.mark.realtime)
            item.add_marker(pytest.mark.flaky(reruns=2))
