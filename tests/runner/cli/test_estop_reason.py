"""``crazyarena estop --reason``: whatever it says, the request arrives as what it is."""

import pytest
from typer.testing import CliRunner

from crazyarena.clock import WallClock
from crazyarena.runner.cli import make_app
from crazyarena.safety import estop_local
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.estop_socket import SocketSource
from tests.safety.test_estop import Link

REASONS = [
    "wind",
    "x" * 100_000,
    "ß" * 100_000,
    "\U0001f681" * 50_000,
    "\x1b" * 50_000,
    "\\" * 9000,
]


@pytest.fixture
def session(tmp_path, monkeypatch):
    """A link, and the reasons of what was asked to land."""
    monkeypatch.setenv(estop_local.ONLY_PLACE, str(tmp_path))
    link, landed = Link(), []
    stop = EmergencyStop([link], WallClock())
    source = SocketSource(stop, say=lambda text: None, land=landed.append)
    yield link, landed
    source.close()
    stop.close()


@pytest.mark.parametrize("reason", REASONS, ids=lambda reason: f"{reason[:1]!a}x{len(reason)}")
def test_a_long_reason_neither_cuts_a_landing_nor_keeps_a_stop_back(session, reason):
    link, landed = session
    done = CliRunner().invoke(make_app(), ["estop", "--land", "--reason", reason])
    assert done.exit_code == 0, done.output
    assert "landing" in done.output
    assert len(landed) == 1
    assert landed[0].startswith(reason[:1]) or reason[:1] == "\x1b"
    assert not link.stopped.is_set()
    done = CliRunner().invoke(make_app(), ["estop", "--reason", reason])
    assert done.exit_code == 0, done.output
    assert link.stopped.is_set()
