"""Pytest plugin that takes one safeguard out, named by the environment.

``SAFETY_MUTATION`` is ``rule:<name>`` for a monitor, ``gate:<command>`` for a check of the
command gate, ``link_loss`` for its look at what would be if the link were lost, or ``pilot`` for
a pilot that does nothing.
"""

from __future__ import annotations

import os
from typing import Any

from crazyarena.safety import guard
from crazyarena.safety.admission.fitters import FITTERS
from crazyarena.safety.link_loss import LinkLoss
from crazyarena.safety.pilot import SafePilot


def rules() -> list[str]:
    return [rule.name for rule in guard.RULES]


def checks() -> list[str]:
    return [command.__name__ for command in FITTERS]


def pytest_configure(config: Any) -> None:
    kind, _, name = os.environ.get("SAFETY_MUTATION", "").partition(":")
    if kind == "rule":
        assert name in rules()
        guard.RULES = tuple(rule for rule in guard.RULES if rule.name != name)
    elif kind == "gate":
        assert name in checks()
        for command in list(FITTERS):
            if command.__name__ == name:
                del FITTERS[command]
    elif kind == "link_loss":
        LinkLoss.on = False  # type: ignore[method-assign,assignment]
    elif kind == "pilot":
        SafePilot.update = lambda self, action, obs: []  # type: ignore[method-assign]
