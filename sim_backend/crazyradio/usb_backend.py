"""What pyusb finds when the dongles are software: descriptors, and transfers passed on."""

from __future__ import annotations

import array
import contextlib
import errno
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.backend.libusb0
import usb.backend.libusb1
import usb.backend.openusb
from usb.core import USBError, USBTimeoutError

from crazyarena.clock import Clock, WallClock
from crazyarena.sim_backend.crazyradio.air import InUse, Medium, Unplugged
from crazyarena.sim_backend.crazyradio.air_time import UsbTiming
from crazyarena.sim_backend.crazyradio.dongle import Dongle, Stalled, TimedOut

VENDOR, PRODUCT = 0x1915, 0x7777
VERSION = 0x0053  # of the firmware of a Crazyradio PA, as 0.53
_OUT, _IN = 0x01, 0x81
_BULK, _PACKET = 2, 64
_STRING, _GET_DESCRIPTOR = 3, 6
_ENGLISH = 0x0409
_DEVICE_TO_HOST, _TYPE_MASK, _VENDOR_TYPE = 0x80, 0x60, 0x40
_MODULES = (usb.backend.libusb1, usb.backend.libusb0, usb.backend.openusb)
# Where programs ask for a backend: of pyusb, and of the package by which cflib brings libusb, which
# keeps the first answer.
_PLACES: list[tuple[Any, str]] = [(module, "get_backend") for module in _MODULES]
with contextlib.suppress(ImportError):
    import libusb_package

    _PLACES.append((libusb_package, "get_libusb1_backend"))


@contextlib.contextmanager
def _usb_errors() -> Iterator[None]:
    """Errors of the dongle as libusb tells them."""
    try:
        yield
    except Unplugged:
        raise USBError("No such device (it may have been disconnected)", -4, errno.ENODEV) from None
    except InUse:
        raise USBError("Resource busy", -6, errno.EBUSY) from None
    except TimedOut:
        raise USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT) from None
    except Stalled:
        raise USBError("Pipe error", -9, errno.EPIPE) from None


class VirtualUsb(usb.backend.IBackend):
    """A USB with nothing but virtual Crazyradios on it.

    Parameters
    ----------
    air: knows which dongles are plugged in.
    clock: on which transfers take their time.
    timing: of the transfers.
    """

    def __init__(self, air: Medium, clock: Clock, timing: UsbTiming | None = None) -> None:
        self._air = air
        self._clock = clock
        self._timing = timing
        self._devices: dict[str, Dongle] = {}

    # Descriptors

    def enumerate_devices(self) -> Sequence[Dongle]:
        found = []
        for serial in self._air.dongles():
            known = self._devices.get(serial)
            if known is None or known.gone:
                self._devices[serial] = Dongle(serial, self._air, self._clock, self._timing)
            found.append(self._devices[serial])
        return found

    def get_parent(self, dev: Dongle) -> None:
        return None

    def get_device_descriptor(self, dev: Dongle) -> Any:
        number = list(self._devices).index(dev.serial) + 1
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0110,
            bDeviceClass=0xFF,
            bDeviceSubClass=0xFF,
            bDeviceProtocol=0xFF,
            bMaxPacketSize0=32,
            idVendor=VENDOR,
            idProduct=PRODUCT,
            bcdDevice=VERSION,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=3,
            bNumConfigurations=1,
            address=number,
            bus=1,
            port_number=number,
            port_numbers=(number,),
            speed=2,
        )

    def get_configuration_descriptor(self, dev: Dongle, config: int) -> Any:
        if config:
            raise IndexError(f"configuration {config}: a Crazyradio has one")
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=32,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0x80,
            bMaxPower=50,
            extra_descriptors=[],
        )

    def get_interface_descriptor(self, dev: Dongle, intf: int, alt: int, config: int) -> Any:
        if intf or alt or config:
            raise IndexError(f"interface {intf}, setting {alt}: a Crazyradio has one of each")
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=2,
            bInterfaceClass=0xFF,
            bInterfaceSubClass=0,
            bInterfaceProtocol=0,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, dev: Dongle, ep: int, intf: int, alt: int, config: int
    ) -> Any:
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=(_IN, _OUT)[ep],
            bmAttributes=_BULK,
            wMaxPacketSize=_PACKET,
            bInterval=0,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    # The device

    def open_device(self, dev: Dongle) -> Dongle:
        return dev

    def close_device(self, dev_handle: Dongle) -> None:
        return

    def set_configuration(self, dev_handle: Dongle, config_value: int) -> None:
        # Whoever holds the interface of another program's device cannot configure it.
        with _usb_errors():
            dev_handle.open()

    def get_configuration(self, dev_handle: Dongle) -> int:
        return 1

    def set_interface_altsetting(self, dev_handle: Dongle, intf: int, altsetting: int) -> None:
        return

    def claim_interface(self, dev_handle: Dongle, intf: int) -> None:
        with _usb_errors():
            dev_handle.open()

    def release_interface(self, dev_handle: Dongle, intf: int) -> None:
        dev_handle.close()

    def reset_device(self, dev_handle: Dongle) -> None:
        with _usb_errors():
            dev_handle.reset()

    def clear_halt(self, dev_handle: Dongle, ep: int) -> None:
        return

    def is_kernel_driver_active(self, dev_handle: Dongle, intf: int) -> bool:
        return False

    # Transfers

    def bulk_write(
        self, dev_handle: Dongle, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        with _usb_errors():
            return dev_handle.write(data.tobytes())

    def bulk_read(
        self, dev_handle: Dongle, ep: int, intf: int, buff: array.array[int], timeout: int
    ) -> int:
        with _usb_errors():
            return _fill(buff, dev_handle.read(len(buff), 1e-3 * timeout))

    def ctrl_transfer(
        self,
        dev_handle: Dongle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array.array[int],
        timeout: int,
    ) -> int:
        with _usb_errors():
            vendor = bmRequestType & _TYPE_MASK == _VENDOR_TYPE
            if bmRequestType & _DEVICE_TO_HOST:
                if vendor:
                    return _fill(data, dev_handle.control_in(bRequest, len(data)))
                if bRequest == _GET_DESCRIPTOR and wValue >> 8 == _STRING:
                    return _fill(data, _string(dev_handle, wValue & 0xFF))
            elif vendor:
                dev_handle.control_out(bRequest, wValue, wIndex, data.tobytes())
                return len(data)
            raise Stalled(f"request {bRequest:#04x} of type {bmRequestType:#04x}")


def _fill(buffer: array.array[int], data: bytes) -> int:
    buffer[: len(data)] = array.array("B", data[: len(buffer)])
    return min(len(data), len(buffer))


def _string(dongle: Dongle, index: int) -> bytes:
    if index == 0:
        body = _ENGLISH.to_bytes(2, "little")
    elif index in (1, 2, 3):
        texts = ("Bitcraze", "Crazyradio PA USB Dongle", dongle.serial)
        body = texts[index - 1].encode("utf-16-le")
    else:
        raise Stalled(f"string {index}")
    return bytes((2 + len(body), _STRING)) + body


def install(
    air: Medium, clock: Clock | None = None, timing: UsbTiming | None = None
) -> Callable[[], None]:
    """Let pyusb find the dongles of ``air`` and nothing else, in this process: no rehearsal may
    reach a radio that is really plugged in.

    Returns
    -------
    A function that undoes it.
    """
    backend = VirtualUsb(air, clock or WallClock(), timing)
    before = [getattr(module, name) for module, name in _PLACES]
    for module, name in _PLACES:
        setattr(module, name, lambda *_, **__: backend)

    def undo() -> None:
        for (module, name), function in zip(_PLACES, before, strict=True):
            setattr(module, name, function)

    return undo
