"""Where random numbers of a level come from: one interface over numpy's stream and jax's keys.

What draws is written once, in jax's manner: it splits keys and hands them on. A stream has no
keys; it simply gives its next numbers, in the order in which they are asked for.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from crazyarena.levels.lsy import _threefry
from crazyarena.levels.lsy.schema import LsyRng, Spec

Array = NDArray[np.float64]


class Source(Protocol):
    """``key`` is whatever :meth:`split` gave; None for the source's own."""

    def split(self, key: Any, count: int) -> list[Any]: ...

    def unit(self, key: Any, shape: tuple[int, ...]) -> Array:
        """Uniform in [0, 1)."""
        ...

    def normal(self, key: Any, shape: tuple[int, ...]) -> Array: ...

    def rows(self, key: Any, count: int, width: int, *, normal: bool) -> tuple[Any, Array]:
        """``count`` arrays of ``width`` numbers, each under a key split off before it; the key
        that is left and (count, width)."""
        ...

    @property
    def single(self) -> bool:
        """Whether results are rounded to single precision, as jax computes."""
        ...


class Stream:
    """``numpy.random.default_rng(seed)``."""

    single = False

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def split(self, key: Any, count: int) -> list[Any]:
        return [None] * count

    def unit(self, key: Any, shape: tuple[int, ...]) -> Array:
        return self._rng.random(shape)

    def normal(self, key: Any, shape: tuple[int, ...]) -> Array:
        return self._rng.standard_normal(shape)

    def rows(self, key: Any, count: int, width: int, *, normal: bool) -> tuple[Any, Array]:
        shape = (count, width)
        return None, self.normal(None, shape) if normal else self.unit(None, shape)


class Keys:
    """jax's threefry keys (2,) uint32, and what ``jax.random`` makes of them in float32."""

    single = True

    @staticmethod
    def root(seed: int) -> NDArray[np.uint32]:
        """``jax.random.key(seed)`` without 64-bit mode: the seed's low 32 bits."""
        return np.array([0, seed & 0xFFFFFFFF], np.uint32)

    def split(self, key: Any, count: int) -> list[Any]:
        out = np.empty((count, 2), np.uint32)
        _threefry.split(key, out)
        return list(out)

    def unit(self, key: Any, shape: tuple[int, ...]) -> Array:
        raw = np.empty(int(np.prod(shape, dtype=int)), np.uint32)
        _threefry.bits(key, raw)
        return _unit(raw).reshape(shape)

    def normal(self, key: Any, shape: tuple[int, ...]) -> Array:
        raw = np.empty(int(np.prod(shape, dtype=int)), np.uint32)
        _threefry.bits(key, raw)
        return _normal(raw).reshape(shape)

    def rows(self, key: Any, count: int, width: int, *, normal: bool) -> tuple[Any, Array]:
        key = key.copy()
        raw = np.empty((count, width), np.uint32)
        _threefry.chain(key, raw)
        return key, _normal(raw) if normal else _unit(raw)


def _unit(raw: NDArray[np.uint32]) -> Array:
    # 23 bits as the fraction of a float between 1 and 2.
    mantissa = (raw >> np.uint32(9)) | np.uint32(0x3F800000)
    return (mantissa.view(np.float32) - np.float32(1.0)).astype(np.float64)


def _normal(raw: NDArray[np.uint32]) -> Array:
    low = np.nextafter(np.float32(-1.0), np.float32(0.0))
    flat = _unit(raw).astype(np.float32) * (np.float32(1.0) - low) + low
    spread = np.maximum(low, flat)
    return (np.float32(np.sqrt(2.0)) * erfinv(spread)).astype(np.float32).astype(np.float64)


def make_source(kind: LsyRng, seed: int) -> tuple[Source, Any]:
    """The source for a seed, and its first key."""
    if kind is LsyRng.THREEFRY:
        return Keys(), Keys.root(seed)
    return Stream(seed), None


def between(source: Source, unit: Array, low: Any, high: Any) -> Array:
    """Numbers of [0, 1) brought to [low, high), rounded as the source rounds."""
    if not source.single:
        low, high = np.asarray(low, float), np.asarray(high, float)
        return low + (high - low) * unit
    low32, high32 = np.asarray(low, np.float32), np.asarray(high, np.float32)
    value = unit.astype(np.float32) * (high32 - low32) + low32
    return np.maximum(low32, value).astype(np.float64)


def scaled(source: Source, spec: Spec, raw: Array) -> Array:
    """What a distribution makes of unit uniform (or normal) numbers."""
    if spec.fn == "uniform":
        raw = between(source, raw, spec.low, spec.high)
    if not source.single:
        return raw * np.asarray(spec.scale) + np.asarray(spec.offset)
    value = raw.astype(np.float32) * np.asarray(spec.scale, np.float32)
    return (value + np.asarray(spec.offset, np.float32)).astype(np.float64)


def draw(source: Source, key: Any, spec: Spec, shape: tuple[int, ...]) -> Array:
    """One array of a distribution."""
    raw = source.normal(key, shape) if spec.fn == "normal" else source.unit(key, shape)
    return scaled(source, spec, raw)


def choice(source: Source, key: Any, weights: Array) -> int:
    """An index with probability proportional to its weight (``jax.random.choice``)."""
    kind = np.float32 if source.single else np.float64
    total = weights.sum()
    shares = weights / total if total > 0 else np.full(weights.shape, 1.0 / weights.size)
    edges = np.cumsum(shares.astype(kind), dtype=kind)
    at = edges[-1] * (kind(1.0) - kind(source.unit(key, ())))
    return int(min(np.searchsorted(edges, at), weights.size - 1))
