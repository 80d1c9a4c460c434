"""The device behind pyusb, asked as cflib asks it, in no time."""

import errno

import pytest
import usb.core
import usb.util
from cflib.drivers.crazyradio import Crazyradio, get_serials

from crazyarena.sim_backend.crazyradio.air import Air
from crazyarena.sim_backend.crazyradio.air_time import Rate
from crazyarena.sim_backend.crazyradio.usb_backend import VirtualUsb, install
from tests.sim_backend.crazyradio.on_air import ADDRESS, Leaping, Vehicle, air_with


@pytest.fixture
def plugged():
    """Factory: dongles on an air with these vehicles, until the end of the test."""
    undo = []

    def make(*vehicles, **options):
        clock = Leaping()
        air = air_with(*vehicles, **options)
        undo.append(install(air, clock))
        return air, clock

    yield make
    for function in reversed(undo):
        function()


def _radio(devid=0):
    radio = Crazyradio(devid=devid)
    radio.set_channel(80)
    radio.set_address(tuple(ADDRESS))
    return radio


def test_cflib_opens_it_and_every_setting_arrives(plugged):
    vehicle = Vehicle(channel=5, rate=Rate.M1)
    plugged(vehicle)
    radio = Crazyradio()
    assert radio.version == 0.53
    assert not radio.send_packet((0xFF,)).ack
    radio.set_channel(5)
    radio.set_data_rate(Crazyradio.DR_1MPS)
    radio.set_address(tuple(ADDRESS))
    radio.set_power(Crazyradio.P_M18DBM)
    radio.set_arc(0)
    radio.set_ard_time(1000)
    answer = radio.send_packet((0x30, 1, 2))
    assert answer.ack
    assert answer.powerDet
    assert answer.retry == 0
    assert bytes(answer.data) == bytes((0xF3, 1, 45))
    assert vehicle.got == [bytes((0x30, 1, 2))]
    settings = radio.dev.backend.enumerate_devices()[0].settings
    assert (settings.power, settings.arc, settings.ard) == (0, 0, 3)
    radio.close()


def test_the_status_byte_counts_retries(plugged):
    vehicle = Vehicle()
    plugged(vehicle)
    radio = _radio()
    lost = iter([1.0, 1.0, 0.0, 0.0])
    vehicle.station.loss = lambda now: next(lost)
    answer = radio.send_packet((0xFF,))
    assert (answer.ack, answer.retry) == (True, 2)


def test_scanning(plugged):
    plugged(Vehicle(channel=7), Vehicle(channel=99))
    radio = Crazyradio()
    radio.set_address(tuple(ADDRESS))
    assert radio.scan_channels(0, 125, (0xFF,)) == (7, 99)
    selected = tuple({"channel": c, "datarate": 2} for c in (6, 7, 8))
    assert radio.scan_selected(selected, (0xFF, 0xFF, 0xFF)) == (selected[1],)
    # The dongle's own scan, every other channel at 2 Mbit/s.
    radio.dev.ctrl_transfer(0x40, 0x21, wValue=1, wIndex=125, data_or_wLength=(0xFF,))
    assert tuple(radio.dev.ctrl_transfer(0xC0, 0x21, data_or_wLength=64)) == (7, 99)


def test_several_dongles_by_number_and_serial(plugged):
    plugged(Vehicle(), serials=("E7E7000001", "E7E7000002"))
    assert get_serials() == ("E7E7000001", "E7E7000002")
    assert Crazyradio(serial="E7E7000002").dev.serial_number == "E7E7000002"
    with pytest.raises(Exception, match="Cannot find a Crazyradio Dongle"):
        Crazyradio(devid=2)


def test_time_passes_as_modelled(plugged):
    """1.2 ms of exchange with one vehicle; two of the radio's settings cost two transfers more."""
    _, clock = plugged(Vehicle())
    radio = _radio()
    radio.send_packet((0xFF,))
    begin = clock.now()
    for _ in range(1000):
        radio.send_packet((0xFF,))
    one = clock.now() - begin
    assert 600 < 1000 / one < 900
    begin = clock.now()
    for k in range(1000):
        radio.set_address((*ADDRESS[:4], 1 + k % 2))
        radio.send_packet((0xFF,))
    assert clock.now() - begin > one + 0.7


def test_unplugged_and_plugged_in_again(plugged):
    air, _ = plugged(Vehicle())
    radio = _radio()
    assert radio.send_packet((0xFF,)).ack
    air.plug(air.serials[0], False)
    assert radio.send_packet((0xFF,)) is None
    with pytest.raises(usb.core.USBError) as caught:
        radio.dev.write(1, (0xFF,))
    assert caught.value.errno == errno.ENODEV
    with pytest.raises(Exception, match="Cannot find a Crazyradio Dongle"):
        Crazyradio()
    air.plug(air.serials[0], True)
    with pytest.raises(usb.core.USBError):
        radio.dev.write(1, (0xFF,))  # the handle is of a device that is gone
    radio.close()
    assert _radio().send_packet((0xFF,)).ack


def test_without_acknowledgements_two_packets_go_in_one_transfer(plugged):
    vehicle = Vehicle()
    plugged(vehicle)
    radio = _radio()
    radio.set_ack_enable(False)
    radio.dev.write(1, bytes(range(0x30, 0x50)) * 2)
    assert vehicle.got == [bytes(range(0x30, 0x50))] * 2
    with pytest.raises(usb.core.USBTimeoutError):
        radio.dev.read(0x81, 64, timeout=100)
    radio.set_ack_enable(True)
    assert radio.send_packet((0xFF,)).ack


def test_what_it_does_not_know_stalls(plugged):
    plugged(Vehicle())
    radio = _radio()
    for request_type, request, data in (
        (0x40, 0x77, ()),
        (0x40, 0x02, (1, 2)),
        (0x40, 0x03, ()),
        (0xC0, 0x11, 8),
        (0x00, 0x09, ()),
    ):
        with pytest.raises(usb.core.USBError) as caught:
            radio.dev.ctrl_transfer(request_type, request, wValue=9, data_or_wLength=data)
        assert caught.value.errno == errno.EPIPE
    radio.set_channel(125)
    radio.dev.ctrl_transfer(0x40, 0x01, wValue=126)
    assert radio.dev.backend.enumerate_devices()[0].settings.channel == 125


def test_a_continuous_carrier_sends_no_packets(plugged):
    vehicle = Vehicle()
    plugged(vehicle)
    radio = _radio()
    radio.set_cont_carrier(True)
    assert not radio.send_packet((0x30,)).ack
    assert vehicle.got == []


def test_the_bootloader_is_another_device(plugged):
    plugged(Vehicle())
    radio = _radio()
    radio.dev.ctrl_transfer(0x40, 0xFF)
    assert radio.send_packet((0xFF,)) is None


def test_pyusb_shows_it_whole():
    device = usb.core.find(backend=VirtualUsb(Air([]), Leaping()))
    assert (device.manufacturer, device.product) == ("Bitcraze", "Crazyradio PA USB Dongle")
    text = str(device)
    assert "ENDPOINT 0x81" in text
    assert "ENDPOINT 0x1:" in text
    usb.util.dispose_resources(device)
