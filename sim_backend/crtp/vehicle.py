"""A virtual Crazyflie: every CRTP service over one simulated vehicle. No sockets, no time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp import memory as mem
from crazyarena.sim_backend.crtp.commander_service import CommanderService
from crazyarena.sim_backend.crtp.console import ConsoleService
from crazyarena.sim_backend.crtp.flight import ArenaVehicle
from crazyarena.sim_backend.crtp.high_level_service import HighLevelService
from crazyarena.sim_backend.crtp.link_service import LinkService
from crazyarena.sim_backend.crtp.localization import LocalizationService
from crazyarena.sim_backend.crtp.log import LogService
from crazyarena.sim_backend.crtp.memory import MemoryService
from crazyarena.sim_backend.crtp.packets import NULL_PACKET, Port, Service, parse
from crazyarena.sim_backend.crtp.params import ParamService
from crazyarena.sim_backend.crtp.platform import PlatformService
from crazyarena.sim_backend.crtp.sensors import sensor_getters
from crazyarena.sim_backend.crtp.supervisor import SupervisorService
from crazyarena.sim_backend.crtp.toc import Table
from crazyarena.sim_backend.crtp.variables import getters
from crazyarena.sim_backend.physics.arena_plant import (
    AB_CHARGE,
    AB_VOLTS,
    AP_CAPACITY,
    open_circuit_volts,
)
from crazyarena.sim_backend.power_state import battery_level

BASE_ADDRESS = 0xE7E7E7E700
# One of each high-level command, setpoint, notification, arming and watchdog.
_EVERY_COMMAND = (
    "9d0101",
    "9d04",
    "7c00",
    "7d0000000000",
    "8c0000",
    "8c0700000000000000000000000000",
    "8c0800000000000000000000000000",
    "8c0900000000000000000000000000000000",
    "8c0a00000000000000000000000000000000",
    "8c0c" + 23 * "00",
    "8c0b" + 23 * "00",
    "8c060101000000000001",
    "8c0d00000000010000803f",
    "8c0300",
)
_RSSI = 45  # -dBm: a vehicle across the room
_VENDOR = 0xBC


class Hardware(Enum):
    """Memories that a vehicle has: BARE as the firmware without any hardware (trajectories and
    tester only), FULL also configuration, LEDs and decks."""

    BARE = "bare"
    FULL = "full"


@dataclass(slots=True)
class Counters:
    """Packets of one vehicle: received, those among them that went to everybody, refused before
    any service saw them, sent."""

    received: int = 0
    broadcast: int = 0
    malformed: int = 0
    sent: int = 0


class VirtualCrazyflie:
    """One vehicle of a fleet, speaking CRTP.

    Parameters
    ----------
    fleet, index: the simulated vehicle. Whoever owns the fleet advances it, then calls
        :meth:`advance`.
    hardware: which memories it has.
    stored: persistent parameters, kept over reboots.
    table: whose parameters and log variables it has.
    """

    def __init__(
        self,
        fleet: ArenaFleet,
        index: int,
        hardware: Hardware = Hardware.FULL,
        stored: dict[str, float] | None = None,
        table: Table = Table.CF21,
    ) -> None:
        address = BASE_ADDRESS + fleet.ids[index]
        self.flight = ArenaVehicle(fleet, index, address)
        self.counters = Counters()
        self.params = ParamService(self.flight, stored, table)
        self._variables = {
            **getters(self.flight.rows),
            **sensor_getters(fleet, index, table),
        }
        self._tester = mem.TesterMemory()
        self._variables.update(self._own_variables())
        self.log = LogService(self._read, table)
        self._getters = [self._variables.get(entry.name) for entry in self.log.entries]
        self.memories = MemoryService(self._memories(hardware, address))
        self.console = ConsoleService()
        commander = self._commander = CommanderService(self.flight)
        self._services: dict[int, Service] = {
            Port.CONSOLE: self.console,
            Port.PARAM: self.params,
            Port.SETPOINT: commander,
            Port.MEMORY: self.memories,
            Port.LOG: self.log,
            Port.LOCALIZATION: LocalizationService(self.flight, self.flight),
            Port.GENERIC_SETPOINT: commander,
            Port.HIGH_LEVEL: HighLevelService(self.flight.rows, self.flight.now),
            Port.SUPERVISOR: SupervisorService(self.flight),
            Port.PLATFORM: PlatformService(self.flight, table.device),
            Port.LINK: LinkService(),
        }

    def receive(self, datagram: bytes) -> list[bytes]:
        """Act on a datagram and return those that answer it; never raises."""
        self.counters.received += 1
        if datagram == NULL_PACKET:
            return [NULL_PACKET]
        packet = parse(datagram)
        service = None if packet is None else self._services.get(packet.port)
        if packet is None or service is None:
            self.counters.malformed += 1
            return []
        answers = service.handle(packet)
        self.counters.sent += len(answers)
        return answers

    def advance(self) -> list[bytes]:
        """Datagrams that became due by the fleet's present time: log data and console text."""
        packets = self.log.advance(self.flight.now_ms())
        packets += self.console.take()
        self.counters.sent += len(packets)
        return packets

    def due(self) -> int:
        """Tick of the fleet at which log data are due next; far away if no block is running."""
        due = self.log.due()
        if due is None:
            return sys.maxsize
        return self.flight.fleet.tick + due - self.flight.now_ms()

    def warm_up(self) -> None:
        """Compile what answers to commands, so that the first one in flight does not wait.

        Every command is given once, then the vehicle is rebooted.
        """
        for request in _EVERY_COMMAND:
            self.receive(bytes.fromhex(request))
        self.flight.external_position((0.0, 0.0, 0.0))
        self.flight.peer_position(1, (0.0, 0.0, 0.0))
        self.flight.recover()
        self.counters = Counters()
        self.reboot()

    def reboot(self) -> None:
        """Restart the firmware where the vehicle stands; stored parameters survive."""
        self.flight.fleet.reboot(self.flight.index)
        self._commander.rpyt.locked = True
        self.log.reset()
        self.params.boot()

    def set_battery(self, volts: float) -> None:
        """Continue with a battery of this voltage without load, 3.0 to 4.2 V.

        Raises
        ------
        ValueError: outside that range.
        """
        if not 3.0 <= volts <= 4.2:
            raise ValueError(f"battery {volts} V: a single cell has 3.0 to 4.2 V")
        rows = self.flight.rows
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = 0.5 * (low + high)
            if open_circuit_volts(rows.plant, middle) > volts:
                low = middle
            else:
                high = middle
        rows.body[AB_CHARGE] = high * rows.plant[AP_CAPACITY]
        # A parked vehicle draws no current, so that nothing would bring this up to date.
        rows.body[AB_VOLTS] = open_circuit_volts(rows.plant, high)

    def _read(self, ident: int) -> float:
        getter = self._getters[ident]
        return 0.0 if getter is None else getter()

    def _own_variables(self) -> dict[str, Callable[[], float]]:
        def param(name: str) -> Callable[[], float]:
            ids = {entry.name: i for i, entry in enumerate(self.params.entries)}
            ident = ids[name]
            ctype = self.params.entries[ident].ctype
            return lambda: ctype.unpack(self.params.get(ident))

        def measured(axis: int) -> Callable[[], float]:
            return lambda: self.flight.measured[0][axis] if self.flight.measured else 0.0

        def attitude(axis: int) -> Callable[[], float]:
            def read() -> float:
                quaternion = self.flight.measured[1] if self.flight.measured else None
                return quaternion[axis] if quaternion else 0.0

            return read

        fleet, index, rows = self.flight.fleet, self.flight.index, self.flight.rows
        names = {f"ring.{name}": param(f"ring.{name}") for name in ("effect", "solidRed")}
        names |= {f"ring.{name}": param(f"ring.{name}") for name in ("solidGreen", "solidBlue")}
        for axis, name in enumerate("xyz"):
            names[f"locSrv.{name}"] = names[f"ext_pos.{name.upper()}"] = measured(axis)
        for axis, name in enumerate(("qx", "qy", "qz", "qw")):
            names[f"locSrv.{name}"] = attitude(axis)
        return names | {
            "locSrvZ.tick": lambda: self.flight.measured_at & 0xFFFF,
            "pm.batteryLevel": lambda: battery_level(float(rows.body[AB_VOLTS])),
            "pm.state": lambda: fleet.power.state(index, fleet.tick),
            "radio.rssi": lambda: _RSSI,
            "radio.isConnected": lambda: 1,
            "radio.numRxUc": lambda: (self.counters.received - self.counters.broadcast) & 0xFFFF,
            "radio.numRxBc": lambda: self.counters.broadcast & 0xFFFF,
            "memTst.errCntW": lambda: self._tester.errors,
        }

    def _memories(self, hardware: Hardware, address: int) -> list[mem.Memory]:
        memories = [mem.trajectory(self.flight.rows.trajectories), self._tester]
        if hardware is Hardware.FULL:
            # The decks that the parameters of group "deck" tell of.
            memories += [
                mem.eeprom(address),
                mem.Memory(mem.LED_RING, bytearray(2 * mem.LEDS)),
                mem.Memory(mem.LED_TIMING, bytearray(2000)),
                mem.deck_list(),
                mem.one_wire(1, _VENDOR, 0x0F, "bcFlow2", "A"),
                mem.one_wire(2, _VENDOR, 0x0C, "bcMultiranger", "A"),
            ]
        return memories
