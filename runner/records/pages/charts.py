"""Lines over time as inline SVG, in the colours of the page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 900, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 8, 16, 20
_POINTS = 500


@dataclass
class Line:
    """One line: time (n,), value (n,); style: CSS classes, ``s0`` ... ``s4``."""

    name: str
    time: Array
    value: Array
    style: str


def thinned(count: int, most: int = _POINTS) -> NDArray[np.int64]:
    """Indices of at most ``most`` of ``count`` things, first and last among them."""
    return np.unique(np.linspace(0, max(0, count - 1), min(most, max(count, 1))).astype(int))


def chart(
    label: str,
    lines: Sequence[Line],
    *,
    gates: Sequence[float] = (),
    marks: Sequence[tuple[float, str, str]] = (),
    openings: Sequence[tuple[float, float, float]] = (),
    limits: tuple[float, float] | None = None,
) -> str:
    """An SVG.

    Parameters
    ----------
    gates: times, s. marks: (time s, class, text). openings: (time s, low m, high m).
    limits: of the values, instead of what they come to.
    """
    times = np.concatenate([line.time for line in lines] or [np.zeros(1)])
    values = np.concatenate([line.value for line in lines] or [np.zeros(1)])
    values = values[np.isfinite(values) & (np.abs(values) < 1e6)]
    t0, t1 = (float(times.min()), float(times.max())) if len(times) else (0.0, 1.0)
    v0, v1 = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    for _, low, high in openings:
        v0, v1 = min(v0, low), max(v1, high)
    pad = 0.06 * (v1 - v0) or 0.1
    v0, v1 = limits or (v0 - pad, v1 + pad)
    t1 = max(t1, t0 + 1e-3)

    def x(time: float) -> float:
        return _LEFT + (time - t0) / (t1 - t0) * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        share = (min(max(value, v0), v1) - v0) / (v1 - v0)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)

    bottom = _HEIGHT - _BOTTOM
    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{html.escape(label)}">']
    for value in ticks(v0, v1, 4):
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(value):.1f}" '
                     f'y2="{y(value):.1f}"/><text x="{_LEFT - 5}" y="{y(value) + 4:.1f}" '
                     f'text-anchor="end">{value:g}</text>')  # fmt: skip
    for time in ticks(t0, t1, 10):
        parts.append(f'<line class="grid" x1="{x(time):.1f}" x2="{x(time):.1f}" y1="{_TOP}" '
                     f'y2="{bottom}"/><text x="{x(time):.1f}" y="{_HEIGHT - 6}" '
                     f'text-anchor="middle">{time:g}</text>')  # fmt: skip
    for when, low, high in openings:
        parts.append(f'<rect class="open" x="{x(when) - 8:.1f}" width="16" y="{y(high):.1f}" '
                     f'height="{y(low) - y(high):.1f}"/>')  # fmt: skip
    for when in gates:
        parts.append(_upright(x(when), "gate", "gate passed", bottom))
    for when, style, told in marks:
        parts.append(_upright(x(when), style, f"{when:.2f} s {told}", bottom))
    across = float(_LEFT)
    for line in lines:
        for piece in _pieces(line):
            points = " ".join(f"{x(t):.1f},{y(v):.1f}" for t, v in piece)
            parts.append(f'<polyline class="{line.style}" points="{points}"/>')
        parts.append(f'<text class="{line.style.split()[0]}" x="{across:.0f}" y="11">'
                     f"{html.escape(line.name)}</text>")  # fmt: skip
        across += 12 + 6.3 * len(line.name)
    parts.append(
        f'<text x="{_WIDTH - _RIGHT}" y="11" text-anchor="end">{html.escape(label)}</text>'
    )
    return "".join([*parts, "</svg>"])


def _upright(at: float, style: str, told: str, bottom: int) -> str:
    return (
        f'<line class="{style}" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{bottom}">'
        f"<title>{html.escape(told)}</title></line>"
    )


def _pieces(line: Line) -> list[list[tuple[float, float]]]:
    """Runs of finite values."""
    few = thinned(len(line.time)).tolist() if len(line.time) else []
    pieces: list[list[tuple[float, float]]] = [[]]
    for i in few:
        if math.isfinite(line.value[i]):
            pieces[-1].append((float(line.time[i]), float(line.value[i])))
        elif pieces[-1]:
            pieces.append([])
    return [piece for piece in pieces if len(piece) > 1]


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers between two."""
    span = high - low
    if not (math.isfinite(span) and span > 0.0):
        return []
    step = 10.0 ** math.floor(math.log10(span / most))
    step *= next(f for f in (1, 2, 5, 10) if span / (step * f) <= most)
    first = math.ceil(low / step)
    return [round(k * step, 10) for k in range(first, math.floor(high / step) + 1)]


def dots(label: str, rows: Sequence[tuple[str, Sequence[tuple[float, str]]]], zero: float) -> str:
    """Values of each named row as dots; an upright line at ``zero``. (value, class) each."""
    values = [v for _, points in rows for v, _ in points if math.isfinite(v)] or [0.0]
    low, high = min(*values, zero), max(*values, zero)
    pad = 0.05 * (high - low) or 0.1
    low, high = low - pad, high + pad
    left, line, height = 260, 17, 34 + 17 * len(rows)

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (_WIDTH - left - _RIGHT)

    parts = [f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{html.escape(label)}">']
    for value in ticks(low, high, 8):
        parts.append(f'<line class="grid" x1="{x(value):.1f}" x2="{x(value):.1f}" y1="4" '
                     f'y2="{height - 30}"/><text x="{x(value):.1f}" y="{height - 17}" '
                     f'text-anchor="middle">{value:g}</text>')  # fmt: skip
    parts.append(f'<line class="mark" x1="{x(zero):.1f}" x2="{x(zero):.1f}" y1="4" '
                 f'y2="{height - 30}"/>')  # fmt: skip
    for index, (name, points) in enumerate(rows):
        y = 14 + line * index
        parts.append(
            f'<text x="{left - 8}" y="{y + 4}" text-anchor="end">{html.escape(name)}</text>'
        )
        for value, style in points:
            if math.isfinite(value):
                parts.append(f'<circle class="dot {style}" cx="{x(value):.1f}" cy="{y}" r="2.6"/>')
    parts.append(f'<text x="{_WIDTH - _RIGHT}" y="{height - 3}" text-anchor="end">'
                 f"{html.escape(label)}</text>")  # fmt: skip
    return "".join([*parts, "</svg>"])
