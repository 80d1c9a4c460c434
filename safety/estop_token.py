"""Who may stop over a network: messages under a shared secret that cannot be used again.

A message is JSON with ``nonce``, ``time`` (Unix s), ``session``, ``reason`` and ``mac``, the
HMAC-SHA256 (RFC 2104) of the others. It is good once, and only for the session it names, or, if
it names none (the session could not be asked for), within a window of time.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Callable
from pathlib import Path

import crazyarena.secret

_WINDOW = 30.0  # s, for messages that name no session; hosts' clocks may differ by so much
MAX_BYTES = 2048
_MAX_LABEL = 80
_VERSION = "crazyarena-estop-1"


def read_secret(path: Path) -> bytes:
    """Shared secret from a file only its owner can read.

    Raises
    ------
    InputError: no file, too short a secret, or one that others can read.
    """
    return crazyarena.secret.read_secret(path, "stop token")


def _mac(secret: bytes, session: str, nonce: str, stamp: float, reason: str) -> str:
    text = json.dumps([_VERSION, session, nonce, stamp, reason])
    return hmac.new(secret, text.encode(), hashlib.sha256).hexdigest()


def make_message(
    secret: bytes | None,
    reason: str,
    session: str = "",
    wall: Callable[[], float] = time.time,
) -> bytes:
    """Message for :class:`TokenCheck`; without a secret it carries no proof."""
    nonce, stamp = secrets.token_hex(16), round(wall(), 3)
    fields = {"nonce": nonce, "time": stamp, "session": session, "reason": reason}
    if secret is not None:
        fields["mac"] = _mac(secret, session, nonce, stamp, reason)
    return json.dumps(fields).encode()


class TokenCheck:
    """Decides about stop messages.

    Parameters
    ----------
    secret: None lets everything pass that reached the key at all: a stop too many is safe, if
        annoying.
    wall: Unix time, for messages without a session.
    label: for people, at the beginning of ``session``; what follows is never the same again.
    """

    def __init__(
        self, secret: bytes | None, wall: Callable[[], float] = time.time, label: str = ""
    ) -> None:
        self._secret = secret
        self._wall = wall
        nonce = secrets.token_hex(16)
        self.session = f"{label[:_MAX_LABEL]}-{nonce}" if label else nonce
        self._seen: set[str] = set()
        self.refused = 0

    def accept(self, payload: bytes) -> str | None:
        """Reason given in a good message; None, counted in ``refused``, for a bad one."""
        if self._secret is None:
            return _reason_of(payload)
        reason = self._verified(payload, self._secret)
        if reason is None:
            self.refused += 1
        return reason

    def _verified(self, payload: bytes, secret: bytes) -> str | None:
        try:
            fields = json.loads(payload) if len(payload) <= MAX_BYTES else {}
            nonce, session = str(fields["nonce"]), str(fields["session"])
            stamp, reason, mac = float(fields["time"]), str(fields["reason"]), str(fields["mac"])
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
            return None
        expected = _mac(secret, session, nonce, stamp, reason)
        if not hmac.compare_digest(expected.encode(), mac.encode("utf-8", "replace")):
            return None
        if nonce in self._seen:
            return None
        fresh = not session and abs(self._wall() - stamp) <= _WINDOW
        if session != self.session and not fresh:
            return None
        self._seen.add(nonce)
        return reason


def _reason_of(payload: bytes) -> str:
    """Best guess at a reason; whatever was sent, somebody meant to stop."""
    try:
        reason = json.loads(payload[:MAX_BYTES])["reason"]
        return reason if isinstance(reason, str) else ""
    except (ValueError, TypeError, KeyError, RecursionError):
        return payload[:80].decode("utf-8", "replace")
