"""The limit of wall time for foreign code in this process."""

from __future__ import annotations

import signal

from crazyarena.runner.timing import step_limit


def test_an_alarm_that_is_still_on_its_way_is_not_taken_for_ones_own(monkeypatch):
    """Another timer rings just as the handler is set, and once more when it is given back."""
    installed = signal.signal

    def ringing(number, handler):
        before = installed(number, handler)
        if number == signal.SIGALRM and callable(handler):
            handler(number, None)
        return before

    heard = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: heard.append(number))
    try:
        ours = signal.getsignal(signal.SIGALRM)
        monkeypatch.setattr(signal, "signal", ringing)
        with step_limit.bounded(30.0):
            pass
        monkeypatch.undo()
        assert signal.getsignal(signal.SIGALRM) is ours
        assert heard == [signal.SIGALRM]
    finally:
        signal.signal(signal.SIGALRM, before)
