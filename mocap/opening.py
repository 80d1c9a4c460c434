"""Opening a pose source by name, as the command line and configuration files do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.motioncapture_source import VENDOR_TYPES, MotionCaptureSource
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.replay import ReplaySource
from crazyarena.mocap.ros2_source import Ros2Source
from crazyarena.mocap.source import PoseSource
from crazyarena.mocap.vrpn_source import VrpnSource
from crazyarena.mocap.zenoh_link import ZenohSource


def open_source(kind: str, *, clock: Clock, **options: Any) -> PoseSource:
    """Open a pose source by name.

    Parameters
    ----------
    kind: ``zenoh``, ``ros2``, ``replay``, or a type of the ``motioncapture`` package (``vicon``,
        ``qualisys``, ``optitrack``, ``nokov``, ``fzmotion``, ``vrpn``, ...), whose own option
        names (``hostname``, ``port``, ``interface_ip``, ...) are passed through.
        ``vrpn`` is a client of our own unless ``client=motioncapture``.
    clock: the session clock.
    options: keyword arguments of the source's class.

    Raises
    ------
    InputError: unknown kind or option.
    DependencyMissing: the package behind the kind is not installed.
    """
    if kind == ONBOARD:
        raise InputError(
            "mocap source onboard: the vehicle's own estimate comes over its link, and nothing "
            "else is seen; here cameras are needed"
        )
    opener: Callable[..., PoseSource]
    client = options.pop("client", "own") if kind == "vrpn" else ""
    if client not in ("", "own", "motioncapture"):
        raise InputError(f"mocap client: found {client!r}; choose own or motioncapture")
    if client == "own":
        opener = VrpnSource
    elif kind in VENDOR_TYPES:
        opener = MotionCaptureSource
        options["vendor"] = kind
    elif kind == "zenoh":
        opener = ZenohSource
    elif kind == "ros2":
        opener = Ros2Source
    elif kind == "replay":
        opener = ReplaySource
    else:
        known = ", ".join(["zenoh", "ros2", "replay", ONBOARD, *VENDOR_TYPES])
        raise InputError(f"mocap source: found {kind!r}; choose one of {known}")
    try:
        return opener(clock=clock, **options)
    except TypeError as error:
        if "unexpected keyword argument" in str(error) or "missing" in str(error):
            raise InputError(f"mocap source {kind}: {error}") from None
        raise


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """A pose source that somebody else will open: arguments of :func:`open_source`."""

    kind: str
    options: dict[str, Any] = field(default_factory=dict)

    def open(self, clock: Clock) -> PoseSource:
        """Open it on the session's clock; raises as :func:`open_source`."""
        return open_source(self.kind, clock=clock, **self.options)
