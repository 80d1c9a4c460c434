"""The ground station dies in flight; the vehicle stops by its own watchdog."""

from __future__ import annotations

import subprocess
import sys
import textwrap

from crazyarena.sim_backend.firmware import supervisor as sv
from tests.sim_backend.crtp.virtual_process import Observer, virtual_process
from tests.waiting import eventually

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
        observer = Observer(vehicle.uris[0])
        try:
            assert ground.stdout is not None
            # It has been fed for longer than the watchdog waits, and flies.
            assert ground.stdout.readline().strip() == "flying"
            flying = observer.info()
        finally:
            ground.kill()
            ground.wait()
        assert flying & sv.INFO_FLYING
        assert flying & sv.INFO_CAN_FLY
        # A dead stream of setpoints would lock too, but there is none in a high-level flight.
        eventually(lambda: observer.info() & sv.INFO_LOCKED, 30.0)
        assert not observer.info() & sv.INFO_CAN_FLY
        observer.close()
