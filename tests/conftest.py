"""Settings of the whole suite."""

import re
import signal
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadFileScheduling

# The first call of a compiled kernel compiles it, and a busy machine is slow: no example may be
# held to a deadline, nor their making.
settings.register_profile("crazyarena", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("crazyarena")

# Tests that fly or talk in wall time. They assert what happens, not how fast; but a machine that
# stalls for seconds makes the vehicle under test do what it should on a lost link.
_REALTIME = (
    "crazyswarm_compat/radio/test_exit.py",
    "crazyswarm_compat/radio/test_flight.py",
    "crazyswarm_compat/radio/test_hardware_doc.py",
    "crazyswarm_compat/radio/test_link.py",
    "crazyswarm_compat/radio/test_over_radio.py",
    "crazyswarm_compat/radio/test_preflight.py",
    "crazyswarm_compat/radio/test_script_report.py",
    "crazyswarm_compat/radio/test_slow_links.py",
    "crazyswarm_compat/test_official_examples.py",
    "crazyswarm_compat/test_scripts_as_they_are.py",
    "mocap/test_arena.py",
    "mocap/test_links.py",
    "mocap/test_natnet.py",
    "mocap/test_ros2.py",
    "mocap/test_vrpn.py",
    "mocap/test_zenoh_trust.py",
    "runner/cli/test_mocap_commands.py",
    "runner/rig/flight_process/test_disturbed.py",
    "runner/rig/flight_process/test_rig.py",
    "runner/rig/test_stops.py",
    "runner/test_bench.py",
    "runner/trial/test_preflight.py",
    "runner/trial/test_stops_in_flight.py",
    "safety/test_estop.py",
    "safety/test_estop_over_udp.py",
    "safety/test_estop_socket.py",
    "safety/test_watchdog.py",
    "sim_backend/crazyradio/",
    "sim_backend/crazyradio/test_cflib.py",
    "sim_backend/crazyradio/test_safe_link.py",
    "sim_backend/crtp/test_cflib.py",
    "sim_backend/crtp/test_ground_killed.py",
    "sim_backend/crtp/test_server.py",
)


def _is_realtime(nodeid: str) -> bool:
    return nodeid.removeprefix("tests/").startswith(_REALTIME)


class _Folders(LoadFileScheduling):
    """Spreads files over processes, but of a folder's wall-time tests one runs at a time.

    They wait more than they compute: others find room beside them, too many make them late.
    """

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return f"realtime {Path(file).parts[1]}" if _is_realtime(file) else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> _Folders:
    """Schedule ``pytest -n``."""
    return _Folders(config, log)


@pytest.fixture
def tmp_path(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """As pytest's, with a short name: sockets are made in it, and their paths end at 107 bytes."""
    return tmp_path_factory.mktemp(re.sub(r"\W", "_", request.node.name.removeprefix("test_"))[:10])


def pytest_configure(config: pytest.Config) -> None:
    """Begin with Python's own Ctrl-C: shells start what runs in the background without one.
    Keep the order of the tests when they are spread."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of the files above, and give all that are marked so two more tries. They
    come first: a queue of them that begins late is waited for by idle processors.

    With ``-p no:rerunfailures`` they get none, which shows who needs them.
    """
    items.sort(key=lambda item: not _is_realtime(item.nodeid))
    retried = config.pluginmanager.hasplugin("rerunfailures")
    for item in items:
        if _is_realtime(item.nodeid):
            item.add_marker(pytest.mark.realtime)
        if retried and item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.flaky(reruns=2))
