"""What keeps ticks on time, and what is said of it when it is not allowed."""

from __future__ import annotations

import gc
import sys

import pytest

from crazyarena.runner.timing import realtime


def test_processors_stay_awake_where_that_is_allowed(tmp_path, monkeypatch):
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    monkeypatch.setattr(realtime, "_DMA_LATENCY", str(device))
    with realtime.wide_awake() as note:
        assert note == "processors stay awake"
        assert device.read_bytes() == bytes(4)
    monkeypatch.setattr(realtime, "_DMA_LATENCY", str(tmp_path / "no" / "such"))
    with realtime.wide_awake() as note:
        assert "No such file" in note
        assert "writable" in note


def test_trouble_of_the_flight_itself_is_not_swallowed(tmp_path, monkeypatch):
    monkeypatch.setattr(realtime, "_DMA_LATENCY", str(tmp_path / "none"))
    with pytest.raises(OSError, match="of the flight"), realtime.wide_awake():
        raise OSError("of the flight")


def test_the_collector_is_back_after_the_flight():
    interval = sys.getswitchinterval()
    with realtime.quiet_collector():
        assert not gc.isenabled()
        assert sys.getswitchinterval() <= 0.0005
    assert gc.isenabled()
    assert sys.getswitchinterval() == interval
