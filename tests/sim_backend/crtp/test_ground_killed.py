"""The ground station dies in flight; the vehicle stops by its own watchdog."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time

from crazyarena.sim_backend.firmware import supervisor as sv
from tests.sim_backend.crtp.virtual_process import Observer, virtual_process

# A ground station made of public cflib calls: takes off, then feeds the watchdog at 10 Hz.
_GROUND = textwrap.dedent(
    """
    import sys, time
    import cflib.crtp
    from cflib.crazyflie import Crazyflie
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    cflib.crtp.init_drivers()
    with SyncCrazyflie(sys.argv[1], cf=Crazyflie()) as connection:
        cf = connection.cf
        cf.supervisor.send_emergency_stop_watchdog()
        cf.commander.send_notify_setpoint_stop()
        cf.high_level_commander.takeoff(0.5, 1.5)
        for k in range(600):
            cf.supervisor.send_emergency_stop_watchdog()
            if k == 25:
                print("flying", flush=True)
            time.sleep(0.1)
    """
)


def test_sigkill_of_the_ground_station_stops_the_motors() -> None:
    with virtual_process("--port", "0", "--feed-poses", "100") as vehicle:
        ground = subprocess.Popen(
            [sys.executable, "-c", _GROUND, vehicle.uris[0]], stdout=subprocess.PIPE, text=True
        )
        try:
            assert ground.stdout is not None
            assert ground.stdout.readline().strip() == "flying"
        finally:
            killed = time.monotonic()
            ground.kill()
            ground.wait()
        observer = Observer(vehicle.uris[0])
        assert observer.info() & sv.INFO_FLYING
        seen: list[tuple[float, int]] = []
        while time.monotonic() - killed < 10.0:
            seen.append((time.monotonic() - killed, observer.info()))
            if seen[-1][1] & sv.INFO_LOCKED:
                break
            time.sleep(0.01)
        observer.close()
    locked_after, info = seen[-1]
    assert info & sv.INFO_LOCKED
    assert not info & sv.INFO_CAN_FLY
    # 1000 ms after the last feed, which was at most some 100 ms before the kill: not at once. A
    # dead stream of setpoints would lock too, but there is none in a high-level flight.
    assert any(after > 0.3 and bits & sv.INFO_FLYING for after, bits in seen)
    assert 0.5 < locked_after < 5.0
