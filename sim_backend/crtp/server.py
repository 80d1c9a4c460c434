"""Virtual Crazyflies in wall time, each behind a UDP port or a radio."""

from __future__ import annotations

import math
import selectors
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import InputError
from crazyarena.mocap.serve import Outlet
from crazyarena.sim_backend.crtp.faults import Faults
from crazyarena.sim_backend.crtp.film import PushedCameras
from crazyarena.sim_backend.crtp.link import BASE_PORT, UdpLink
from crazyarena.sim_backend.crtp.packets import EVERYBODY
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm

_WAKE_MS = 4  # between wake-ups when nothing arrives
_STALL_MS = 50  # behind wall time by more than this is worth counting
_BEHIND_MS = 500  # behind by more than this, whoever flies should hear of it,
_BEHIND_PAUSE = 5.0  # s, but not all the time
_SLICE_MS = 100  # caught up at a time, between looks at the sockets
_PER_MS = 10  # vehicles for each millisecond that a packet may be taken for earlier than it is


@dataclass(slots=True)
class Pace:
    """How the simulation kept up with wall time.

    ticks: simulated, ms; wakes: passes of the loop; stalls: times it had fallen behind by more
    than 50 ms; worst: the most it had fallen behind, ms. Nothing is ever skipped.
    """

    ticks: int = 0
    wakes: int = 0
    stalls: int = 0
    worst: int = 0


class Carrier(Protocol):
    """One direction of a link."""

    def due(self) -> float:
        """When the next packet under way arrives, s; inf if none."""
        ...


class Link(Protocol):
    """One vehicle's link to the ground; :class:`.link.UdpLink` says what each does."""

    faults: Faults

    @property
    def uri(self) -> str: ...

    @property
    def uplink(self) -> Carrier: ...

    def fileno(self) -> int: ...

    def receive(self, now: float) -> list[tuple[bytes, Any]]: ...

    def send(self, datagram: bytes, now: float, receiver: Any = None) -> None: ...

    def flush(self, now: float) -> None: ...

    def due(self) -> float: ...

    def boots(self) -> bool: ...

    def reboot(self, now: float) -> None: ...

    def report(self) -> str: ...

    def close(self) -> None: ...


class VirtualServer:
    """Runs a swarm in wall time and connects each vehicle to its link.

    Parameters
    ----------
    swarm: nobody else may advance it.
    host, port: vehicle i listens on ``port + i``; port 0 takes free ones.
    links: of the vehicles, instead of those ports; closed with the server.
    faults: at the start, copied for each vehicle; those of ``links`` are their own.
    clock: wall clock.
    cameras: sees the true poses; what it delivers is given to ``publisher``.
    publisher: sends the frames of the cameras to whoever listens.
    seed: of the faults' randomness.
    on_behind: told by how many seconds the simulation has fallen behind wall time, at most every
        five seconds, when that is more than half a second.

    Raises
    ------
    InputError: a port is taken.
    """

    def __init__(
        self,
        swarm: VirtualSwarm,
        host: str = "127.0.0.1",
        port: int = BASE_PORT,
        *,
        links: Sequence[Link] | None = None,
        faults: Faults | None = None,
        clock: Clock | None = None,
        cameras: PushedCameras | None = None,
        publisher: Outlet | None = None,
        seed: int = 0,
        on_behind: Callable[[float], None] | None = None,
    ) -> None:
        self.swarm = swarm
        self.pace = Pace()
        self.links: list[Link] = [] if links is None else list(links)
        self._clock = clock or WallClock()
        self._cameras = cameras
        self._publisher = publisher
        self._on_behind = on_behind
        self._behind_told = -math.inf
        self._origin: float | None = None
        self._grain = min(_WAKE_MS, 1 + len(swarm.vehicles) // _PER_MS)
        self._first_tick = swarm.fleet.tick
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._selector = selectors.DefaultSelector()
        for index, given in enumerate(self.links):
            self._selector.register(given.fileno(), selectors.EVENT_READ, index)
        try:
            for index in range(len(self.links), len(swarm.vehicles)):
                number = port + index if port else 0
                if number > 65535:
                    raise InputError(f"virtual Crazyflie: port {number} is beyond 65535")
                link = UdpLink(host, number, replace(faults or Faults()), seed + index)
                self.links.append(link)
                self._selector.register(link, selectors.EVENT_READ, index)
        except InputError:
            self.close()
            raise

    @property
    def uris(self) -> list[str]:
        """What clients open, by vehicle."""
        return [link.uri for link in self.links]

    # Faults, from any thread. ``vehicle`` None means all.

    def set_faults(self, vehicle: int | None = None, **changes: Any) -> None:
        """Change fields of :class:`.faults.Faults`."""
        with self._lock:
            for index in self._chosen(vehicle):
                for name, value in changes.items():
                    setattr(self.links[index].faults, name, value)

    def cut(self, seconds: float, vehicle: int | None = None) -> None:
        """Cut the link for some time."""
        self.set_faults(vehicle, cut_until=self._clock.now() + seconds)

    def set_battery(self, volts: float, vehicle: int | None = None) -> None:
        """Continue with a battery of this voltage without load, 3.0 to 4.2 V."""
        with self._lock:
            for index in self._chosen(vehicle):
                self.swarm.vehicles[index].set_battery(volts)

    def reboot(self, vehicle: int | None = None) -> None:
        """Restart the firmware where the vehicle stands; a radio is silent meanwhile."""
        with self._lock:
            for index in self._chosen(vehicle):
                self.swarm.vehicles[index].reboot()
                self.links[index].reboot(self._clock.now())

    def _chosen(self, vehicle: int | None) -> Sequence[int]:
        return range(len(self.links)) if vehicle is None else (vehicle,)

    # The loop

    def start(self) -> None:
        """Run in a thread until :meth:`close`."""
        self._thread = threading.Thread(target=self.run, name="virtual-cf", daemon=True)
        self._thread.start()

    def run(self) -> None:
        """Run until :meth:`stop`."""
        with self._lock:
            self._origin = self._clock.now()
        while not self._stop.is_set():
            ready = self._wait()
            with self._lock:
                self._step(ready)

    def stop(self) -> None:
        """End :meth:`run` within some milliseconds; callable from a signal handler."""
        self._stop.set()

    def close(self) -> None:
        """Stop and release the ports; idempotent."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for link in self.links:
            link.close()
        self.links.clear()
        self._selector.close()

    def __enter__(self) -> VirtualServer:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _wait(self) -> set[int]:
        """Sleep until something is due or arrives; returns the vehicles that have mail."""
        deadline = self._wall(self.swarm.fleet.tick + _WAKE_MS)
        deadline = min(deadline, *(link.due() for link in self.links))
        if self._cameras is not None:
            deadline = min(deadline, self._cameras.next_event)
        events = self._selector.select(max(0.0, deadline - self._clock.now()))
        return {key.data for key, _ in events}

    def _wall(self, tick: int) -> float:
        """When a tick is due, s on the clock."""
        assert self._origin is not None
        return self._origin + 1e-3 * (tick - self._first_tick)

    def _tick(self, time: float) -> int:
        """First tick at or after a time, s on the clock."""
        assert self._origin is not None
        return self._first_tick + math.ceil(1e3 * (time - self._origin) - 1e-6)

    def _step(self, ready: set[int]) -> None:
        """One pass: the time that has passed, then what arrived at its end."""
        assert self._origin is not None, "run() sets the origin of time"
        self.pace.wakes += 1
        now = self._clock.now()
        behind = self._first_tick + math.floor(1e3 * (now - self._origin)) - self.swarm.fleet.tick
        self.pace.worst = max(self.pace.worst, behind)
        if behind > _STALL_MS:
            self.pace.stalls += 1
        if behind > _BEHIND_MS and now - self._behind_told > _BEHIND_PAUSE:
            self._behind_told = now
            if self._on_behind is not None:
                self._on_behind(1e-3 * behind)
        # A packet counts from the tick that is due when it arrives, not from one long past: many
        # vehicles take longer steps, which cost less.
        if behind >= self._grain:
            self._advance(min(behind, _SLICE_MS))
        self._exchange(ready)
        self._publish()
        now = self._clock.now()
        for link in self.links:
            link.flush(now)

    def _advance(self, ticks: int) -> None:
        """Let time pass, with a look of the cameras at every exposure."""
        fleet, cameras = self.swarm.fleet, self._cameras
        self.pace.ticks += ticks
        end = fleet.tick + ticks
        while fleet.tick < end:
            until = end if cameras is None else min(end, self._tick(cameras.next_exposure))
            self.swarm.advance(max(1, until - fleet.tick), self._say)
            if cameras is None:
                continue
            time = self._wall(fleet.tick)
            if cameras.next_exposure <= time:
                truth = self.swarm.truth()
                while cameras.next_exposure <= time:
                    cameras.expose(cameras.next_exposure, truth)

    def _exchange(self, ready: set[int]) -> None:
        now = self._clock.now()
        for index, link in enumerate(self.links):
            if index not in ready and link.uplink.due() > now:
                continue
            vehicle = self.swarm.vehicles[index]
            if link.boots():
                vehicle.reboot()
            for datagram, sender in link.receive(now):
                vehicle.counters.broadcast += sender is EVERYBODY
                for answer in vehicle.receive(datagram):
                    link.send(answer, now, sender)
            link.flush(now)

    def _say(self, vehicle: int, datagram: bytes) -> None:
        self.links[vehicle].send(datagram, self._clock.now())

    def _publish(self) -> None:
        if self._cameras is None:
            return
        for frame in self._cameras.frames():
            if self._publisher is not None:
                self._publisher.publish(frame)
