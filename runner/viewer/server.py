"""The web server of a viewer: address, looks, and which browsers may do more than look."""

from __future__ import annotations

import contextlib
import hmac
import io
import ipaddress
import math
import socket
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from crazyarena.errors import DependencyMissing, InputError
from crazyarena.runner.viewer.solids import Array

LOOPBACK = "127.0.0.1"

# viser's panel, in pixels: on the right of a window, or over the lower part of a narrow one.
_PANEL = 400
_PHONE = 576
_ABOVE = 0.4
_LOOSE = 1.05  # a little further away than it must be
_FAR = 1e4  # m


def open_server(host: str, port: int, title: str) -> Any:
    """A viser server at this address.

    Raises
    ------
    DependencyMissing: viser is not installed.
    InputError: the address cannot be had.
    """
    try:
        import viser
    except ImportError:
        raise DependencyMissing("viser", "viewer", "the viewer") from None
    _check_free(host, port)
    # It greets on standard output, which belongs to whoever started the viewer.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    # Shadows are most of the work where a browser has no graphics processor.
    server.scene.configure_default_lights(cast_shadow=False)
    server.gui.configure_theme(
        control_layout="floating",
        control_width="large",
        show_logo=False,
        show_share_button=False,
        brand_color=(0, 114, 178),
    )
    return server


def _check_free(host: str, port: int) -> None:
    """viser would take the next port without a word; a link that was handed on would be dead."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise InputError(
            f"viewer: {host}:{port}: {error.strerror or error}. Another viewer may be there: close "
            "it, or take another port with --view-port (0: any that is free)"
        ) from None


def address(server: Any, host: str) -> str:
    """What to open in a browser."""
    shown = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}"


def look_at(server: Any, low: Array, high: Array) -> None:
    """Let new browsers see a room with these corners (3,) m from one side and above."""
    middle, size = 0.5 * (low + high), float(np.linalg.norm((high - low)[:2]))
    server.initial_camera.up = (0.0, 0.0, 1.0)
    server.initial_camera.look_at = (float(middle[0]), float(middle[1]), 0.4 * float(high[2]))
    server.initial_camera.position = (
        float(middle[0] - 0.2 * size),
        float(middle[1] - 0.68 * size),
        float(0.42 * size + 0.5),
    )


def frame(client: Any, low: Array, high: Array) -> None:
    """Let one browser see the whole room with these corners (3,) m beside its panel."""
    camera = client.camera
    place, target = framed(low, high, camera.image_width, camera.image_height, camera.fov)
    with client.atomic():
        camera.position = tuple(place.tolist())
        camera.look_at = tuple(target.tolist())


def framed(low: Array, high: Array, width: int, height: int, fov: float) -> tuple[Array, Array]:
    """Place and target (3,) m of a camera that sees all of a room beside the panel.

    low, high: corners of the room, (3,) m. width, height: of the window, pixels; fov: vertical,
    rad.
    """
    width, height = max(width, 1), max(height, 1)
    phone = width < _PHONE
    # The free part of the window in the camera's plane at a distance of 1, y upwards.
    half = math.tan(0.5 * fov)
    pixel = 2.0 * half / height
    left, right = -0.5 * width * pixel, 0.5 * width * pixel
    right -= 0.0 if phone else min(_PANEL, 0.6 * width) * pixel
    top, bottom = half, half - 2.0 * half * (_ABOVE if phone else 1.0)
    # Standing aside turns the view: the direction makes up for it.
    back = np.array([-0.24, -0.82, 1.3] if phone else [-0.35, -0.82, 0.75])
    back /= np.linalg.norm(back)
    across = np.cross([0.0, 0.0, 1.0], back)
    across /= np.linalg.norm(across)
    turn = np.stack([across, np.cross(back, across), back])
    middle = 0.5 * (low + high)
    corners = np.array([np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)])
    x, y, z = turn @ (corners - middle).T
    away = float(z.max()) + 0.1
    while True:
        deep = away - z
        # Where the camera may stand aside, so that every corner is within the free part.
        sides = np.array([(x - right * deep).max(), (x - left * deep).min()])
        heights = np.array([(y - top * deep).max(), (y - bottom * deep).min()])
        if (sides[0] <= sides[1] and heights[0] <= heights[1]) or away > _FAR:
            break
        away *= 1.03
    aside = sides.mean() * turn[0] + heights.mean() * turn[1]
    return middle + aside + _LOOSE * away * back, middle + aside


def go_to(client: Any, place: Array) -> None:
    """Let one browser see a place (3,) m from nearby."""
    if not np.isfinite(place).all():
        return
    with client.atomic():
        client.camera.position = tuple((place + [-0.7, -0.9, 0.5]).tolist())
        client.camera.look_at = tuple(place.tolist())


class Rights:
    """Which browsers may stop, land and arm.

    On loopback those that were opened on this machine at the viewer's own address: a page of
    somebody else's in the same browser may talk to any port, but says where it comes from. Over a
    network those that know the token as well.

    Parameters
    ----------
    host: that the server listens at.
    token: secret; None lets nobody but this machine's own browsers.
    """

    def __init__(self, host: str, token: bytes | None) -> None:
        self._local = _is_loopback(host)
        self._token = token

    def without_token(self, connection: Any) -> bool:
        """Whether a browser may without being asked for the token; ``connection`` is its web
        socket."""
        if not self._local or connection is None:
            return False
        try:
            headers, peer = connection.request.headers, connection.remote_address
            return from_here(peer[0], headers.get("Host"), headers.get("Origin"))
        except (AttributeError, IndexError, TypeError):
            return False

    @property
    def by_token(self) -> bool:
        """Whether there is a token that gives the right."""
        return self._token is not None

    def knows(self, token: str) -> bool:
        """Whether this is the token."""
        if self._token is None:
            return False
        return hmac.compare_digest(token.strip().encode("utf-8", "replace"), self._token)


def from_here(peer: str, host: str | None, origin: str | None) -> bool:
    """Whether a page opened on this machine at our own address asks.

    ``peer`` is the other end's address, ``host`` and ``origin`` are headers of its request. A name
    that somebody made point here (DNS rebinding) is not our address.
    """
    if host is None or origin is None or not _is_loopback(peer):
        return False
    named = urlsplit(f"//{host}")
    return _is_loopback(named.hostname or "") and urlsplit(origin).netloc == named.netloc


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def connection_of(server: Any, client: Any) -> Any:
    """The web socket of a browser, None where viser does not tell; then it may only look."""
    live = getattr(getattr(server, "_websock_server", None), "_live_connections", {})
    return live.get(client.client_id)
