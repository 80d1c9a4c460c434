"""How many vehicles a Crazyradio carries: what arrives, how old it is, and how soon a stop does.

The sender's schedule, cflib's own dongle code and the virtual Crazyradio run on simulated time, so
that the figures are those of the modelled radio and not of this computer. Traffic of one vehicle:
setpoints and poses at the rates of the row, e-stop keepalive and echoes at 10 Hz, log blocks at 20
and 10 Hz; setpoints of all vehicles come at once, as a script sends them. Twice a second, at
random, all vehicles are stopped.

Run: python benchmarks/radio_capacity.py [--counts 1 2 4 8 12] [--loss 0.02] [--driver cflib]
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import random
import struct
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import usb.core
from cflib.drivers.crazyradio import Crazyradio

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.air_queue import Share
from crazyarena.crazyswarm_compat.radio.air_schedule import AirSchedule, DongleStatistics, Turn
from crazyarena.crazyswarm_compat.radio.air_watch import AirWatch
from crazyarena.crazyswarm_compat.radio.ground_link import GroundLink, Tuning
from crazyarena.crazyswarm_compat.radio.pose_cast import Channel, Member, PoseCast
from crazyarena.sim_backend.crazyradio.air import Air, Station
from crazyarena.sim_backend.crazyradio.air_time import Rate
from crazyarena.sim_backend.crazyradio.receiver import Receiver
from crazyarena.sim_backend.crazyradio.usb_backend import VirtualUsb
from crazyarena.types import Pose

_WARM_UP = 8.0  # s, for the log rates to settle
_LIMIT = 20.0  # ms, of the 99th percentile of a stop with eight vehicles
_LOGS = (20.0, 10.0)  # Hz
_HOUSEKEEPING = 10.0  # Hz
_SETPOINT, _POSE, _PACKED, _STOP, _ECHO = b"\x7c\x06", 0x08, 0x09, b"\x9d\x03", 0xFC


class Vehicle:
    """Notes what arrives, with its age; answers echoes."""

    def __init__(self, ident: int, clock: VirtualClock, loss: float) -> None:
        self.ident = ident
        self.ages: dict[str, list[float]] = defaultdict(list)
        self.stopped: float | None = None
        self._clock = clock
        self._seen = -1
        self.receiver = Receiver(self._deliver)
        address = bytes.fromhex(f"e7e7e7e7{ident:02x}")
        self.station = Station(80, Rate.M2, address, self.receiver, loss, loss)

    def _note(self, what: str, stamp_us: int) -> None:
        self.ages[what].append(self._clock.now() - 1e-6 * stamp_us)

    def _deliver(self, packet: bytes, everybody: bool) -> bool:
        if packet[0] & 0xFC == _ECHO & 0xF0 | packet[0] & 0x0C:
            self.receiver.say(packet)
        head = bytes((packet[0] & 0xF3,)) + packet[1:2]
        if head == b"\x70\x06":
            self._note("setpoint", struct.unpack_from("<I", packet, 2)[0])
        elif head == b"\x61\x08":
            self._note("pose", round(1e6 * struct.unpack_from("<f", packet, 2)[0]))
        elif head == b"\x61\x09":
            for ident, x, y, _, _ in struct.iter_unpack("<BhhhI", packet[2:]):
                if ident == self.ident:
                    self._note("pose", 1000 * (x + 30000 * y))
        elif head == b"\x91\x03" and self.stopped is None:
            self.stopped = self._clock.now()
        return True


def _pose(now: float) -> Pose:
    """A pose whose numbers hold the time, to a millisecond when packed."""
    milli = round(1000 * now)
    return Pose(np.array([1e-3 * (milli % 30000), 1e-3 * (milli // 30000), 0.0]))


class Turns(AirSchedule):
    """cflib's own driver at its best: every link in turn, null packets included."""

    def __init__(self, clock: VirtualClock, statistics: DongleStatistics) -> None:
        super().__init__(clock, statistics)
        self._next = itertools.count()

    def choose(self, links: Any, now: float) -> Turn | float:
        link = links[next(self._next) % len(links)]
        first = link.queue.first()
        return Turn(link, Share.POLL if first is None else first[0])


class Radio:
    """One dongle, its vehicles and their traffic, on simulated time."""

    def __init__(self, count: int, loss: float, driver: str, seed: int) -> None:
        self.clock = VirtualClock()
        self.vehicles = [Vehicle(k + 1, self.clock, loss) for k in range(count)]
        air = Air([vehicle.station for vehicle in self.vehicles], seed=seed)
        device = usb.core.find(backend=VirtualUsb(air, self.clock))
        self.radio = Crazyradio(device=device)
        self.statistics = DongleStatistics()
        kind = Turns if driver == "cflib" else AirSchedule
        self.schedule = kind(self.clock, self.statistics)
        self.links = [
            GroundLink(Tuning(80, 2, tuple(vehicle.station.address)), None, None)
            for vehicle in self.vehicles
        ]
        channel = Channel(self.schedule, 80, 2)  # type: ignore[arg-type]
        channel.members += [Member(k + 1, k + 1) for k in range(count)]
        self.cast = PoseCast([channel] if driver != "cflib" else [], 1000.0)
        self.watch = AirWatch(
            self.statistics, lambda: sum(link.queue.replaced[Share.POSE] for link in self.links)
        )
        self.told: list[str] = []
        self.log_ages: list[float] = []
        self.stops: list[float] = []
        self._events: list[tuple[float, int, Callable[[float], float | None]]] = []
        self._order = itertools.count()
        self._rng = random.Random(seed)

    def at(self, time: float, action: Callable[[float], float | None]) -> None:
        """Do something; what it returns is when to do it again."""
        heapq.heappush(self._events, (time, next(self._order), action))

    def every(self, rate: float, action: Callable[[float], None], start: float = 0.0) -> None:
        def again(now: float) -> float:
            action(now)
            return now + 1.0 / rate

        self.at(start, again)

    def run(self, end: float) -> None:
        while self.clock.now() < end:
            now = self.clock.now()
            while self._events and self._events[0][0] <= now:
                time, _, action = heapq.heappop(self._events)
                again = action(time)
                if again is not None:
                    self.at(again, action)
            for verdict in self.watch.look(now):
                self.told.append(f"{verdict.what} /{verdict.divisor} {verdict.fallen:.0%}")
            turn = self.schedule.choose(self.links, now)
            if isinstance(turn, float):
                coming = self._events[0][0] if self._events else end
                self.clock.sleep_until(min(now + max(turn, 1e-5), coming))
            else:
                self.schedule.carry_out(turn, self.radio)
            self._hear()

    def _hear(self) -> None:
        for link in self.links:
            while not link.incoming.empty():
                packet = link.incoming.get()
                if packet.port == 5:
                    stamp = struct.unpack_from("<I", bytes(packet.data))[0]
                    self.log_ages.append(self.clock.now() - 1e-6 * stamp)

    # Traffic

    def setpoints(self, now: float) -> None:
        for link in self.links:
            link.queue.put(_SETPOINT + struct.pack("<I", round(1e6 * now)) + bytes(24), now)

    def poses(self, now: float) -> None:
        pose = _pose(now)
        served = self.cast.send({v.ident: pose for v in self.vehicles}, now)
        for vehicle, link in zip(self.vehicles, self.links, strict=True):
            if vehicle.ident not in served:
                exact = Pose(np.array([now, 0.0, 0.0]))
                packet = pk.external_pose(exact)
                assert packet is not None
                head = bytes((packet.port << 4 | packet.channel,))
                link.queue.put(head + packet.data, now)

    def housekeeping(self, link: GroundLink) -> Callable[[float], None]:
        def send(now: float) -> None:
            link.queue.put(b"\x9d\x04", now)
            link.queue.put(b"\xfc\xca\0\0\0\0", now)

        return send

    def logs(self, vehicle: Vehicle, rate: float) -> Callable[[float], float]:
        def say(now: float) -> float:
            stamp = struct.pack("<I", round(1e6 * now))
            vehicle.receiver.say(b"\x52" + stamp + bytes(25))
            return now + self.watch.divisor / rate

        return say

    def stop_all(self, now: float) -> float:
        if now > _WARM_UP:
            self.stops += [
                vehicle.stopped - self._asked
                for vehicle in self.vehicles
                if vehicle.stopped is not None
            ]
        self._asked = now
        for vehicle, link in zip(self.vehicles, self.links, strict=True):
            vehicle.stopped = None
            link.queue.put(_STOP, now)
        return now + self._rng.uniform(0.3, 0.7)

    _asked = 0.0


def measure(
    count: int, setpoints: float, poses: float, seconds: float, loss: float, driver: str
) -> dict[str, Any]:
    """One row of the table."""
    radio = Radio(count, loss, driver, seed=count)
    rng = random.Random(1)
    radio.every(setpoints, radio.setpoints, 0.1)
    radio.every(poses, radio.poses, 0.1 + rng.random() / poses)
    for vehicle, link in zip(radio.vehicles, radio.links, strict=True):
        radio.every(_HOUSEKEEPING, radio.housekeeping(link), 0.2 + 0.1 * rng.random())
        for rate in _LOGS:
            radio.at(0.2 + rng.random() / rate, radio.logs(vehicle, rate))
    radio.at(_WARM_UP - 0.3, radio.stop_all)
    radio.run(_WARM_UP)
    for vehicle in radio.vehicles:
        vehicle.ages.clear()
    radio.log_ages.clear()
    busy, polls = radio.statistics.busy, radio.statistics.exchanges[Share.POLL]
    radio.run(_WARM_UP + seconds)
    total = {
        what: np.concatenate([vehicle.ages[what] or [np.nan] for vehicle in radio.vehicles])
        for what in ("setpoint", "pose")
    }
    row: dict[str, Any] = {
        "vehicles": count,
        "busy": (radio.statistics.busy - busy) / seconds,
        "polls": (radio.statistics.exchanges[Share.POLL] - polls) / seconds,
        "logs": len(radio.log_ages) / seconds / count,
        "log_age": 1e3 * float(np.median(radio.log_ages)) if radio.log_ages else np.nan,
        "divisor": radio.watch.divisor,
        "told": radio.told,
    }
    for what, ages in total.items():
        row[f"{what}_rate"] = len(ages) / seconds / count
        row[f"{what}_p50"], row[f"{what}_p99"] = 1e3 * np.percentile(ages, (50, 99))
    row["stop_p50"], row["stop_p99"] = 1e3 * np.percentile(radio.stops, (50, 99))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 4, 8, 12])
    parser.add_argument("--setpoints", type=float, nargs="+", default=[30.0, 50.0])
    parser.add_argument("--poses", type=float, nargs="+", default=[30.0, 60.0, 100.0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--loss", type=float, default=0.0, help="share of frames, each way")
    parser.add_argument("--driver", choices=("scheduled", "cflib"), default="scheduled")
    options = parser.parse_args()
    print(
        "| vehicles | setpoints Hz | arrive Hz | age p50/p99 ms | poses Hz | arrive Hz | "
        "age p50/p99 ms | logs Hz | age ms | stop p50/p99 ms |"
    )
    print("|" + "---|" * 10)
    for count, setpoints, poses in itertools.product(
        options.counts, options.setpoints, options.poses
    ):
        row = measure(count, setpoints, poses, options.seconds, options.loss, options.driver)
        print(
            f"| {count} | {setpoints:g} | {row['setpoint_rate']:.1f} | {row['setpoint_p50']:.1f} / "
            f"{row['setpoint_p99']:.1f} | {poses:g} | {row['pose_rate']:.1f} | "
            f"{row['pose_p50']:.1f} / {row['pose_p99']:.1f} | {row['logs']:.1f} | "
            f"{row['log_age']:.0f} | {row['stop_p50']:.1f} / {row['stop_p99']:.1f} |",
            flush=True,
        )
        if count == 8 and options.driver == "scheduled" and row["stop_p99"] >= _LIMIT:
            print(f"  ! stop p99 is {row['stop_p99']:.1f} ms; the limit is {_LIMIT:g} ms")


if __name__ == "__main__":
    main()
