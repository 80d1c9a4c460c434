"""Faults by a line of text, typed into a running ``virtual-cf``."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from crazyarena.errors import InputError
from crazyarena.sim_backend.crazyradio.air import Air
from crazyarena.sim_backend.crtp import faults as ft
from crazyarena.sim_backend.crtp.server import VirtualServer

_VEHICLE = re.compile(r"cf(\d+)\s+(.*)")


@dataclass(frozen=True, slots=True)
class _Order:
    """What a line is about: all vehicles or one, and the text behind its first word."""

    server: VirtualServer
    air: Air | None
    vehicle: int | None
    value: str


def obey(server: VirtualServer, air: Air | None, line: str) -> str:
    """Do what a line says; returns what was done.

    ``cf2`` before any of them means that vehicle alone.

    Raises
    ------
    InputError: not one of ``loss 5%``, ``latency 8ms±3ms``, ``battery 3.2V``, ``cut 2s``,
        ``reboot``, ``status``; over radio also ``unplug``, ``plug`` (a dongle by number, the
        first without one), ``noise 80 30%``.
    """
    text, vehicle = line.strip(), None
    match = _VEHICLE.fullmatch(text)
    if match is not None:
        ids = server.swarm.fleet.ids
        if int(match[1]) not in ids:
            known = ", ".join(f"cf{ident}" for ident in ids)
            raise InputError(f"command: found {text!r}; there is no cf{match[1]}, only {known}")
        vehicle, text = list(ids).index(int(match[1])), match[2]
    word, _, value = text.partition(" ")
    action = _ORDERS.get(word)
    if action is None or (air is None and word in _AIR):
        known = ", ".join(name for name in _ORDERS if air is not None or name not in _AIR)
        raise InputError(f"command: found {line.strip()!r}; write one of {known}")
    return action(_Order(server, air, vehicle, value.strip()))


def status(server: VirtualServer) -> list[str]:
    """Lines on each vehicle's link and on how the simulation keeps up with wall time."""
    lines = [
        f"{link.uri}: {link.report()}, malformed {vehicle.counters.malformed}, "
        f"supervisor {vehicle.flight.info():#05x}"
        for link, vehicle in zip(server.links, server.swarm.vehicles, strict=True)
    ]
    pace = server.pace
    lines.append(
        f"simulated {1e-3 * pace.ticks:.1f} s; fell behind by more than 50 ms "
        f"{pace.stalls} times, at most {pace.worst} ms; nothing skipped"
    )
    return lines


def _loss(order: _Order) -> str:
    order.server.set_faults(order.vehicle, loss=ft.parse_share(order.value))
    return f"loss {order.value}"


def _latency(order: _Order) -> str:
    latency, jitter = ft.parse_latency(order.value)
    order.server.set_faults(order.vehicle, latency=latency, jitter=jitter)
    return f"latency {order.value}"


def _battery(order: _Order) -> str:
    order.server.set_battery(ft.parse_volts(order.value), order.vehicle)
    return f"battery {order.value}"


def _cut(order: _Order) -> str:
    seconds, _ = ft.parse_latency(order.value)
    order.server.cut(seconds, order.vehicle)
    return f"link cut for {order.value}"


def _reboot(order: _Order) -> str:
    order.server.reboot(order.vehicle)
    return "rebooted"


def _status(order: _Order) -> str:
    return "\n".join(status(order.server))


def _plug(plugged: bool) -> Callable[[_Order], str]:
    def action(order: _Order) -> str:
        assert order.air is not None
        serials = order.air.serials
        number = order.value or "0"
        if not number.isdigit() or int(number) >= len(serials):
            raise InputError(f"dongle: found {order.value!r}; need 0 to {len(serials) - 1}")
        order.air.plug(serials[int(number)], plugged)
        return f"dongle {number} {'plugged in' if plugged else 'unplugged'}"

    return action


def _noise(order: _Order) -> str:
    assert order.air is not None
    channel, _, share = order.value.partition(" ")
    if not channel.isdigit() or int(channel) > 125:
        raise InputError(f"noise: found {order.value!r}; write a channel and a share, as 80 30%")
    number, loss = int(channel), ft.parse_share(share)
    order.air.noise = lambda on, _: loss if on == number else 0.0
    return f"noise on channel {number}: {share}"


_ORDERS: dict[str, Callable[[_Order], str]] = {
    "loss": _loss,
    "latency": _latency,
    "battery": _battery,
    "cut": _cut,
    "reboot": _reboot,
    "status": _status,
    "unplug": _plug(False),
    "plug": _plug(True),
    "noise": _noise,
}
_AIR = ("unplug", "plug", "noise")
