"""Recorded requests and conversations, asked again: the vehicle gives the recorded answers."""

from __future__ import annotations

import contextlib
import socket
import struct

import pytest

from crazyarena.sim_backend.crtp.log import MAX_BLOCKS
from crazyarena.sim_backend.crtp.packets import Port
from crazyarena.sim_backend.crtp.server import VirtualServer
from tests.sim_backend.crtp.recordings import Bench, conversations, requests, tables

_EEXIST, _ENOMEM = 17, 12
_TOC_INFO = (bytes.fromhex("2003"), bytes.fromhex("5003"))


def _canonical(datagram: bytes) -> bytes:
    """Blank what is opaque (checksum of a TOC) or left over from an earlier packet."""
    if datagram[:2] in _TOC_INFO:
        return datagram[:4] + bytes(4) + datagram[8:]
    if datagram[0] & 0xF3 == Port.HIGH_LEVEL << 4:
        # The third byte of the answer is whatever was there when the request was shorter.
        return datagram[:3] + b"\0" + datagram[4:]
    if datagram[0] & 0xF3 == Port.LOG << 4 | 1 and datagram[1:2] == b"\x05":
        return datagram[:2] + b"\0" + datagram[3:]
    return datagram


def _prepare(bench: Bench, request: bytes, answers: list[bytes]) -> None:
    """Bring about what an answer presupposes when the request before it was left out."""
    if request[0] & 0xF3 != Port.LOG << 4 | 1 or not answers or len(request) < 3:
        return
    status = answers[0][-1]
    if status == _EEXIST:
        bench.ask(bytes((0x5D, 6, request[2])))
    elif status == _ENOMEM:
        for spare in range(MAX_BLOCKS):
            bench.ask(bytes((0x5D, 6, 200 + spare)))


@pytest.mark.parametrize("rows", [pytest.param(r, id=n) for n, r in requests()])
def test_single_requests(rows: list) -> None:
    bench = Bench()
    bench.run_to(2000)
    for label, request_hex, answers_hex in rows:
        request = bytes.fromhex(request_hex)
        expected = [bytes.fromhex(answer) for answer in answers_hex]
        _prepare(bench, request, expected)
        answers = bench.ask(request)
        bench.run_to(bench.fleet.tick + 10)
        assert [_canonical(a) for a in answers] == [_canonical(e) for e in expected], label


@pytest.mark.parametrize("rows", [pytest.param(r, id=n) for n, r in requests()])
def test_single_requests_over_udp(rows: list) -> None:
    """The same on the wire: these answers within 80 ms of each request, and nothing else."""
    bench = Bench()
    bench.run_to(2000)
    with (
        VirtualServer(bench.swarm, port=0) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        client.connect(("127.0.0.1", server.links[0].port))
        for label, request_hex, answers_hex in rows:
            request = bytes.fromhex(request_hex)
            expected = [_canonical(bytes.fromhex(answer)) for answer in answers_hex]
            if request[0] >> 4 == Port.LOG:
                # Its data come when they are due, among the answers.
                continue
            client.send(request)
            heard = []
            client.settimeout(5.0 if expected else 0.08)
            with contextlib.suppress(TimeoutError):
                while len(heard) < max(len(expected), 1):
                    heard.append(_canonical(client.recv(64)))
            assert heard == expected, label
        client.settimeout(0.08)
        with pytest.raises(TimeoutError):
            client.recv(64)


def _is_log_data(datagram: bytes) -> bool:
    return datagram[0] & 0xF3 == Port.LOG << 4 | 2


@pytest.fixture(scope="module", params=[pytest.param(c, id=n) for n, c in conversations()])
def replay(request: pytest.FixtureRequest) -> tuple[list, list, list]:
    """A conversation held again at the recorded times.

    Returns the recorded answers, ours, and (firmware ms, datagram) of what we said unasked.
    """
    rows = request.param
    stamps = [
        (row[0], int.from_bytes(bytes.fromhex(row[2])[2:5], "little"))
        for row in rows
        if row[1] == "<" and _is_log_data(bytes.fromhex(row[2]))
    ]
    shift = min((ms - 1000 * time for time, ms in stamps), default=3000.0)
    bench = Bench()
    recorded, ours = [], []
    for time, direction, text in rows:
        datagram = bytes.fromhex(text)
        if direction == "<":
            recorded.append(datagram)
        else:
            bench.run_to(1000 * time + shift)
            ours += bench.ask(datagram)
    return recorded, ours, bench.heard


def test_conversation_answers(replay: tuple[list, list, list]) -> None:
    recorded, ours, _ = replay

    def by_port(datagrams: list[bytes]) -> dict[int, list[bytes]]:
        ports: dict[int, list[bytes]] = {}
        for datagram in datagrams:
            if not _is_log_data(datagram):
                ports.setdefault(datagram[0] >> 4, []).append(_canonical(datagram))
        return ports

    expected, given = by_port(recorded), by_port(ours)
    assert set(given) == set(expected)
    for port in expected:
        assert given[port] == expected[port], f"port {port}"


def test_conversation_log_data(replay: tuple[list, list, list]) -> None:
    recorded, _, heard = replay

    def blocks(datagrams: list[bytes]) -> dict[int, list[bytes]]:
        out: dict[int, list[bytes]] = {}
        for datagram in datagrams:
            if _is_log_data(datagram):
                out.setdefault(datagram[1], []).append(datagram)
        return out

    def period(packets: list[bytes]) -> float:
        times = [int.from_bytes(p[2:5], "little") for p in packets]
        return (times[-1] - times[0]) / (len(times) - 1)

    expected, given = blocks(recorded), blocks([datagram for _, datagram in heard])
    assert set(given) == set(expected)
    for ident, packets in expected.items():
        assert {len(p) for p in given[ident]} == {len(p) for p in packets}
        assert period(given[ident]) == pytest.approx(period(packets), rel=0.01)
        assert len(given[ident]) == pytest.approx(len(packets), rel=0.02, abs=2)
        stamps = [int.from_bytes(p[2:5], "little") for p in given[ident]]
        assert all(
            0 <= tick - stamp <= 1
            for (tick, d), stamp in zip(
                [h for h in heard if _is_log_data(h[1]) and h[1][1] == ident], stamps, strict=True
            )
        )


@pytest.mark.parametrize("table", [pytest.param(t, id=n) for n, t in tables()])
def test_tables_of_contents_and_values_after_boot(table: dict) -> None:
    """Everything that the recorded table lists can be found by name, and reads the same."""
    bench = Bench()
    vehicle = bench.vehicle
    ours = {entry.name: (i, entry) for i, entry in enumerate(vehicle.params.entries)}
    for ident, group, name, ctype, access, extended, value in table["params"]:
        number, entry = ours[f"{group}.{name}"]
        assert number == ident
        assert entry.ctype.name == ctype.removesuffix("_t")
        assert entry.read_only == bool(access)
        assert entry.persistent == extended
        (answer,) = bench.ask(b"\x2d" + struct.pack("<H", number))
        assert answer[3] == 0
        assert entry.ctype.unpack(answer[4:]) == (float(value) if ctype == "float" else int(value))
    logs = {entry.name: (i, entry) for i, entry in enumerate(vehicle.log.entries)}
    for ident, group, name, ctype in table["logs"]:
        number, variable = logs[f"{group}.{name}"]
        assert number == ident
        assert variable.ctype.name == ctype.removesuffix("_t")
    assert len(ours) == len(table["params"])
    assert len(logs) == len(table["logs"])
    (version,) = bench.ask("dd00")
    assert struct.unpack_from("<I", version, 2) == (table["protocol"],)
