"""cflib's own driver on a bad link: nothing is lost, nothing comes twice."""

import struct
import threading
import time

import pytest
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.radiodriver import RadioDriver

from crazyarena.sim_backend.crazyradio.usb_backend import install
from tests.sim_backend.crazyradio.on_air import Leaping, Vehicle, air_with, is_free
from tests.waiting import eventually


@pytest.mark.parametrize("count", [3000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_a_tenth_of_the_packets_and_acknowledgements_lost(count):
    vehicle = Vehicle(loss=0.1, ack_loss=0.1)
    air = air_with(vehicle, seed=7)
    undo = install(air, Leaping())
    driver = RadioDriver()
    errors = []
    driver.connect("radio://0/80/2M/E7E7E7E701", None, errors.append)
    down = []

    def receive():
        while len(down) < count:
            packet = driver.receive_packet(5)
            assert packet is not None
            if packet.port == 5:
                down.append(struct.unpack("<I", bytes(packet.data))[0])

    reader = threading.Thread(target=receive)
    reader.start()
    try:
        for number in range(count):
            while not vehicle.receiver.say(b"\x50" + struct.pack("<I", number)):
                time.sleep(0.001)
            packet = CRTPPacket()
            packet.set_header(3, 0)
            packet.data = struct.pack("<I", number)
            assert driver.send_packet(packet)
        reader.join()
        eventually(lambda: len(vehicle.got) >= count)
    finally:
        driver.close()
        eventually(lambda: is_free(air))
        undo()
    assert not driver.needs_resending  # it has the safe link
    assert errors == []
    assert down == list(range(count))
    assert [struct.unpack("<I", packet[1:])[0] for packet in vehicle.got] == list(range(count))
    lost = air.counters.lost + air.counters.acks_lost
    assert lost > 0.15 * air.counters.attempts


def test_too_many_packets_lost_after_a_hundred():
    vehicle = Vehicle()
    air = air_with(vehicle)
    undo = install(air, Leaping())
    driver = RadioDriver()
    errors = []
    driver.connect("radio://0/80/2M/E7E7E7E701", None, errors.append)
    try:
        eventually(lambda: not driver.needs_resending)
        vehicle.station.in_range = False
        eventually(lambda: errors)
    finally:
        driver.close()
        eventually(lambda: is_free(air))
        undo()
    assert errors[0] == "Too many packets lost"
